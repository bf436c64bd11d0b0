"""
Receptive fields that follow the level lines of the ground.

At the foot of a scarp or the rim of a crown the ground bends sharply across and hardly along. A receptive field whose
metric is long along the level line and narrow across it, and bent as the line bends, takes as many observations as a
round one and yet resolves the edge. Steering a kernel by the local gradient structure is due to [1]_; the curvature
of the level line is added here.

References
----------
.. [1] H. Takeda, S. Farsiu, P. Milanfar (2007), Kernel regression for image processing and reconstruction, IEEE
   Transactions on Image Processing 16, 349-366.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from numba import njit, prange

from changedetect.kernels.compilation import FUSED
from changedetect.kernels.receptive_fields import RIDGE, invert_plane

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["N_GEOMETRY", "N_STEERED", "fit_steered_planes"]

#: Rows of the geometry of a steered field: 0 east and 1 north component of the unit vector across the level line,
#: 2 curvature of the level line in 1/m, 3 whether the field is steered (1 or 0).
N_GEOMETRY = 4
#: Columns of the answer: 0 value, 1 slope east, 2 slope north, 3 noise variance of the value, 4 effective number of
#: observations, 5 mean square of the leave-one-out errors (or residual variance), 6 that of the rival.
N_STEERED = 7
#: Activation of a cell that a field does not see.
_UNSEEN = -1.0


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _activation(
    m: FloatArray, x: float, y: float, ex: float, ey: float, bend: float, along: float, across: float
) -> tuple[float, float, float]:
    """
    How a field sees a cell: activation, or `_UNSEEN`, and coordinates across and along, in kernels.

    `m` are the cell's moments, (x, y) its centre from that of the field.
    """
    n = m[1]
    if n <= 0.0:
        return _UNSEEN, 0.0, 0.0
    dx = x + m[2] / n
    dy = y + m[3] / n
    v = ex * dy - ey * dx
    if v > 2.0 * along or v < -2.0 * along:
        return _UNSEEN, 0.0, 0.0
    u = ex * dx + ey * dy + 0.5 * bend * v * v
    u /= across
    v /= along
    q = u * u + v * v
    if q >= 4.0:
        return _UNSEEN, 0.0, 0.0
    w = 1.0 - 0.25 * q
    return w * w, u, v


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def fit_steered_planes(
    window: FloatArray,
    cell_size: float,
    row0: int,
    column0: int,
    along: float,
    across: float,
    spacing: float,
    first_row: int,
    first_column: int,
    geometry: FloatArray,
    rival: FloatArray,
    fits: FloatArray,
) -> None:
    """
    Weighted local plane, in bent coordinates, of every steered field of a lattice block.

    Parameters
    ----------
    window : array, shape (n_rows, n_columns, N_MOMENTS)
        Moments of the cells, covering two kernel sizes around the block; weights are about 1 / noise variance.
    cell_size : float, m
    row0, column0 : int
        First row and column of the window.
    along, across : float, m
        Kernel sizes along and across the level line.
    spacing : float, m
        Lattice spacing of the receptive fields.
    first_row, first_column : int
        Lattice indices of fits[0, 0].
    geometry : array, shape (n_i, n_j, N_GEOMETRY)
    rival : array, shape (n_rows, n_columns), m2
        Squared leave-one-out error, at every cell of the window, of the surface that these fields compete with; of
        shape (0, 0) if there is none: then column 5 is the residual variance, which costs no second pass.
    fits : array, shape (n_i, n_j, N_STEERED)
        Filled in place; zero where a field is not steered or has no cell at all.

    Notes
    -----
    With x the offset from the centre, e the unit vector across and t the one along the level line of curvature k,
    the field's coordinates are v = t'x and u = e'x + k v**2 / 2: u is constant along the line. Activation and plane
    are those of `fit_planes` in (u / across, v / along). Within a cell, u and v vary as their tangent. With r the
    residual of a cell's mean and h its leverage w n x'A^-1 x, its leave-one-out error is r / (1 - h). Squared errors
    are averaged with weights w**2 n, which speak for the centre.
    """
    for i in prange(fits.shape[0]):
        y0 = (first_row + i + 0.5) * spacing
        for j in range(fits.shape[1]):
            o = fits[i, j]
            for c in range(N_STEERED):
                o[c] = 0.0
            if geometry[i, j, 3] <= 0.0:
                continue
            ex, ey, bend = geometry[i, j, 0], geometry[i, j, 1], geometry[i, j, 2]
            x0 = (first_column + j + 0.5) * spacing
            # half the extent of the ellipse, and how far its ends bend away
            bulge = 2.0 * abs(bend) * along * along
            reach_x = 2.0 * math.hypot(along * ey, across * ex) + bulge * abs(ex)
            reach_y = 2.0 * math.hypot(along * ex, across * ey) + bulge * abs(ey)
            a_low = max(0, int(math.floor((y0 - reach_y) / cell_size)) - row0)
            a_high = min(window.shape[0] - 1, int(math.floor((y0 + reach_y) / cell_size)) - row0)
            b_low = max(0, int(math.floor((x0 - reach_x) / cell_size)) - column0)
            b_high = min(window.shape[1] - 1, int(math.floor((x0 + reach_x) / cell_size)) - column0)
            s0 = s1 = s2 = s3 = s4 = s5 = 0.0
            t0 = t1 = t2 = t3 = t4 = t5 = 0.0
            z0 = z1 = z2 = zz = 0.0
            count = p0 = expected = 0.0
            for a in range(a_low, a_high + 1):
                for b in range(b_low, b_high + 1):
                    m = window[a, b]
                    x, y = (column0 + b + 0.5) * cell_size - x0, (row0 + a + 0.5) * cell_size - y0
                    w, u, v = _activation(m, x, y, ex, ey, bend, along, across)
                    if w < 0.0:
                        continue
                    n = m[1]
                    # tangents of u and v inside the cell, and second moments about its mean
                    ux = (ex - bend * v * along * ey) / across
                    uy = (ey + bend * v * along * ex) / across
                    vx, vy = -ey / along, ex / along
                    cxx = m[4] - m[2] * m[2] / n
                    cxy = m[5] - m[2] * m[3] / n
                    cyy = m[6] - m[3] * m[3] / n
                    cxz = m[8] - m[2] * m[7] / n
                    cyz = m[9] - m[3] * m[7] / n
                    x1 = n * u
                    x2 = n * v
                    x3 = n * u * u + ux * ux * cxx + 2.0 * ux * uy * cxy + uy * uy * cyy
                    x4 = n * u * v + ux * vx * cxx + (ux * vy + uy * vx) * cxy + uy * vy * cyy
                    x5 = n * v * v + vx * vx * cxx + 2.0 * vx * vy * cxy + vy * vy * cyy
                    s0 += w * n
                    s1 += w * x1
                    s2 += w * x2
                    s3 += w * x3
                    s4 += w * x4
                    s5 += w * x5
                    p0 += w * w * n * n / m[0]
                    f = n * m[12] / (m[0] * m[0])
                    expected += w * m[0] * f
                    f *= w * w
                    t0 += f * n
                    t1 += f * x1
                    t2 += f * x2
                    t3 += f * x3
                    t4 += f * x4
                    t5 += f * x5
                    z0 += w * m[7]
                    z1 += w * (u * m[7] + ux * cxz + uy * cyz)
                    z2 += w * (v * m[7] + vx * cxz + vy * cyz)
                    zz += w * m[10]
                    count += w * m[0]
            if s0 <= 0.0:
                continue
            n_effective = s0 * s0 / p0
            ridge = RIDGE * s0 / n_effective
            i00, i01, i02, i11, i12, i22 = invert_plane(s0, s1, s2, s3 + ridge, s4, s5 + ridge)
            b0 = i00 * z0 + i01 * z1 + i02 * z2
            b1 = i01 * z0 + i11 * z1 + i12 * z2
            b2 = i02 * z0 + i12 * z1 + i22 * z2
            g00 = i00 * t0 + i01 * t1 + i02 * t2
            g01 = i00 * t1 + i01 * t3 + i02 * t4
            g02 = i00 * t2 + i01 * t4 + i02 * t5
            o[0] = b0
            o[1] = b1 * ex / across - b2 * ey / along
            o[2] = b1 * ey / across + b2 * ex / along
            o[3] = max(g00 * i00 + g01 * i01 + g02 * i02, 1e-3 * t0 / (s0 * s0))
            o[4] = n_effective
            if rival.size == 0:
                g11 = i01 * t1 + i11 * t3 + i12 * t4
                g22 = i02 * t2 + i12 * t4 + i22 * t5
                residual = max(zz - b0 * z0 - b1 * z1 - b2 * z2, 0.0)
                freedom = expected - (g00 + g11 + g22)
                o[5] = residual / max(freedom * s0 / count, 0.3 * s0)
                continue
            # leave-one-out errors of this field and of its rival, over the same cells with the same weights
            own = other = weight = 0.0
            for a in range(a_low, a_high + 1):
                for b in range(b_low, b_high + 1):
                    m = window[a, b]
                    x, y = (column0 + b + 0.5) * cell_size - x0, (row0 + a + 0.5) * cell_size - y0
                    w, u, v = _activation(m, x, y, ex, ey, bend, along, across)
                    if w < 0.0:
                        continue
                    n = m[1]
                    h = w * n * (i00 + 2.0 * (i01 * u + i02 * v) + i11 * u * u + 2.0 * i12 * u * v + i22 * v * v)
                    e = (m[7] / n - b0 - b1 * u - b2 * v) / max(1.0 - h, 0.1)
                    w *= w * n
                    own += w * e * e
                    other += w * rival[a, b]
                    weight += w
            o[5] = own / weight
            o[6] = other / weight
