"""Aligning one epoch to the programme's reference surface."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from changedetect.coregistration.alignment import Alignment
from changedetect.coregistration.choice import choose
from changedetect.coregistration.estimation import measure, solve
from changedetect.coregistration.refusals import (
    check_effective,
    check_overlap,
    check_scatter,
    check_stable,
    check_units,
    n_effective,
)
from changedetect.coregistration.sample import Sample, thin
from changedetect.coregistration.stable_ground import nmad
from changedetect.coregistration.transform import KINDS, Kind, Transform

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.coregistration.choice import Choice
    from changedetect.coregistration.estimation import Fit
    from changedetect.coregistration.reference import ReferenceSurface
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["MAX_OBSERVATIONS", "align"]

logger = logging.getLogger(__name__)

#: Observations to work with, spread evenly over the ground.
MAX_OBSERVATIONS = 60_000
#: A vertical shift is a step if it exceeds this many standard errors, this many times the scatter that remains and
#: this height in metres, and all other motion changes elevations by less than this part of it.
_STEP_ERRORS = 3.0
_STEP_SCATTERS = 2.0
_STEP_SMALLEST = 0.1
_STEP_OTHER = 0.2
#: A scale beyond this is no matter of calibration.
_LARGEST_SCALE = 2e-3
#: Below this share of agreeing ground the majority may be the wrong one, and a stable area is not stable.
_LEAST_SHARE = 0.5
_FEW_IN_AREA = 20


def align(
    observations: PointCloud,
    reference: ReferenceSurface,
    kind: Kind | Literal["auto"] = "auto",
    area: IntArray | None = None,
    area_names: Sequence[str] = (),
) -> Alignment:
    """
    Estimate how an epoch must be moved onto a reference surface.

    Parameters
    ----------
    observations : PointCloud
        Of the epoch, in the CRS of the reference. Their number costs little: an even sample is drawn.
    reference : ReferenceSurface
    kind : {"auto", "vertical", "shift", "shift_tilt", "rigid", "rigid_scale"}
        Transform to fit; "auto" takes the simplest that suffices.
    area : array, shape (n,), int, optional
        Number of the stable area each observation lies in, negative outside; those outside take no part. By default,
        and inside these areas too, unchanged ground is found: up to 40 % may have changed, all to one side even.
    area_names : sequence of str
        Names of the stable areas for messages; "stable area 1" and so on where there are none.

    Returns
    -------
    alignment : Alignment
        Its transform moves the epoch into the frame of the reference. The same for any order of the observations.

    Raises
    ------
    AlignmentError
        Overlap, stable ground or slope diversity are too small, or elevations are in another unit; the message and
        its attribute `cause` say which. Where "auto" finds slopes too alike it aligns vertically and remarks on it;
        where it finds ground that changed all over, it refuses.
    ValueError
        The kind is unknown, or areas do not match the observations.

    Notes
    -----
    Residuals are elevations above the reference (point to surface), linearised with its own slope and re-evaluated in
    each step; robust weights leave changed ground out. See `instruments` for why estimates are unbiased,
    `parameter_covariance` for their standard errors and `leaves_out` for the choice of the kind.
    """
    if kind not in ("auto", *KINDS):
        msg = f"The kind of a transform is auto, {', '.join(KINDS)}; got {kind!r}."
        raise ValueError(msg)
    cloud, area_of = _stable(observations, area)
    chosen = thin(cloud, MAX_OBSERVATIONS)
    sample, overlap = _overlapping(cloud.select(chosen), area_of[chosen], reference)
    start = Transform("vertical", sample.centre, (0.0,))
    before = measure(sample, reference, start)
    check_units(sample.cloud.elevation, sample.cloud.elevation - before.residual)
    vertical = solve(sample, reference, start)
    sample = _weighted(sample, vertical)
    vertical = solve(sample, reference, vertical.transform)
    choice = choose(sample, reference, vertical, kind)
    check_effective(choice.fit, choice.uncertainty)
    if kind == "auto" and area is None:
        sigma = sample.cloud.sigma
        check_scatter(choice.fit, 0.0 if sigma is None else float(np.median(sigma)))
    alignment = _reported(choice, sample, before.residual, len(cloud), overlap)
    remarks = _remarks(choice, alignment, sample, None if area is None else area_names)
    alignment = replace(alignment, remarks=remarks)
    logger.info("%s: %s", alignment.transform.kind, alignment.wording())
    return alignment


def _stable(observations: PointCloud, area: IntArray | None) -> tuple[PointCloud, IntArray]:
    """Observations in the stable areas, and the area of each; all, and zeros, where none are given."""
    if area is None:
        check_stable(len(observations), len(observations), is_given=False)
        return observations, np.zeros(len(observations), dtype=np.int64)
    if np.shape(area) != observations.elevation.shape:
        msg = f"Stable areas of shape {np.shape(area)} do not match {len(observations)} observations."
        raise ValueError(msg)
    inside = area >= 0
    check_stable(int(np.count_nonzero(inside)), len(observations), is_given=True)
    return observations.select(inside), area[inside].astype(np.int64)


def _overlapping(cloud: PointCloud, area: IntArray, reference: ReferenceSurface) -> tuple[Sample, float]:
    """Sample of the observations on the reference, and the share these are."""
    defined = np.isfinite(reference.surface(*cloud.coordinates)[0])
    check_overlap(cloud, defined, reference)
    return Sample.of(cloud.select(defined), area[defined]), float(defined.mean())


def _weighted(sample: Sample, vertical: Fit) -> Sample:
    """Weigh observations by their own variance where stated, and by that of the surface under them."""
    surface = vertical.residuals.surface_variance
    if sample.cloud.sigma is not None:
        return sample.weighted_by(sample.cloud.sigma**2 + surface)
    total = vertical.consensus.scale**2
    return sample.weighted_by(max(total - float(np.median(surface)), 0.25 * total) + surface)


def _reported(
    choice: Choice, sample: Sample, residual_before: FloatArray, n_observations: int, overlap: float
) -> Alignment:
    fit, residuals = choice.fit, choice.fit.residuals
    kept = _kept(fit, sample)
    before, after = residual_before[kept], residuals.residual[kept]
    return Alignment(
        transform=fit.transform,
        covariance=choice.uncertainty.covariance,
        degrees_of_freedom=choice.uncertainty.freedom,
        candidates=choice.candidates,
        n_observations=n_observations,
        n_used=fit.n_used,
        n_effective=n_effective(fit, choice.uncertainty),
        overlap_share=overlap,
        stable_share=float(kept.sum() / max(residuals.defined.sum(), 1)),
        median_before=float(np.median(before)),
        nmad_before=nmad(before),
        median_after=float(np.median(after)),
        nmad_after=nmad(after),
        correlation_length=choice.uncertainty.errors.decay_length,
        vertical_step=_vertical_step(choice, nmad(after)),
        remarks=(),
    )


def _kept(fit: Fit, sample: Sample) -> BoolArray:
    kept: BoolArray = fit.residuals.defined & fit.consensus.on_stable_ground(sample.squares)
    return kept


def _vertical_step(choice: Choice, scatter: float) -> str | None:
    """Say so where the epoch is offset as by another vertical datum."""
    fit = choice.fit
    k = fit.transform.names.index("up")
    up = fit.transform.parameters[k]
    other = np.array(fit.transform.parameters)
    other[k] = 0.0
    moved = fit.jacobian()[fit.consensus.weight > 0.0] @ other
    is_step = (
        abs(up) > _STEP_ERRORS * float(np.sqrt(choice.uncertainty.covariance[k, k]))
        and abs(up) > max(_STEP_SMALLEST, _STEP_SCATTERS * scatter)
        and float(np.sqrt(np.mean(moved**2))) < _STEP_OTHER * abs(up)
    )
    if not is_step:
        return None
    side = "below" if up > 0.0 else "above"
    return (
        f"The epoch lies {abs(up):.2f} m {side} the reference everywhere, as a step of the vertical datum would make "
        "it: check the geoid model and height system of both surveys."
    )


def _remarks(choice: Choice, alignment: Alignment, sample: Sample, area_names: Sequence[str] | None) -> tuple[str, ...]:
    remarks = []
    if choice.fallback is not None:
        remarks.append(f"Aligned vertically only: {choice.fallback}.")
    if alignment.stable_share < _LEAST_SHARE:
        remarks.append(
            f"{100.0 * (1.0 - alignment.stable_share):.0f} % of the ground disagrees with the rest: the majority may "
            "be the wrong one. Give stable areas."
        )
    scale = alignment.transform["scale"]
    if abs(scale) > _LARGEST_SCALE:
        remarks.append(
            f"The epoch is {abs(scale):.2%} {'smaller' if scale > 0.0 else 'larger'} than the reference: check its "
            "unit and the scale of its reconstruction."
        )
    if area_names is not None:
        remarks += _changed_areas(choice.fit, sample, area_names)
    return tuple(remarks)


def _changed_areas(fit: Fit, sample: Sample, names: Sequence[str]) -> list[str]:
    """Name the stable areas that changed themselves."""
    kept = _kept(fit, sample)
    remarks = []
    for number in np.unique(sample.area):
        inside = (sample.area == number) & fit.residuals.defined
        if inside.sum() < _FEW_IN_AREA or kept[inside].mean() >= _LEAST_SHARE:
            continue
        name = names[number] if number < len(names) else f"stable area {number + 1}"
        remarks.append(
            f"{name[:1].upper()}{name[1:]} changed by {np.median(fit.residuals.residual[inside]):+.2f} m against the "
            "other stable ground and was left out."
        )
    return remarks
