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
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.covariance import PixelCorrelation
from changedetect.photogrammetry.orientation import Matching, Oriented
from changedetect.photogrammetry.ties import Features, PairMatches
from changedetect.storage import atomic_path

__all__ = ["FlightStore", "key_of"]

logger = logging.getLogger(__name__)

#: Changes when a step computes something else from the same input.
_FORMAT = 2
_ADJUSTMENT_ARRAYS = (
    "points", "weight", "origin", "camera_covariance", "lens_correction", "lens_std", "boresight", "boresight_std",
    "pose_correction",
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
        a = oriented.adjustment
        arrays = {name: getattr(a, name) for name in _ADJUSTMENT_ARRAYS}
        arrays |= {
            "rotation": a.block.rotation,
            "position": a.block.position,
            "intrinsics": a.block.intrinsics,
            "correlation": np.vstack([a.correlation.distance, a.correlation.correlation]),
            "design_effect": np.array(a.correlation.design_effect),
            "prior_chi2": np.array(a.prior_chi2),
        }
        packed = _pack("kept", a.observations) | _pack("given", oriented.observations)
        self._save("adjustment", key, arrays | packed)

    def load_oriented(self, key: str, given: ImageBlock) -> Oriented | None:
        """Adjustment of a block kept under this key; None where there is none."""
        found = self._load("adjustment", key)
        if found is None:
            return None
        block = ImageBlock(
            given.names, found["rotation"], found["position"], found["intrinsics"], given.size, given.lens, given.flight
        )
        distance, correlation = found["correlation"]
        adjustment = Adjustment(
            block=block,
            observations=_unpack("kept", found),
            correlation=PixelCorrelation(distance, correlation, float(found["design_effect"])),
            prior_chi2=float(found["prior_chi2"]),
            **{name: found[name] for name in _ADJUSTMENT_ARRAYS},
        )
        return Oriented(adjustment, _unpack("given", found))

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


def _pack(name: str, observations: Observations) -> dict[str, np.ndarray[Any, Any]]:
    return {f"{name}_{f.name}": getattr(observations, f.name) for f in fields(observations)}


def _unpack(name: str, found: Mapping[str, np.ndarray[Any, Any]]) -> Observations:
    return Observations(**{f.name: found[f"{name}_{f.name}"] for f in fields(Observations)})
