"""
Files that are whole or absent.

Every result is written under a temporary name beside its target, flushed to disk and renamed [1]_, so that a killed
run, a full disk or a failed check leaves what stood there before.

References
----------
.. [1] POSIX.1-2017, rename(): a reader sees either the old file or the new one, never a mixture.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import re
import secrets
import shutil
from contextlib import contextmanager
from datetime import date
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from changedetect.errors import MissingInputError, ModelStateError, OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import xarray as xr

__all__ = [
    "atomic_directory",
    "atomic_path",
    "clear_leftovers",
    "read_dataset",
    "read_json",
    "sha256_of_file",
    "write_dataset",
    "write_json",
]

logger = logging.getLogger(__name__)

#: `NAME.tmp-<pid>-<random>` is being written; `NAME.old-<pid>-<random>` is a folder that is just being replaced.
_LEFTOVER = re.compile(r"^(?P<name>.+)\.(?P<kind>tmp|old)-\d+-[0-9a-f]{8}(\.[^.]*)?$")
#: Errors of the storage itself, whichever library hits them; all others belong to the caller.
_STORAGE_ERRNO = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """
    Give a temporary name beside `target` that becomes `target` when the block ends without error.

    Parameters
    ----------
    target : path
        File to write. Missing parent folders are made; an existing file is replaced.

    Yields
    ------
    temporary : path
        `NAME.tmp-<pid>-<random>` followed by the suffix of `target`, which some drivers need. Nothing stands there
        yet, and it is removed when the block raises.

    Raises
    ------
    OutputError
        The folder cannot be written, the storage is full, or the block wrote nothing.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with atomic_path(Path(folder) / "note.txt") as temporary:
    ...         _ = temporary.write_text("whole or absent")
    ...     (Path(folder) / "note.txt").read_text()
    'whole or absent'
    """
    target = Path(target)
    temporary = _sibling(target, "tmp", target.suffix)
    _require_writable_folder(target.parent, temporary)
    try:
        yield temporary
        if not temporary.is_file():
            msg = f"Nothing was written for {target}: {temporary.name} is missing when it should be put in place."
            raise OutputError(msg)
        _fsync(temporary)
        _replace(temporary, target)
    except OSError as error:
        if error.errno in _STORAGE_ERRNO:
            raise _cannot_write(target, error) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_directory(target: Path) -> Iterator[Path]:
    """
    Give an empty temporary folder beside `target` that becomes `target` when the block ends without error.

    Parameters
    ----------
    target : path
        Folder to publish. An existing folder is replaced as a whole; its old files do not survive. A symbolic link to
        a folder stays, and what it points to is replaced.

    Yields
    ------
    temporary : path
        Existing, empty folder; removed with everything in it when the block raises.

    Raises
    ------
    OutputError
        The parent folder cannot be written, `target` is a file, or the storage is full.

    Notes
    -----
    A folder that is not empty cannot be replaced by one rename, so the old one is first renamed to
    `NAME.old-<pid>-<random>`. A process killed between the two renames leaves no `target` and a complete old folder,
    which `clear_leftovers` puts back.
    """
    target = Path(target).resolve()
    temporary = _sibling(target, "tmp")
    _require_writable_folder(target.parent, temporary)
    if target.exists() and not target.is_dir():
        msg = f"Cannot write the folder {target}: a file of that name exists. Remove it or choose another folder."
        raise OutputError(msg)
    temporary.mkdir()
    try:
        yield temporary
        for path in sorted(temporary.rglob("*")):
            _fsync(path)
        _fsync(temporary)
        _swap_directory(temporary, target)
    except OSError as error:
        if error.errno in _STORAGE_ERRNO:
            raise _cannot_write(target, error) from error
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def clear_leftovers(directory: Path) -> list[Path]:
    """
    Remove what killed runs left in a folder, and put back a folder caught between its two renames.

    Parameters
    ----------
    directory : path
        Folder to search, subfolders included. The caller holds the lock: no other process is writing there.

    Returns
    -------
    cleared : list of path
        The temporary names that were removed or renamed back.
    """
    cleared = []
    for path in sorted(Path(directory).rglob("*")):
        match = _LEFTOVER.match(path.name)
        if match is None or not path.exists():  # inside a leftover folder removed a moment ago
            continue
        target = path.with_name(match["name"])
        if match["kind"] == "old" and not target.exists():
            path.rename(target)
            logger.warning("Put back %s, left aside by an interrupted run", target)
        elif path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
        cleared.append(path)
    return cleared


def write_json(path: Path, obj: Any) -> None:
    """
    Write a JSON document atomically: UTF-8, indented, keys in the order given.

    Parameters
    ----------
    path : path
    obj : object
        Mappings, sequences, numbers, strings, None, also numpy scalars and arrays, paths and dates (ISO 8601). NaN
        and infinities become null: JSON has neither.

    Raises
    ------
    OutputError
        The file cannot be written.
    TypeError
        `obj` holds something JSON cannot express.
    """
    text = json.dumps(_plain(obj), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: Path) -> Any:
    """
    Read a JSON document.

    Raises
    ------
    MissingInputError
        There is no such file.
    ModelStateError
        The file is not JSON; the message names line and column.
    """
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise _missing(path) from error
    except json.JSONDecodeError as error:
        msg = (
            f"{path} is damaged: {error.msg} at line {error.lineno}, column {error.colno}. "
            "Restore it from a backup, or remove it and run the step that writes it again."
        )
        raise ModelStateError(msg) from error
    except UnicodeDecodeError as error:
        msg = f"{path} is damaged: byte {error.start} is not UTF-8. Restore it, or run the step that writes it again."
        raise ModelStateError(msg) from error


def sha256_of_file(path: Path) -> str:
    """
    SHA-256 of a file's bytes, 64 hexadecimal digits.

    Raises
    ------
    MissingInputError
        There is no such file.
    """
    try:
        with Path(path).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except FileNotFoundError as error:
        raise _missing(path) from error


def write_dataset(path: Path, dataset: xr.Dataset, encoding: Mapping[str, Mapping[str, Any]] | None = None) -> None:
    """
    Write a dataset as NetCDF4, atomically.

    Parameters
    ----------
    path : path
    dataset : xarray.Dataset
    encoding : mapping of variable name to encoding, optional
        As `xarray.Dataset.to_netcdf` takes it. By default every numeric array is compressed without loss (zlib 4,
        shuffle).

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    if encoding is None:
        compressed = {"zlib": True, "complevel": 4, "shuffle": True}
        encoding = {str(n): compressed for n, v in dataset.variables.items() if v.ndim and v.dtype.kind in "biuf"}
    with atomic_path(path) as temporary:
        try:
            dataset.to_netcdf(temporary, mode="w", format="NETCDF4", engine="netcdf4", encoding=encoding)
        except (OSError, RuntimeError) as error:  # the netCDF library reports a full disk as "NetCDF: HDF error"
            raise _cannot_write(path, error) from error


