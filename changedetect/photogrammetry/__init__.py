"""
From photos and camera poses to ground points with covariance.

Features are tracked through a strip (`tracks`), joined between strips and epochs (`ties`), checked against the geometry
of the poses (`epipolar`, `triangulation`) and adjusted together with poses and lens (`adjustment`). Pixels follow
OpenCV's convention: the centre of the top-left pixel is (0, 0).
"""
