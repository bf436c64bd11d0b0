"""
Which way photos are turned, from the photos and where they were taken.

Compasses of small aircraft err by tens of degrees, cameras sit turned by a quarter in the fuselage, and cameras turn
their pictures upside down on their own. Matches tell: seen from above, the place of the next photo lies in some
direction in this photo; on the ground that direction is known from the positions.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.ties import Features, PairMatches
from changedetect.typing import BoolArray, FloatArray

__all__ = ["Headings", "correct_headings", "estimate_headings"]

logger = logging.getLogger(__name__)

#: Estimates of a heading that it needs, and how far apart they may lie (robust standard deviation, rad).
_MIN_ESTIMATES, _MAX_SPREAD = 3, np.radians(25.0)
#: Stated headings further off than this are not believed; sooner, the adjustment finds the rest, rad.
_MAX_OFF = np.radians(45.0)
#: A photo this near to a quarter or half turn is a turned picture or mounting, not a wrong compass, rad.
_QUARTER = np.radians(20.0)
#: Directions between photos nearer than this share of the usual distance are not used.
_MIN_BASELINE = 0.2


@dataclass(frozen=True)
class Headings:
    """
    Headings seen in the photos.

    Attributes
    ----------
    off : array, shape (n,), rad
        Seen minus assumed, clockwise, of the top of each photo; NaN where too few matches say.
    spread : array, shape (n,), rad
        Robust standard deviation of the estimates of each.
    """

    off: FloatArray
    spread: FloatArray


def estimate_headings(features: Sequence[Features], pairs: Sequence[PairMatches], block: ImageBlock) -> Headings:
    """
    Estimate how far each photo is turned from what its pose says.

    Parameters
    ----------
    features : sequence of Features
    pairs : sequence of PairMatches
    block : ImageBlock
        Poses as stated: positions good to a fraction of their distance, tilts to some degrees, headings to nothing.

    Notes
    -----
    With rays turned level and cut at unit depth, g_i = s exp(i a) g_j + t holds for the matches of photos i and j over
    flat ground; t is the place of j as seen in i. Its direction minus that of P_j - P_i is the error of the heading of
    i; -t exp(-i a) / s gives that of j. Both differ by a, which no position enters: so each photo is also given the
    estimates of those it matches, and the median of all.
    """
    own: list[list[float]] = [[] for _ in range(len(block))]
    links: list[tuple[int, int, float]] = []
    place = block.position[:, 0] + 1j * block.position[:, 1]
    distances = [abs(place[p.second] - place[p.first]) for p in pairs]
    usual = float(np.median(distances)) if distances else 0.0
    for pair, distance in zip(pairs, distances, strict=True):
        if distance < _MIN_BASELINE * usual or distance == 0:
            continue
        first = _level(block, pair.first, features[pair.first].pixel[pair.match[:, 0]])
        second = _level(block, pair.second, features[pair.second].pixel[pair.match[:, 1]])
        seen = np.isfinite(first) & np.isfinite(second)
        if seen.sum() < 3:
            continue
        turn, shift = _similarity(second[seen], first[seen])
        along = place[pair.second] - place[pair.first]
        own[pair.first].append(float(np.angle(shift / along)))
        own[pair.second].append(float(np.angle((shift / turn) / along)))
        links.append((pair.first, pair.second, float(np.angle(turn))))
    pooled = [list(angles) for angles in own]
    for i, j, turned in links:
        pooled[i] += [angle + turned for angle in own[j]]
        pooled[j] += [angle - turned for angle in own[i]]
    off, spread = np.full(len(block), np.nan), np.full(len(block), np.nan)
    for image, angles in enumerate(pooled):
        if len(angles) >= _MIN_ESTIMATES:
            off[image], spread[image] = _circular_median(np.array(angles))
    return Headings(off, spread)


def correct_headings(block: ImageBlock, headings: Headings, stated: BoolArray) -> tuple[ImageBlock, BoolArray]:
    """
    Turn photos whose stated heading the pictures contradict, and those that state none.

    Parameters
    ----------
    block : ImageBlock
    headings : Headings
    stated : array, shape (n,), bool
        Which photos state a heading.

    Returns
    -------
    block : ImageBlock
    is_corrected : array, shape (n,), bool
    """
    known = np.isfinite(headings.off) & (headings.spread <= _MAX_SPREAD)
    off = np.where(known, np.nan_to_num(headings.off), 0.0)
    corrected = known & (~stated | (np.abs(off) > _MAX_OFF))
    rotation = block.rotation.copy()
    quarters = np.rint(off / (np.pi / 2)) * np.pi / 2
    is_turned = stated & (np.abs(off - quarters) <= _QUARTER)
    for image in np.flatnonzero(corrected):
        if is_turned[image]:  # about the axis of the camera: its tilt is not in question
            rotation[image] = rotation[image] @ Rotation.from_rotvec([0.0, 0.0, quarters[image]]).as_matrix()
        else:
            rotation[image] = Rotation.from_rotvec([0.0, 0.0, -off[image]]).as_matrix() @ rotation[image]
    _report(block, off, corrected & stated, is_turned)
    return replace(block, rotation=rotation), corrected


def _report(block: ImageBlock, off: FloatArray, wrong: BoolArray, is_turned: BoolArray) -> None:
    for mask, what in (
        (wrong & is_turned, "are turned in the picture or mounted so; taken as turned"),
        (wrong & ~is_turned, "state another heading than their pictures show; the pictures are believed"),
    ):
        images = np.flatnonzero(mask)
        if images.size:
            names = ", ".join(block.names[i] for i in images[:5])
            degrees = float(np.degrees(np.median(np.abs(off[images]))))
            logger.warning(
                "%d of %d photos (%s%s) %s (by %.0f degrees)",
                images.size, len(block), names, " ..." if images.size > 5 else "", what, degrees,
            )  # fmt: skip


def _level(block: ImageBlock, image: int, pixel: FloatArray) -> FloatArray:
    """Where rays cut the plane one unit below, as east + i north by the stated heading; NaN for those above it."""
    rays = block.rays(image, pixel)
    below = rays[:, 2] < -0.1
    return np.where(below, (rays[:, 0] + 1j * rays[:, 1]) / np.where(below, -rays[:, 2], 1.0), np.nan)


def _similarity(source: FloatArray, target: FloatArray) -> tuple[complex, complex]:
    """Turn, scale (one complex number) and shift that take points of one plane to another, robustly."""
    weight = np.ones(source.size)
    design = np.column_stack([source, np.ones(source.size)])
    solution = np.array([1.0 + 0j, 0j])
    for _ in range(10):
        solution = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
        error = np.abs(target - design @ solution)
        weight = 1.0 / (1.0 + (error / (2 * max(float(np.median(error)), 1e-9))) ** 2)
    return complex(solution[0]), complex(solution[1])


def _circular_median(angles: FloatArray) -> tuple[float, float]:
    """Angle nearest to all others, and the robust standard deviation about it."""
    apart = np.abs(np.angle(np.exp(1j * (angles[:, None] - angles[None, :]))))
    best = float(angles[int(np.argmin(apart.sum(axis=1)))])
    away = np.angle(np.exp(1j * (angles - best)))
    centre = best + float(np.median(away))
    spread = 1.4826 * float(np.median(np.abs(away - np.median(away))))
    return float(np.angle(np.exp(1j * centre))), spread
