"""
Photos, read as grey images in the geometry of the sensor.

A flag for turning the picture on a screen, as cameras write it into EXIF, is ignored: poses and lens refer to the
sensor.
"""

from __future__ import annotations

import warnings
from collections import OrderedDict
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import cv2
import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

from changedetect.errors import InputDataError, MissingInputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["PhotoFiles", "photo_size"]

#: Photos kept in memory, bytes.
_CACHE_BYTES = 512 * 2**20
#: How OpenCV reads grey pictures, whole or reduced while they are decoded.
_READ = {
    1: cv2.IMREAD_GRAYSCALE,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
#: Cameras append thumbnails and notes behind the end marker; a search this far back finds it, bytes.
_TAIL = 2**20


class PhotoFiles:
    """
    The photos of a block, read when asked for and kept while there is room; call it with a photo's position.

    Parameters
    ----------
    paths : sequence of path
    size : (int, int), pixels
        Width and height that the camera file states.
    camera : str
        Name of the camera file, for messages.
    reduction : int
        1, 2, 4 or 8: that many pixels, across and down, are read as one.

    Raises
    ------
    MissingInputError
        A photo does not exist.
    InputDataError
        A photo cannot be read or has another size.
    """

    def __init__(
        self, paths: Sequence[Path], size: tuple[int, int], camera: str = "the camera file", reduction: int = 1
    ) -> None:
        self.paths = tuple(paths)
        self.reduction = reduction
        self._kept: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._lock = Lock()
        self._room = max(int(_CACHE_BYTES * reduction**2 // (size[0] * size[1])), 2)
        missing = [path for path in self.paths if not path.is_file()]
        if missing:
            names = ", ".join(path.name for path in missing[:5])
            msg = (
                f"{len(missing)} of {len(self.paths)} photos do not exist in {missing[0].parent}: {names}"
                f"{' ...' if len(missing) > 5 else ''}. Put them there, or remove them from the list."
            )
            raise MissingInputError(msg)
        for path in self.paths:
            found = photo_size(path)
            if found != tuple(size):
                turned = " (turned by 90 degrees: export it unrotated)" if found == (size[1], size[0]) else ""
                msg = (
                    f"{path} is {found[0]} x {found[1]} pixels{turned}, but {camera} states {size[0]} x {size[1]}. Use "
                    "the camera file of these photos, or photos that were not resized."
                )
                raise InputDataError(msg)

    def __len__(self) -> int:
        return len(self.paths)

    def __call__(self, image: int) -> NDArray[np.uint8]:
        """
        Grey photo of a position, shape (height, width), uint8.

        Raises
        ------
        InputDataError
            The photo is damaged.
        """
        with self._lock:
            if image in self._kept:
                self._kept.move_to_end(image)
                return self._kept[image]
        grey = _read_grey(self.paths[image], self.reduction)
        with self._lock:
            self._kept[image] = grey
            while len(self._kept) > self._room:
                self._kept.popitem(last=False)
        return grey


def photo_size(path: Path) -> tuple[int, int]:
    """
    Width and height of a photo from its header, pixels.

    Raises
    ------
    InputDataError
        The file is not a picture.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as dataset:
                return int(dataset.width), int(dataset.height)
    except RasterioIOError as error:
        reason = str(error).rstrip(".")
        msg = f"{path} cannot be read as a picture: {reason}. Copy it again from the camera, or take it off the list."
        raise InputDataError(msg) from error


def _read_grey(path: Path, reduction: int) -> NDArray[np.uint8]:
    if path.suffix.lower() in (".jpg", ".jpeg"):
        _require_whole_jpeg(path)
    grey = cv2.imread(str(path), _READ[reduction] | cv2.IMREAD_IGNORE_ORIENTATION)
    if grey is None:
        msg = f"{path} cannot be decoded. Copy it again from the camera, or take it off the list."
        raise InputDataError(msg)
    return np.asarray(grey, dtype=np.uint8)


def _require_whole_jpeg(path: Path) -> None:
    """Decoders fill the missing part of a truncated JPEG with grey and say nothing that can be caught."""
    with path.open("rb") as stream:
        start = stream.read(2)
        stream.seek(max(path.stat().st_size - _TAIL, 0))
        tail = stream.read()
    if start == _JPEG_START and _JPEG_END not in tail:
        msg = f"{path} is truncated: its JPEG data does not end. Copy it again from the camera, or remove it."
        raise InputDataError(msg)