def read_dataset(path: Path, *, decode_times: bool = False) -> xr.Dataset:
    """
    Read a whole NetCDF file into memory and close it.

    Parameters
    ----------
    path : path
    decode_times : bool
        Turn numbers with units "... since ..." into dates. Off by default: stored numbers come back as written.

    Raises
    ------
    MissingInputError
        There is no such file.
    ModelStateError
        The file is damaged, truncated or not NetCDF.
    """
    import xarray as xr

    path = Path(path)
    if not path.is_file():
        raise _missing(path)
    try:
        return xr.load_dataset(path, engine="netcdf4", decode_times=decode_times)
    except (OSError, RuntimeError, ValueError) as error:
        msg = (
            f"{path} cannot be read as NetCDF: {error}. Restore it from a backup, or run the step that writes it again."
        )
        raise ModelStateError(msg) from error


def _sibling(target: Path, kind: str, suffix: str = "") -> Path:
    return target.with_name(f"{target.name}.{kind}-{os.getpid()}-{secrets.token_hex(4)}{suffix}")


def _require_writable_folder(folder: Path, probe: Path) -> None:
    """Make `folder` where missing and prove, by creating and removing `probe`, that it takes new files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        msg = (
            f"Cannot write into {folder}: {error.strerror or error}. "
            "Choose another folder, or make this one a writable folder."
        )
        raise OutputError(msg) from error


def _replace(temporary: Path, target: Path) -> None:
    try:
        temporary.replace(target)
    except OSError as error:
        raise _cannot_write(target, error) from error
    _fsync(target.parent)


def _swap_directory(temporary: Path, target: Path) -> None:
    if not target.exists():
        _replace(temporary, target)
        return
    old = _sibling(target, "old")
    _replace(target, old)
    try:
        _replace(temporary, target)
    except OutputError:
        old.rename(target)
        raise
    try:
        shutil.rmtree(old)
    except OSError as error:  # the new folder is in place; what is left of the old one is only in the way
        logger.warning("Could not remove the replaced folder %s: %s", old, error)


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _cannot_write(target: Path, error: Exception) -> OutputError:
    reason = getattr(error, "strerror", None) or str(error)
    return OutputError(f"Cannot write {target}: {reason}. Free space, or choose another place to write to.")


def _missing(path: Path) -> MissingInputError:
    return MissingInputError(f"No such file: {path}. Check the name, or run the step that writes it.")


def _plain(obj: Any) -> Any:
    """Reduce to what JSON knows; numpy scalars and arrays answer `tolist`."""
    if hasattr(obj, "tolist"):
        obj = obj.tolist()
    if isinstance(obj, float):
        return obj if math.isfinite(obj) else None
    if isinstance(obj, dict):
        return {str(key): _plain(value) for key, value in obj.items()}
    if isinstance(obj, list | tuple):
        return [_plain(value) for value in obj]
    if isinstance(obj, PurePath):
        return str(obj)
    if isinstance(obj, date):  # datetime too
        return obj.isoformat()
    return obj
