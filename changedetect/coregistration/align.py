"""Aligning one epoch to the programme's reference surface."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from changedetect.coregistration.alignment import Alignment
from changedetect.coregistration.choice import choose
from changedetect.coregistration.estimation import measure, solve
from changedetect.coregistration.refusals import check_effective, check_overlap, check_units, select_stable
from changedetect.coregistration.robust import nmad
from changedetect.coregistration.sample import Sample
from changedetect.coregistration.settings import AlignmentSettings
from changedetect.coregistration.thinning import thin
from changedetect.coregistration.transform import Transform

if TYPE_CHECKING:
    from changedetect.coregistration.choice import Choice
    from changedetect.coregistration.estimation import Fit, Solution
    from changedetect.coregistration.surfaces import ReferenceSurface
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["align"]

logger = logging.getLogger(__name__)

#: A vertical shift is a step if it exceeds this many standard errors, this many times the scatter that remains, and
#: all other motion changes elevations by less than this part of it.
_STEP_ERRORS = 3.0
_STEP_SCATTERS = 2.0
_STEP_OTHER = 0.2
#: Below this share of agreeing ground the majority may be the wrong one.
_LEAST_SHARE = 0.5


def align(
    observations: PointCloud,
    reference: ReferenceSurface,
    settings: AlignmentSettings | None = None,
    stable: BoolArray | None = None,
) -> Alignment:
    """
    Estimate how an epoch must be moved onto a reference surface.

    Parameters
    ----------
    observations : PointCloud
        Of the epoch, in the CRS of the reference. Their number costs little: an even sample is drawn.
    reference : ReferenceSurface
    settings : AlignmentSettings, optional
    stable : array, shape (n,), bool, optional
        Observations on ground known not to have changed. By default, and among these too, unchanged ground is found:
        up to 40 % may have changed, all to one side even.

    Returns
    -------
    alignment : Alignment
        Its transform moves the epoch into the frame of the reference. The same for any order of the observations.

    Raises
    ------
    InputDataError
        No overlap, or too little stable ground, or elevations in another unit, or a kind of transform was asked for
        that the ground does not determine.
    ValueError
        The mask does not match the observations.

    Notes
    -----
    Residuals are elevations above the reference (point to surface), linearised with its own slope and re-evaluated in
    each step; robust weights leave changed ground out. See `Instruments` for why estimates are unbiased,
    `parameter_covariance` for their standard errors and `leaves_out` for the choice of the kind.
    """
    settings = settings or AlignmentSettings()
    chosen = select_stable(observations, stable, settings)
    cloud = thin(chosen, settings.max_observations)
    sample, overlap = _overlapping(cloud, reference, settings)
    start = Transform.identity("vertical", sample.centre)
    before = measure(sample, reference, start)
    check_units(sample.cloud.elevation, sample.cloud.elevation - before.residual)
    vertical = solve(sample, reference, start)
    sample = _weighted(sample, vertical)
    if sample.cloud.sigma is not None or float(before.surface_variance.max(initial=0.0)) > 0.0:
        vertical = solve(sample, reference, vertical.transform)
    choice = choose(sample, reference, vertical, settings)
    check_effective(choice.fit, settings)
    alignment = _reported(choice, sample, before.residual, len(chosen), overlap, settings, stable is not None)
    logger.info("aligned by %s, %s", alignment.kind, _in_words(alignment))
    if alignment.vertical_step is not None:
        logger.warning("The epoch %s.", alignment.vertical_step)
    return alignment


def _overlapping(cloud: PointCloud, reference: ReferenceSurface, settings: AlignmentSettings) -> tuple[Sample, float]:
    """Sample of the observations on the reference, and the share these are."""
    defined = reference.surface(*cloud.coordinates).defined
    check_overlap(cloud, defined, reference, settings)
    return Sample.of(cloud.select(defined)), float(defined.mean())


def _weighted(sample: Sample, vertical: Solution) -> Sample:
    """Weigh observations by their own variance where stated, and by that of the surface under them."""
    surface = vertical.misfit.surface_variance
    if sample.cloud.sigma is not None:
        return sample.weighted_by(sample.cloud.sigma**2 + surface)
    noise = max(vertical.consensus.scale**2 - float(np.median(surface)), 0.25 * vertical.consensus.scale**2)
    return sample.weighted_by(noise + surface)


def _reported(
    choice: Choice,
    sample: Sample,
    residual_before: FloatArray,
    n_observations: int,
    overlap: float,
    settings: AlignmentSettings,
    is_ground_given: bool,
) -> Alignment:
    fit = choice.fit
    consensus, misfit = fit.solution.consensus, fit.solution.misfit
    kept = misfit.defined & consensus.stable_observations(sample.squares)
    stable_share = float(kept.sum() / max(misfit.defined.sum(), 1))
    before, after = residual_before[kept], misfit.residual[kept]
    remarks = [] if choice.fallback is None else [f"Aligned vertically only: {choice.fallback}."]
    if stable_share < _LEAST_SHARE:
        whose = "the stable ground given" if is_ground_given else "the ground"
        remarks.append(
            f"{100.0 * (1.0 - stable_share):.0f} % of {whose} disagrees with the rest: the majority may be the wrong one."
        )
    length = fit.errors.length * (1.0 if fit.errors.exponent == 1 else np.sqrt(2.0))
    return Alignment(
        transform=fit.transform,
        covariance=fit.covariance,
        degrees_of_freedom=fit.freedom,
        candidates=choice.candidates,
        n_observations=n_observations,
        n_used=fit.solution.n_used,
        n_effective=fit.n_effective,
        overlap_share=overlap,
        stable_share=stable_share,
        median_before=float(np.median(before)),
        nmad_before=nmad(before),
        median_after=float(np.median(after)),
        nmad_after=nmad(after),
        correlation_length=float(length) if fit.errors.is_correlated else 0.0,
        square_std=consensus.square_scale,
        square_side=sample.squares.side,
        vertical_step=_vertical_step(fit, nmad(after), settings),
        remarks=tuple(remarks),
    )


def _vertical_step(fit: Fit, scatter: float, settings: AlignmentSettings) -> str | None:
    """Say so where the epoch is offset as by another vertical datum."""
    transform = fit.transform
    k = transform.names.index("up")
    up = transform.parameters[k]
    other = np.array(transform.parameters)
    other[k] = 0.0
    used = fit.solution.consensus.weight > 0.0
    moved = fit.solution.misfit.jacobian[used] @ other
    is_step = (
        abs(up) > _STEP_ERRORS * float(np.sqrt(fit.covariance[k, k]))
        and abs(up) > max(settings.datum_step_min_m, _STEP_SCATTERS * scatter)
        and float(np.sqrt(np.mean(moved**2))) < _STEP_OTHER * abs(up)
    )
    if not is_step:
        return None
    side = "below" if up > 0.0 else "above"
    return f"lies {abs(up):.2f} m {side} the reference everywhere, as a vertical datum step would"


def _in_words(alignment: Alignment) -> str:
    transform = alignment.transform
    parts = (
        f"{name} {value:.4g} +- {error:.2g}"
        for name, value, error in zip(transform.names, transform.parameters, alignment.standard_errors, strict=True)
    )
    return ", ".join(parts)
