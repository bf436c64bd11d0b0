"""Survey epochs and their sources, as `epochs/EPOCH_ID.toml` describes them."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from changedetect.config import build_from_table, format_toml_value, read_toml
from changedetect.errors import ConfigError, MissingInputError
from changedetect.storage import atomic_path
from changedetect.typing import Region

__all__ = [
    "EPOCH_FORMAT_VERSION",
    "Epoch",
    "Source",
    "parse_date",
    "read_epoch",
    "survey_time_days",
    "validate_epoch_id",
    "write_epoch",
]

#: Version of the layout of `epochs/EPOCH_ID.toml`.
EPOCH_FORMAT_VERSION = 1

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_EPOCH_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_VARIABLE = re.compile(r"\$\{(\w+)\}")


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Source:
    """
    One file of observations, or the folder of a flight, and how it is to be read.

    Attributes
    ----------
    uri : str
        Path of the file, relative to the programme's folder; ``${NAME}`` stands for an environment variable.
    kind : {"points", "flight"}
        A file of observations, or a folder with photos and logs that `update` makes points from.
    crs : str or None
        CRS of the file where the file itself does not say it.
    sigma : float or None, m
        Standard deviation of one elevation where the file does not say it.
    classes : tuple of int or None
        Point classes to use; None uses all.
    columns : tuple of str or None
        Names of the columns of a text file.
    nodata : float or None
        Elevation that marks a missing value where the file does not say it; NaN is allowed.
    band : int
        Band of a raster, from 1.
    sha256, size, n_points : str, int (bytes), int, or None
        What `add` found. A later change of the file is then noticed; None: taken as found when it is learned. For a
        flight `sha256` is that of `files` as `sha256sum` would list them, sorted by name.
    n_photos : int or None
        Of a flight.
    files : mapping of str to str, or None
        SHA-256 of every file of a flight, by its path relative to the folder.
    """

    uri: Annotated[str, Field(min_length=1)]
    kind: Literal["points", "flight"] = "points"
    crs: str | None = None
    sigma: Annotated[float, Field(gt=0)] | None = None
    classes: tuple[Annotated[int, Field(ge=0, le=255)], ...] | None = None
    columns: tuple[str, ...] | None = None
    nodata: Annotated[float, Field(allow_inf_nan=True)] | None = None
    band: Annotated[int, Field(ge=1)] = 1
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    size: Annotated[int, Field(ge=0)] | None = None
    n_points: Annotated[int, Field(ge=0)] | None = None
    n_photos: Annotated[int, Field(ge=0)] | None = None
    files: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] | None = None

    @property
    def is_flight(self) -> bool:
        """Whether it is the folder of a flight."""
        return self.kind == "flight"

    @property
    def name(self) -> str:
        """File name without its folders."""
        return self.uri.rpartition("/")[2]

    def path(self, programme_directory: Path, environment: Mapping[str, str] | None = None) -> Path:
        """
        Return where the file lies.

        Raises
        ------
        MissingInputError
            The path needs an environment variable that is not set.
        """
        variables = os.environ if environment is None else environment

        def value_of(match: re.Match[str]) -> str:
            if match[1] not in variables:
                msg = (
                    f"Source '{self.uri}' needs the environment variable {match[1]}, which is not set. "
                    f"Set it to the folder that holds the data: export {match[1]}=/path/to/data."
                )
                raise MissingInputError(msg)
            return variables[match[1]]

        return programme_directory / Path(_VARIABLE.sub(value_of, self.uri)).expanduser()

    def reading_options(self) -> dict[str, Any]:
        """Return what decides which observations the file yields."""
        if self.is_flight:
            return {"kind": self.kind}
        return {
            "crs": self.crs,
            "sigma": self.sigma,
            "classes": None if self.classes is None else list(self.classes),
            "columns": None if self.columns is None else list(self.columns),
            "nodata": "nan" if self.nodata is not None and math.isnan(self.nodata) else self.nodata,
            "band": self.band,
        }


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Epoch:
    """
    One acquisition of the terrain.

    Attributes
    ----------
    epoch_id : str
    date : datetime, UTC, without time zone
        When the terrain was surveyed; midnight where only the day is known.
    sources : tuple of Source
    label : str
        A remark for people.
    region : tuple (west, east, south, north) or None, m
        Ground that `add` found the sources to cover, in the programme's CRS.
    """

    epoch_id: str
    date: datetime
    sources: Annotated[tuple[Source, ...], Field(min_length=1)]
    label: str = ""
    region: Region | None = None

    def __post_init__(self) -> None:
        """Refuse a flight beside other sources: each is an epoch of its own."""
        if len(self.sources) > 1 and any(source.is_flight for source in self.sources):
            msg = "a flight is an epoch of its own; give each flight, and files of points, an epoch each"
            raise ValueError(msg)

    @property
    def flight(self) -> Source | None:
        """The flight this epoch is made of; None where it consists of files of points."""
        return self.sources[0] if self.sources[0].is_flight else None

    @property
    def survey_time(self) -> float:
        """Days since 1970-01-01."""
        return survey_time_days(self.date)

    @property
    def date_text(self) -> str:
        """ISO 8601, the day alone where the hour is not known."""
        return _date_text(self.date)


def survey_time_days(moment: datetime) -> float:
    """
    Days since 1970-01-01T00:00.

    Examples
    --------
    >>> survey_time_days(datetime(1970, 1, 2, 12))
    1.5
    """
    return (moment - datetime(1970, 1, 1)).total_seconds() / 86400.0


def parse_date(value: str | date, what: str = "date") -> datetime:
    """
    Read a date, or date and time, in ISO 8601; a time zone is converted to UTC.

    Raises
    ------
    ConfigError
        The text is no such date.

    Examples
    --------
    >>> parse_date("2024-05-01T14:30+02:00")
    datetime.datetime(2024, 5, 1, 12, 30)
    """
    if isinstance(value, str):
        try:
            value = datetime.fromisoformat(value)
        except ValueError as error:
            msg = f"{what} {value!r} is not a date. Write it like 2024-05-01 or 2024-05-01T14:30."
            raise ConfigError(msg) from error
    if not isinstance(value, datetime):
        return datetime.combine(value, time())
    return value if value.tzinfo is None else value.astimezone(UTC).replace(tzinfo=None)


def validate_epoch_id(epoch_id: str) -> str:
    """
    Return the id, fit for a folder's name on any system.

    Raises
    ------
    ConfigError
        It holds other characters than letters, digits, ``-``, ``_`` and ``.``, or is empty or too long.
    """
    if not _EPOCH_ID.fullmatch(epoch_id) or epoch_id.endswith("."):
        msg = (
            f"{epoch_id!r} is not an epoch id. Use up to 64 letters, digits, '-', '_' and '.', beginning with a "
            "letter or digit and not ending with '.', such as 2024-05-01."
        )
        raise ConfigError(msg)
    return epoch_id


def read_epoch(path: Path) -> Epoch:
    """
    Read `epochs/EPOCH_ID.toml`; the id is the file's name.

    Raises
    ------
    ConfigError
        A key is unknown or a value not allowed; the message names file and key.
    """
    table = read_toml(path)
    version = table.pop("format_version", EPOCH_FORMAT_VERSION)
    if version != EPOCH_FORMAT_VERSION:
        msg = f"{path}: format_version = {version!r}; this version of changedetect reads {EPOCH_FORMAT_VERSION}."
        raise ConfigError(msg)
    epoch_id = validate_epoch_id(path.name.removesuffix(".toml"))
    sources, moment = table.get("sources"), table.get("date")
    if not isinstance(sources, list) or not sources:
        msg = f"{path}: an epoch needs at least one table [[sources]] with a uri."
        raise ConfigError(msg)
    if not isinstance(moment, str | date):
        msg = f"{path}: date = {moment!r}; the date of the survey is needed, like date = 2024-05-01."
        raise ConfigError(msg)
    table["sources"] = [
        build_from_table(Source, _with_tuples(source), f"{path}, [[sources]] {number}")
        for number, source in enumerate(sources, start=1)
    ]
    table["date"] = parse_date(moment, f"{path}: date")
    return build_from_table(Epoch, _with_tuples(table), str(path), epoch_id=epoch_id)


def _with_tuples(table: Any) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in dict(table).items()}


def write_epoch(path: Path, epoch: Epoch) -> None:
    """Write `epochs/EPOCH_ID.toml` atomically; None values are left out."""
    lines = [f"format_version = {EPOCH_FORMAT_VERSION}", f"date = {epoch.date_text}"]
    if epoch.label:
        lines.append(f"label = {format_toml_value(epoch.label)}")
    if epoch.region is not None:
        lines.append(f"region = {format_toml_value(epoch.region)}")
    for source in epoch.sources:
        lines += ["", "[[sources]]", f"uri = {format_toml_value(source.uri)}"]
        known = {
            **source.reading_options(),
            "nodata": source.nodata,
            "sha256": source.sha256,
            "size": source.size,
            "n_points": source.n_points,
            "n_photos": source.n_photos,
        }
        if source.band == 1:
            known.pop("band", None)
        lines += [f"{key} = {format_toml_value(value)}" for key, value in known.items() if value is not None]
        if source.files:
            lines += ["", "[sources.files]"]
            lines += [f"{format_toml_value(name)} = {format_toml_value(value)}" for name, value in source.files.items()]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _date_text(moment: datetime) -> str:
    return moment.date().isoformat() if moment.time() == time() else moment.isoformat()
