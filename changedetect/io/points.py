"""
Opening a file of observed points, whatever its format.

LAS, LAZ and COPC; PLY; tables (CSV, XYZ, TXT, PTS); elevation rasters that rasterio reads. The content decides first:
a LAS file without a suffix is read as LAS, a text file called .laz is refused.
"""

from __future__ import annotations

import logging
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from changedetect.crs import is_geographic, make_transform
from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.source import CHUNK_SIZE, PointSource, SourceOptions
from changedetect.pointcloud import PointCloud, check_count, check_not_degrees, check_values

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["PointSource", "SourceOptions", "detect_format", "iter_programme_chunks", "open_points", "read_points"]

logger = logging.getLogger(__name__)

Format: TypeAlias = Literal["las", "ply", "table", "raster"]

SUPPORTED = (
    "LAS, LAZ and COPC (.las, .laz), PLY (.ply), tables of coordinates (.csv, .xyz, .txt, .pts, .tsv, .dat) and "
    "elevation rasters (.tif and whatever else GDAL reads)"
)

_SUFFIXES: dict[str, Format] = {
    ".las": "las",
    ".laz": "las",
    ".ply": "ply",
    **dict.fromkeys((".csv", ".xyz", ".txt", ".pts", ".tsv", ".dat", ".asc"), "table"),
    **dict.fromkeys((".tif", ".tiff", ".vrt", ".img", ".nc", ".hgt", ".bil", ".flt", ".jp2", ".dem", ".dt2"), "raster"),
}
_SIGNATURES: tuple[tuple[tuple[bytes, ...], Format], ...] = (
    ((b"LASF",), "las"),
    ((b"ply\n", b"ply\r"), "ply"),
    ((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "raster"),  # TIFF and BigTIFF
    ((b"\x89HDF", b"CDF\1", b"CDF\2", b"CDF\5", b"\0\0\0\x0cjP"), "raster"),  # NetCDF, JPEG 2000
    ((b"ncols", b"NCOLS", b"DSAA", b"DSBB", b"DSRB", b"<VRTDataset"), "raster"),  # ESRI and Surfer grids, VRT
)


def open_points(path: Path | str, options: SourceOptions | None = None) -> PointSource:
    """
    Open a file of observed points.

    Parameters
    ----------
    path : path
    options : SourceOptions, optional
        What the user states; by default nothing.

    Returns
    -------
    source : PointSource
        Its header is read and checked, its points are not.

    Raises
    ------
    MissingInputError
        The file does not exist or may not be read.
    InputDataError
        It is a folder, empty, damaged, or of a format that is not supported.
    CRSMismatchError
        Its CRS cannot be understood. A missing CRS is no error yet: `require_crs` tells.
    """
    path = Path(path)
    options = options or SourceOptions()
    kind = detect_format(path)
    if kind == "las":
        from changedetect.io.las import LasSource

        return LasSource(path, options)
    if kind == "ply":
        from changedetect.io.ply import PlySource

        return PlySource(path, options)
    if kind == "table":
        from changedetect.io.table import TableSource

        return TableSource(path, options)
    from changedetect.io.raster import RasterSource

    return RasterSource(path, options)


def read_points(path: Path | str, options: SourceOptions | None = None) -> PointCloud:
    """
    Read a whole file of observed points, in its own CRS.

    Raises
    ------
    MissingInputError, InputDataError, CRSMismatchError
        As `open_points`.
    """
    return open_points(path, options).read()


def iter_programme_chunks(
    source: PointSource, programme_crs: str, chunk_size: int = CHUNK_SIZE, *, coordinate_epoch: float | None = None
) -> Iterator[PointCloud]:
    """
    Read a source in the programme's CRS, every point checked.

    Parameters
    ----------
    source : PointSource
    programme_crs : str
    chunk_size : int
    coordinate_epoch : float, decimal year, optional
        Epoch of the source's coordinates, for dynamic frames; see `changedetect.crs.make_transform`.

    Yields
    ------
    cloud : PointCloud
        Easting, northing and elevation in metres, in the programme's CRS.

    Raises
    ------
    CRSMismatchError, VerticalDatumError
        The source has no CRS, or there is no trustworthy way from it to the programme's.
    InputDataError
        A point cannot be terrain (NaN, infinite, absurd, evidently degrees), or there are fewer than ten points.
    """
    n_points = 0
    with _naming(source.path):
        source_crs = source.require_crs()
        transform = make_transform(source_crs, programme_crs, coordinate_epoch=coordinate_epoch)
    for chunk in source.iter_chunks(chunk_size):
        where = f"{source.path}, points from {n_points} on" if n_points else str(source.path)
        if n_points == 0 and not is_geographic(source_crs):
            check_not_degrees(chunk, where)
        with _naming(source.path):
            easting, northing, elevation = transform(*chunk.coordinates, chunk.elevation)
        cloud = PointCloud(easting, northing, elevation, chunk.sigma, chunk.classification)
        check_values(cloud, where)
        n_points += len(cloud)
        yield cloud
    check_count(n_points, str(source.path))


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put the name of the source before messages about its CRS."""
    try:
        yield
    except InputDataError as error:
        if str(error).startswith(str(path)):
            raise
        msg = f"{path}: {error}"
        raise type(error)(msg) from error


def detect_format(path: Path) -> Format:
    """
    Tell the format of a file from its first bytes, and from its suffix where they are silent.

    Returns
    -------
    kind : {"las", "ply", "table", "raster"}

    Raises
    ------
    MissingInputError
        The file does not exist or may not be read.
    InputDataError
        It is a folder, empty, not what its suffix says, or of no supported format.
    """
    head = _first_bytes(path)
    suffix = path.suffix.lower()
    kind = _SUFFIXES.get(suffix)
    for signatures, format_of_content in _SIGNATURES:
        if head.startswith(signatures):
            if kind not in (None, format_of_content):
                logger.info("%s is read as %s: its content says so, whatever the suffix", path, format_of_content)
            return format_of_content
    if kind in ("las", "ply"):
        name = "LAS or LAZ" if kind == "las" else "PLY"
        expected = "LASF" if kind == "las" else "ply"
        msg = (
            f"{path} is not a {name} file: it starts with {head[:8]!r} where {expected!r} stands in one. "
            "It may be damaged, or of another format under this name."
        )
        raise InputDataError(msg)
    if kind == "table" and b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        msg = f"{path} is not a table of text: it holds zero bytes. Supported are {SUPPORTED}."
        raise InputDataError(msg)
    if kind is not None:
        return kind
    if _looks_like_table(head):
        return "table"
    if _is_raster(path):
        return "raster"
    msg = f"{path}: the format is not supported (suffix {suffix or 'none'!r}). Supported are {SUPPORTED}."
    raise InputDataError(msg)


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
    except FileNotFoundError as error:
        msg = f"No such file: {path}. Check the name and the folder (relative names start at {Path.cwd()})."
        raise MissingInputError(msg) from error
    except IsADirectoryError as error:
        msg = f"{path} is a folder. Name the files in it, for example {path}/*.laz."
        raise InputDataError(msg) from error
    except PermissionError as error:
        msg = f"{path} may not be read: permission denied. Ask its owner, or run `chmod +r` on it."
        raise MissingInputError(msg) from error
    except OSError as error:
        msg = f"{path} cannot be read: {error.strerror or error}."
        raise MissingInputError(msg) from error
    if not head:
        msg = f"{path} is empty (0 bytes). Copy or export it again."
        raise InputDataError(msg)
    return head


def _looks_like_table(head: bytes) -> bool:
    """Whether at least half of the first lines hold three numbers or more."""
    if b"\0" in head:
        return False
    lines = head.decode("utf-8", errors="replace").splitlines()[:-1] or [head.decode("utf-8", errors="replace")]
    return 2 * sum(_n_numbers(line) >= 3 for line in lines) >= len(lines)


def _n_numbers(line: str) -> int:
    count = 0
    for field in line.replace(";", " ").replace(",", " ").split():
        try:
            float(field)
        except ValueError:
            continue
        count += 1
    return count


def _is_raster(path: Path) -> bool:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # refused when it is opened in earnest
            rasterio.open(path).close()
        return True
    except RasterioIOError:
        return False
