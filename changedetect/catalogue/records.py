"""
Manifests: what a stored model or a folder of products was made from.

A manifest is the identity of what lies beside it: its own SHA-256 is what children refer to, so that a model learned
again makes everything derived from it stale.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

from changedetect.errors import ModelStateError
from changedetect.storage import read_json, sha256_of_file, write_json

if TYPE_CHECKING:
    from changedetect.coregistration import Alignment

__all__ = [
    "MANIFEST_FILE",
    "AlignmentRecord",
    "AnchorRecord",
    "CommonErrorRecord",
    "ProductRecord",
    "ReconstructionRecord",
    "SourceRecord",
    "StateRecord",
    "damaged_files",
    "describe_files",
]

MANIFEST_FILE = "manifest.json"

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class SourceRecord:
    """
    A source as it was read.

    Attributes
    ----------
    uri : str
    sha256 : str
    size : int, bytes
    modified_ns : int
        Modification time of the file, ns since 1970: tells quickly that nothing happened to it.
    options : mapping
        `Source.reading_options`.
    n_read, n_used : int
        Points in the file after its filters, and those inside the programme's bounds.
    crs : str or None
        CRS the points were taken to be in.
    derived_sha256 : str or None
        Checksum of the manifest of the points that were made from it, where it is a flight.
    """

    uri: str
    sha256: str
    size: int
    modified_ns: int
    options: Mapping[str, Any]
    n_read: int
    n_used: int
    crs: str | None
    derived_sha256: str | None = None


@dataclass(frozen=True, kw_only=True)
class AlignmentRecord:
    """
    How an epoch was aligned to the reference surface, the model of the first epoch.

    Attributes
    ----------
    reference : str
        Epoch id.
    reference_sha256 : str
        `StateRecord.evidence_sha256` of that epoch.
    stable_areas_sha256 : str or None
        Checksum of the file of stable areas; None where unchanged ground was found.
    is_applied : bool
        Whether the epoch's points were moved.
    wording : str
        What was found and done, for people.
    warnings : tuple of str
    estimate : mapping or None
        `Alignment.to_dict`: transform, covariance, residuals, the choice; None where nothing could be estimated, or
        nothing had to be.
    shared_with : str or None
        Epoch to whose photos this flight was adjusted, so that it lies as that one does: it was moved as that one was,
        or not at all, and `estimate` is that one's transform, or what co-registration would have done.
    """

    reference: str
    reference_sha256: str
    stable_areas_sha256: str | None
    is_applied: bool
    wording: str
    warnings: tuple[str, ...]
    estimate: Mapping[str, Any] | None
    shared_with: str | None = None

    @property
    def kind(self) -> str:
        """The kind of transform that was applied, "photos" where photos bind the epoch to another, or "none"."""
        if self.shared_with is not None:
            return "photos"
        return str(self.estimate["transform"]["kind"]) if self.is_applied and self.estimate else "none"

    def applied(self) -> Alignment | None:
        """
        Return the alignment that moved the epoch; None where it was not moved.

        Raises
        ------
        ValueError, KeyError
            The record was written by another version.
        """
        from changedetect.coregistration import Alignment  # compiled code, which listing epochs has no use for

        return Alignment.from_dict(dict(self.estimate)) if self.is_applied and self.estimate else None


class _Manifest:
    """Reading and writing shared by the manifests below."""

    FORMAT: ClassVar[int]

    @classmethod
    def read(cls, directory: Path) -> tuple[Self, str] | None:
        """
        Read the manifest of a folder, and its SHA-256; None where there is none.

        Raises
        ------
        ModelStateError
            The manifest is damaged, or lacks what this version writes.
        """
        path = directory / MANIFEST_FILE
        if not path.is_file():
            return None
        document = read_json(path)
        version = document.get("format_version") if isinstance(document, dict) else None
        if version != cls.FORMAT:
            msg = (
                f"'{path}' has format_version {version!r}, this version of changedetect reads {cls.FORMAT}. "
                "`changedetect update` makes the folder anew."
            )
            raise ModelStateError(msg)
        return cls.from_document(document, path), sha256_of_file(path)

    @classmethod
    def from_document(cls, document: Mapping[str, Any], path: Path) -> Self:
        """Build from the JSON object of `path`."""
        return _from_document(cls, document, path)

    def write(self, directory: Path) -> None:
        """Write the manifest into a folder."""
        document = {"format_version": self.FORMAT, **asdict(self)}  # type: ignore[call-overload]
        write_json(directory / MANIFEST_FILE, document)


@dataclass(frozen=True, kw_only=True)
class StateRecord(_Manifest):
    """
    Manifest of `state/EPOCH_ID/`.

    Attributes
    ----------
    epoch_id : str
    mode : str
        "adaptive" or "reference".
    survey_time : float
        Days since 1970-01-01.
    parent, parent_sha256 : str or None
        Epoch whose model was adapted, and its manifest's checksum.
    settings : mapping
        `ProgrammeConfig.learning_settings`.
    learning_sha256, config_sha256 : str
        Fingerprints of the settings.
    sources : tuple of SourceRecord
    alignment : AlignmentRecord or None
        None for the reference itself, and where co-registration is switched off.
    n_points : int
        Observations learned in this epoch.
    region : tuple (west, east, south, north), m
        Ground the model has observed up to this epoch.
    files : mapping of file name to its size, bytes, and SHA-256
    software_version, created : str
    """

    FORMAT: ClassVar[int] = 2

    epoch_id: str
    mode: str
    survey_time: float
    parent: str | None
    parent_sha256: str | None
    settings: Mapping[str, Any]
    learning_sha256: str
    config_sha256: str
    sources: tuple[SourceRecord, ...]
    alignment: AlignmentRecord | None
    n_points: int
    region: tuple[float, float, float, float]
    files: Mapping[str, Mapping[str, Any]]
    software_version: str
    created: str

    @classmethod
    def from_document(cls, document: Mapping[str, Any], path: Path) -> Self:
        """Build from the JSON object of `path`."""
        sources = tuple(_from_document(SourceRecord, item, path) for item in document.get("sources", []))
        region = tuple(document.get("region", ()))
        alignment = document.get("alignment")
        if alignment is not None:
            listed = {**alignment, "warnings": tuple(alignment.get("warnings", ()))}
            alignment = _from_document(AlignmentRecord, listed, path)
        given: dict[str, Any] = {"sources": sources, "region": region}
        if "alignment" in document:
            given["alignment"] = alignment
        return _from_document(cls, {**document, **given}, path)

    @property
    def evidence_sha256(self) -> str:
        """Fingerprint of what the epoch's own evidence follows from: its sources, how they are read, the settings."""
        parts = [self.epoch_id, self.survey_time, self.learning_sha256, self.n_points]
        parts += [[source.sha256, dict(source.options)] for source in self.sources]
        parts += [source.derived_sha256 for source in self.sources if source.derived_sha256 is not None]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class ProductRecord(_Manifest):
    """
    Manifest of `products/EPOCH_ID/` (one epoch) or `products/EARLIER_LATER/` (two).

    Attributes
    ----------
    epochs : tuple of str
        One epoch, or the earlier and the later one.
    states : mapping of epoch id to the SHA-256 of its state's manifest
    settings : mapping
        `ProgrammeConfig.product_settings`.
    config_sha256 : str
    region : tuple (west, east, south, north), m
        Ground the rasters cover.
    colour_limits : mapping of layer to (low, high)
        Limits of the styles; the programme's other maps take them over.
    warnings : tuple of str
    files : mapping of file name to its size, bytes, and SHA-256
    software_version, run_id, created : str
    """

    FORMAT: ClassVar[int] = 2

    epochs: tuple[str, ...]
    states: Mapping[str, str]
    settings: Mapping[str, Any]
    config_sha256: str
    region: tuple[float, float, float, float]
    colour_limits: Mapping[str, tuple[float, float]]
    warnings: tuple[str, ...]
    files: Mapping[str, Mapping[str, Any]]
    software_version: str
    run_id: str
    created: str

    @classmethod
    def from_document(cls, document: Mapping[str, Any], path: Path) -> Self:
        """Build from the JSON object of `path`."""
        tuples = {key: tuple(document.get(key, ())) for key in ("epochs", "region", "warnings")}
        return _from_document(cls, {**document, **tuples}, path)


