"""
Results of the steps of a reconstruction, kept in a work folder so that an interrupted run goes on where it stopped.

One file a step. Each carries a key made of everything the step depends on: photos by checksum, poses, settings, and the
key of the step before. A file with another key, or a damaged one, is made anew.
"""

from __future__ import annotations

import hashlib
import json
import logging
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from changedetect.errors import ModelStateError
from changedetect.kernels.projection import N_CALIBRATION
from changedetect.navigation.frame import LocalFrame
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.anchored import FinishedFlight
from changedetect.photogrammetry.block import GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.covariance import PixelCorrelation
from changedetect.photogrammetry.orientation import Matching, Oriented
from changedetect.photogrammetry.rough import RoughOrientation
from changedetect.photogrammetry.ties import Features, PairMatches
from changedetect.storage import atomic_path

__all__ = ["FlightStore", "key_of", "load_finished", "save_finished"]

logger = logging.getLogger(__name__)

#: Changes when a step computes something else from the same input.
_FORMAT = 2
_ADJUSTMENT_ARRAYS = (
    "points", "weight", "origin", "camera_covariance", "lens_slope", "lens_correction", "lens_std", "boresight",
    "boresight_std", "pose_correction",
)  # fmt: skip


def key_of(*parts: Any) -> str:
    """
    Hash of arrays, settings and plain values; equal content gives an equal key.

    Examples
    --------
    >>> key_of("photos", 1.5) == key_of("photos", 1.5)
    True
    """
    digest = hashlib.sha256(str(_FORMAT).encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(str((part.dtype, part.shape)).encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        elif is_dataclass(part) and not isinstance(part, type):
            digest.update(key_of(type(part).__name__, *(getattr(part, f.name) for f in fields(part))).encode())
        elif isinstance(part, (list, tuple)):
            digest.update(key_of(*part).encode())
        else:
            digest.update(json.dumps(part, sort_keys=True, default=str).encode())
        digest.update(b"|")
    return digest.hexdigest()


class FlightStore:
    """
    Files of one flight's steps.

    Parameters
    ----------
    directory : path
        Made when first written to.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def save_features(self, key: str, features: list[Features]) -> None:
        """Keep the features of every photo."""
        counts = np.array([len(f) for f in features], dtype=np.int64)
        pixel, raw = (np.concatenate([getattr(f, name) for f in features]) for name in ("pixel", "raw"))
        self._save("features", key, {"counts": counts, "pixel": pixel, "raw": raw})

    def load_features(self, key: str) -> list[Features] | None:
        """Features kept under this key; None where there are none."""
        found = self._load("features", key)
        if found is None:
            return None
        cuts = np.cumsum(found["counts"])[:-1]
        parts = zip(np.split(found["pixel"], cuts), np.split(found["raw"], cuts), strict=True)
        return [Features(pixel, raw) for pixel, raw in parts]

    def save_rough(self, key: str, rough: RoughOrientation) -> None:
        """Keep a rough orientation."""
        arrays = {
            "given_rotation": rough.given.rotation,
            "rotation": rough.start.rotation,
            "position": rough.start.position,
            "intrinsics": rough.start.intrinsics,
            "is_turned": rough.is_turned,
            "is_joined": rough.is_joined,
            "ground_height": np.array(rough.ground_height),
            "n_pairs": np.array([rough.n_pairs, rough.n_tried]),
        }
        self._save("rough", key, arrays)

    def load_rough(self, key: str, stated: ImageBlock) -> RoughOrientation | None:
        """Rough orientation of a block kept under this key; None where there is none."""
        found = self._load("rough", key)
        if found is None:
            return None
        given = replace(stated, rotation=found["given_rotation"])
        start = replace(stated, rotation=found["rotation"], position=found["position"], intrinsics=found["intrinsics"])
        n_pairs, n_tried = (int(n) for n in found["n_pairs"])
        height = float(found["ground_height"])
        return RoughOrientation(given, start, found["is_turned"], found["is_joined"], height, n_pairs, n_tried)

    def save_matching(self, key: str, matching: Matching) -> None:
        """Keep tracks and ties."""
        g, pairs = matching.ground, matching.pairs
        arrays = {
            "ground": np.array([g.height, g.slope_east, g.slope_north, g.spread]),
            "strip": matching.strip,
            "n_pairs": np.array(matching.n_pairs),
            "pair": np.array([(p.first, p.second, len(p.match)) for p in pairs], dtype=np.int64).reshape(-1, 3),
            "match": np.concatenate([p.match for p in pairs]) if pairs else np.empty((0, 2), np.int64),
        }
        self._save("matching", key, arrays | _pack("tracks", matching.tracks) | _pack("ties", matching.ties))

    def load_matching(self, key: str) -> Matching | None:
        """Tracks and ties kept under this key; None where there are none."""
        found = self._load("matching", key)
        if found is None:
            return None
        matches = np.split(found["match"], np.cumsum(found["pair"][:, 2])[:-1])
        pairs = [PairMatches(int(i), int(j), m) for (i, j, _), m in zip(found["pair"], matches, strict=False)]
        ground = GroundPlane(*(float(v) for v in found["ground"]))
        tracks, ties = _unpack("tracks", found), _unpack("ties", found)
        return Matching(ground, found["strip"], tracks, pairs, ties, int(found["n_pairs"]))

    def save_oriented(self, key: str, oriented: Oriented) -> None:
        """Keep an adjustment."""
        arrays = _adjustment_arrays(oriented.adjustment)
        self._save("adjustment", key, arrays | _pack("given", oriented.observations))

    def load_oriented(self, key: str, given: ImageBlock) -> Oriented | None:
        """Adjustment of a block kept under this key; None where there is none."""
        found = self._load("adjustment", key)
        if found is None:
            return None
        return Oriented(_adjustment_from(found, given), _unpack("given", found))

    def _save(self, name: str, key: str, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        with atomic_path(self.directory / f"{name}.npz") as temporary, temporary.open("wb") as stream:
            np.savez(stream, key=np.array(key), **arrays)  # type: ignore[arg-type]

    def _load(self, name: str, key: str) -> dict[str, np.ndarray[Any, Any]] | None:
        path = self.directory / f"{name}.npz"
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                if str(stored["key"]) != key:
                    logger.info("%s belongs to other photos, poses or settings; made anew", path)
                    return None
                found = {entry: stored[entry] for entry in stored.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            logger.warning("%s is damaged (%s); made anew", path, error)
            return None
        logger.info("%s: kept from an earlier run", path)
        return found


def save_finished(path: Path, flight: FinishedFlight) -> None:
    """Write the final adjustment of a flight, with all that later flights need to be adjusted to it."""
    block, origin = flight.adjustment.block, flight.origin
    arrays = _adjustment_arrays(flight.adjustment) | {
        "names": np.array(block.names),
        "size": block.size,
        "lens": block.lens,
        "flight": block.flight,
        "origin": np.array([origin.latitude, origin.longitude, origin.height]),
        "format": np.array(_FORMAT),
        "bound_to": np.array(list(flight.cross), dtype=np.str_),
    }
    arrays |= {f"cross_{k}": values for k, values in enumerate(flight.cross.values())}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **arrays)


def load_finished(path: Path) -> FinishedFlight:
    """
    Read what `save_finished` wrote.

    Raises
    ------
    ModelStateError
        The file is missing, damaged, or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            found = {entry: stored[entry] for entry in stored.files}
        if int(found["format"]) != _FORMAT:
            msg = f"'{path}' is of format {int(found['format'])}, this version of changedetect reads {_FORMAT}."
            raise ModelStateError(msg)
        names = tuple(str(name) for name in found["names"])
        poses = found["rotation"], found["position"], found["intrinsics"]
        given = ImageBlock(names, *poses, found["size"], found["lens"], found["flight"])
        latitude, longitude, height = (float(v) for v in found["origin"])
        found = _with_all_lens_parameters(found)
        cross = {str(name): found[f"cross_{k}"] for k, name in enumerate(found["bound_to"])}
        return FinishedFlight(_adjustment_from(found, given), LocalFrame(latitude, longitude, height), cross)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        msg = f"'{path}' cannot be read ({error}). `changedetect update` makes it anew once the folder is removed."
        raise ModelStateError(msg) from error


def _with_all_lens_parameters(found: Mapping[str, np.ndarray[Any, Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """
    Arrays of a flight as versions wrote it that knew five lens parameters: the others are exact.

    Rows of poses and lenses are found by their number; the lens comes last, and there is one in flights with others.
    """
    out = dict(found)
    n_lenses = len(found["intrinsics"])
    n = 6 * len(found["names"])
    before = (len(found["camera_covariance"]) - n) // n_lenses
    if before == N_CALIBRATION and "lens_slope" in found:
        return out
    rows = np.concatenate([np.arange(n), *(n + N_CALIBRATION * k + np.arange(before) for k in range(n_lenses))])
    size = n + N_CALIBRATION * n_lenses
    out["camera_covariance"] = np.zeros((size, size))
    out["camera_covariance"][np.ix_(rows, rows)] = found["camera_covariance"]
    out["lens_slope"] = np.zeros((size, size - n))
    for name in ("lens_correction", "lens_std"):
        out[name] = np.pad(found[name], ((0, 0), (0, N_CALIBRATION - before)))
    for k in range(len(found["bound_to"])):
        missing = N_CALIBRATION - before
        out[f"cross_{k}"] = np.pad(found[f"cross_{k}"], ((0, missing), (0, missing)))
    return out


def _adjustment_arrays(a: Adjustment) -> dict[str, np.ndarray[Any, Any]]:
    arrays: dict[str, np.ndarray[Any, Any]] = {name: getattr(a, name) for name in _ADJUSTMENT_ARRAYS}
    arrays |= {
        "rotation": a.block.rotation,
        "position": a.block.position,
        "intrinsics": a.block.intrinsics,
        "correlation": np.vstack([a.correlation.distance, a.correlation.correlation]),
        "design_effect": np.array(a.correlation.design_effect),
        "prior_chi2": np.array(a.prior_chi2),
    }
    return arrays | _pack("kept", a.observations)


def _adjustment_from(found: Mapping[str, np.ndarray[Any, Any]], given: ImageBlock) -> Adjustment:
    block = ImageBlock(
        given.names, found["rotation"], found["position"], found["intrinsics"], given.size, given.lens, given.flight
    )
    distance, correlation = found["correlation"]
    return Adjustment(
        block=block,
        observations=_unpack("kept", found),
        correlation=PixelCorrelation(distance, correlation, float(found["design_effect"])),
        prior_chi2=float(found["prior_chi2"]),
        **{name: found[name] for name in _ADJUSTMENT_ARRAYS},
    )


def _pack(name: str, observations: Observations) -> dict[str, np.ndarray[Any, Any]]:
    return {f"{name}_{f.name}": getattr(observations, f.name) for f in fields(observations)}


def _unpack(name: str, found: Mapping[str, np.ndarray[Any, Any]]) -> Observations:
    return Observations(**{f.name: found[f"{name}_{f.name}"] for f in fields(Observations)})
