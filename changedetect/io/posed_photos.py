"""Photos with poses and lenses that another program adjusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from changedetect.errors import MissingInputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from changedetect.navigation.camera import CameraIntrinsics
    from changedetect.navigation.frame import LocalFrame
    from changedetect.typing import FloatArray, IntArray

__all__ = ["PosedPhotos", "files_of"]


@dataclass(frozen=True)
class PosedPhotos:
    """
    A model of another program.

    Attributes
    ----------
    path : path
        File or folder it was read from.
    paths : tuple of path, length n
        Photos, in the order of time or of their names.
    time : array, shape (n,), s
    rotation : array, shape (n, 3, 3)
        Camera axes (right, down, forward) to the model's frame.
    position : array, shape (n, 3)
        Of the cameras in the model's frame, in its unit.
    cameras : tuple of CameraIntrinsics
    lens : array, shape (n,), int64
        Camera of each photo.
    origin : LocalFrame, optional
        Where the model's frame is ENU in metres; None where it floats.
    is_geocentric : bool
        The model's frame is Earth-centred, Earth-fixed (EPSG:4978).
    depth : float, optional
        Median distance from cameras to the points of the model, in its unit.
    pixel_error : float, optional
        Mean reprojection error that the program states, pixels.
    """

    path: Path
    paths: tuple[Path, ...]
    time: FloatArray
    rotation: FloatArray
    position: FloatArray
    cameras: tuple[CameraIntrinsics, ...]
    lens: IntArray
    origin: LocalFrame | None = None
    is_geocentric: bool = False
    depth: float | None = None
    pixel_error: float | None = None


def files_of(model: Path, directory: Path, names: Sequence[str]) -> list[Path]:
    """
    Photo files of the names in a model, in the folder `images`, the folder itself, or where the name points to.

    Raises
    ------
    MissingInputError
        A photo is not there.
    """
    by_stem = {
        path.stem: path for folder in (directory, directory / "images") for path in folder.glob("*") if path.is_file()
    }
    found: list[Path] = []
    missing: list[str] = []
    for name in names:
        base = name.replace("\\", "/").rsplit("/", 1)[-1]
        tries = (directory / "images" / name, directory / name, directory / "images" / base, directory / base)
        path = next((path for path in tries if path.is_file()), by_stem.get(base))
        if path is None:
            missing.append(name)
        else:
            found.append(path)
    if missing:
        msg = (
            f"{model} has {len(missing)} of {len(names)} photos that are neither in {directory} nor in its folder "
            "images: "
            f"{', '.join(missing[:5])}{' ...' if len(missing) > 5 else ''}. Put the photos there under their names."
        )
        raise MissingInputError(msg)
    return found