@dataclass(frozen=True, kw_only=True)
class CommonErrorRecord:
    """
    Error that all points of a flight, or the difference of two, have alike.

    Attributes
    ----------
    centre : tuple (easting, northing), m
        Where the offset is that of the covariance.
    covariance : 8 x 8 numbers
        Of offset (m), tilt east, tilt north (m per m), shift east, shift north (m), bending east, across, north (m per
        m^2: of e^2, e n, n^2). Records of earlier versions hold the first five.
    residual_std : float, m
        What poses and lens leave after these, root mean square over the points.
    """

    centre: tuple[float, float]
    covariance: tuple[tuple[float, ...], ...]
    residual_std: float

    @classmethod
    def from_document(cls, document: Mapping[str, Any], path: Path) -> Self:
        """Build from a JSON object of `path`."""
        lists = {
            "centre": tuple(document.get("centre", ())),
            "covariance": tuple(tuple(row) for row in document.get("covariance", ())),
        }
        return _from_document(cls, {**document, **lists}, path)


@dataclass(frozen=True, kw_only=True)
class AnchorRecord:
    """
    An earlier flight that a flight was adjusted to.

    Attributes
    ----------
    epoch_id : str
    sha256 : str
        Of the manifest of its points.
    n_shared, n_moved : int
        Ground points seen by both flights that bind them, and those left out because their ground changed.
    difference : CommonErrorRecord or None
        Of the later less the earlier heights; None where too few points are shared, so that nothing binds them.
    """

    epoch_id: str
    sha256: str
    n_shared: int
    n_moved: int
    difference: CommonErrorRecord | None

    @classmethod
    def from_document(cls, document: Mapping[str, Any], path: Path) -> Self:
        """Build from a JSON object of `path`."""
        difference = document.get("difference")
        if difference is not None:
            difference = CommonErrorRecord.from_document(difference, path)
        return _from_document(cls, {**document, "difference": difference}, path)


@dataclass(frozen=True, kw_only=True)
class ReconstructionRecord(_Manifest):
    """
    Manifest of `flights/EPOCH_ID/points/`.

    Attributes
    ----------
    epoch_id : str
    source_uri, source_sha256 : str
        Folder of the flight and checksum of its listing.
    settings : mapping
        `ProgrammeConfig.flight_settings`.
    crs : str
        Of the points.
    origin : tuple (latitude, longitude, height), degrees and m above the ellipsoid
        Of the local frame of `orientation.npz`.
    photo_key, matching_key : str
        Of the steps that the points follow from.
    n_photos, n_points : int
    region : tuple (west, east, south, north), m
    common_error : CommonErrorRecord
        Of the flight's heights against the Earth.
    anchors : tuple of AnchorRecord
        Earlier flights it was to be adjusted to.
    warnings : tuple of str
    files : mapping of file name to its size, bytes, and SHA-256
    software_version, created : str
    """

    FORMAT: ClassVar[int] = 1

    epoch_id: str
    source_uri: str
    source_sha256: str
    settings: Mapping[str, Any]
    crs: str
    origin: tuple[float, float, float]
    photo_key: str
    matching_key: str
    n_photos: int
    n_points: int
    region: tuple[float, float, float, float]
    common_error: CommonErrorRecord
    anchors: tuple[AnchorRecord, ...]
    warnings: tuple[str, ...]
    files: Mapping[str, Mapping[str, Any]]
    software_version: str
    created: str

    @classmethod
    def from_document(cls, document: Mapping[str, Any], path: Path) -> Self:
        """Build from the JSON object of `path`."""
        lists = ("origin", "region", "warnings")
        given: dict[str, Any] = {key: tuple(document[key]) for key in lists if key in document}
        given["anchors"] = tuple(AnchorRecord.from_document(item, path) for item in document.get("anchors", []))
        given["common_error"] = CommonErrorRecord.from_document(document.get("common_error", {}), path)
        return _from_document(cls, {**document, **given}, path)

    @property
    def bound(self) -> tuple[str, ...]:
        """Epochs it was really adjusted to."""
        return tuple(anchor.epoch_id for anchor in self.anchors if anchor.difference is not None)


def _from_document(owner: type[T], document: Mapping[str, Any], path: Path) -> T:
    names = [part.name for part in fields(owner)]  # type: ignore[arg-type]
    needed = [part.name for part in fields(owner) if part.default is MISSING]  # type: ignore[arg-type]
    missing = [name for name in needed if name not in document]
    if missing:
        msg = f"'{path}' is damaged: it lacks {', '.join(missing)}. `changedetect update` makes the folder anew."
        raise ModelStateError(msg)
    return owner(**{name: document[name] for name in names if name in document})


def describe_files(directory: Path) -> dict[str, dict[str, Any]]:
    """Size (bytes) and SHA-256 of every file below a folder, by its path relative to it, without the manifest."""
    paths = sorted(path for path in directory.rglob("*") if path.is_file() and path.name != MANIFEST_FILE)
    return {
        path.relative_to(directory).as_posix(): {"size": path.stat().st_size, "sha256": sha256_of_file(path)}
        for path in paths
    }


def damaged_files(directory: Path, files: Mapping[str, Mapping[str, Any]], *, deep: bool) -> list[str]:
    """
    Say which of a manifest's files are missing, have another size or, with `deep`, another checksum.

    Returns
    -------
    complaints : list of str
    """
    complaints = []
    for name, expected in files.items():
        path = directory / name
        if not path.is_file():
            complaints.append(f"{name} is missing")
        elif path.stat().st_size != expected["size"]:
            complaints.append(f"{name} has {path.stat().st_size} bytes, was written with {expected['size']}")
        elif deep and sha256_of_file(path) != expected["sha256"]:
            complaints.append(f"{name} differs from its checksum")
    return complaints
