"""What cannot be aligned, and why."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from changedetect.coregistration.estimation import instruments
from changedetect.coregistration.stable_ground import nmad
from changedetect.errors import InputDataError

if TYPE_CHECKING:
    from changedetect.coregistration.estimation import Fit
    from changedetect.coregistration.reference import ReferenceSurface
    from changedetect.coregistration.sample import Sample
    from changedetect.coregistration.uncertainty import Uncertainty
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import BoolArray, FloatArray

__all__ = [
    "MIN_OBSERVATIONS",
    "AlignmentError",
    "Cause",
    "check_determined",
    "check_effective",
    "check_overlap",
    "check_scatter",
    "check_solved",
    "check_stable",
    "check_units",
    "n_effective",
]

Cause: TypeAlias = Literal["overlap", "stable ground", "slope diversity", "units"]

#: Fewer observations on stable ground do not tell it from changed ground.
MIN_OBSERVATIONS = 50
#: Fewer independent ones, given how their errors correlate in space, leave the standard errors themselves unknown.
_MIN_EFFECTIVE = 8.0
_METRES_PER_FOOT = 0.3048
#: Slopes taken near and far, whose noise is independent, agree over squares by so many standard errors where there are
#: slopes at all: weak instruments would make standard errors meaningless.
_LEAST_STRENGTH = 4.0
#: Residuals of stable ground scatter by at most so many times the noise of neighbours: 1.2 where errors are
#: independent, 1.8 on an airborne lidar pair, 4 to 28 on a beach and a sandbar that changed all over.
_LARGEST_SCATTER = 4.0
#: The same where tilt, rotation or scale were taken: gentle change over most of a site looks like them, and taken out
#: it would be lost (a beach of 14 months was tilted by 5 mm/m).
_LARGEST_SCATTER_TILTED = 2.0
#: Another unit must bring elevations this much closer to the reference to be named.
_UNIT_GAIN = 0.05
_SPREAD_GAIN = 0.7
#: A parameter counts as determined if it moves no position on the rms radius by more than this part of the reach.
_LARGEST_STD = 0.5


class AlignmentError(InputDataError):
    """
    An epoch cannot be aligned.

    Attributes
    ----------
    cause : {"overlap", "stable ground", "slope diversity", "units"}
        What there is too little of; or elevations are in another unit.
    """

    def __init__(self, message: str, cause: Cause) -> None:
        super().__init__(message)
        self.cause = cause


def check_stable(n_stable: int, n_observations: int, *, is_given: bool) -> None:
    """Refuse an epoch with too few observations, or too few in the stable areas."""
    if n_stable >= MIN_OBSERVATIONS:
        return
    where, advice = f"{n_stable} observations", "Add observations"
    if is_given:
        where = f"of {n_observations} observations {n_stable} lie in the stable areas"
        advice = "Give larger stable areas, or none to have unchanged ground found"
    msg = f"Too little stable ground: {where}, at least {MIN_OBSERVATIONS} are needed to align. {advice}."
    raise AlignmentError(msg, "stable ground")


def check_overlap(cloud: PointCloud, defined: BoolArray, reference: ReferenceSurface) -> None:
    """
    Refuse an epoch that does not lie on the reference.

    Raises
    ------
    AlignmentError
        Names exchanged axes or feet if these explain it.
    """
    n = int(np.count_nonzero(defined))
    if n >= MIN_OBSERVATIONS:
        return
    west, east, south, north = cloud.region
    where = f"easting {west:.1f} to {east:.1f}, northing {south:.1f} to {north:.1f}"
    if n > 0:
        msg = (
            f"Overlap too small to align: of {len(cloud)} observations ({where}) {n} lie on ground that the reference "
            f"covers, at least {MIN_OBSERVATIONS} are needed."
        )
        raise AlignmentError(msg, "overlap")
    msg = f"No overlap: none of {len(cloud)} observations ({where}) lies on ground that the reference covers. "
    foot = _METRES_PER_FOOT
    explanations = {
        "With easting and northing exchanged they would: check the order of the columns.": (
            cloud.northing,
            cloud.easting,
        ),
        "Times 0.3048 they would: the coordinates are in feet; state their CRS.": (
            foot * cloud.easting,
            foot * cloud.northing,
        ),
    }
    for explanation, (easting, northing) in explanations.items():
        if np.isfinite(reference.surface(easting, northing)[0]).any():
            raise AlignmentError(msg + explanation, "overlap")
    msg += "Check the CRS and whether this is the right file."
    raise AlignmentError(msg, "overlap")


def check_units(elevation: FloatArray, surface: FloatArray) -> None:
    """
    Refuse elevations in another unit than the reference's.

    Parameters
    ----------
    elevation, surface : array, shape (n,), m
        Observed, and of the reference at the same places.

    Raises
    ------
    AlignmentError
    """
    difference = elevation - surface
    distance, spread = float(np.median(np.abs(difference))), nmad(difference)
    units = {_METRES_PER_FOOT: "feet, not metres", 1.0 / _METRES_PER_FOOT: "metres, while the reference is in feet"}
    for factor, unit in units.items():
        scaled = factor * elevation - surface
        left = float(np.median(np.abs(scaled)))
        if left < _UNIT_GAIN * distance and nmad(scaled) < _SPREAD_GAIN * spread:
            msg = (
                f"Elevations look like {unit}: they differ from the reference by {distance:.2f} m in the median, and "
                f"times {factor:.4f} by {left:.2f} m. State the vertical CRS or unit of the source."
            )
            raise AlignmentError(msg, "units")


def check_solved(fit: Fit, sample: Sample, reference: ReferenceSurface) -> None:
    """Refuse a fit that has no solution: it went astray for want of slopes, or hardly anything agrees."""
    n_defined = int(np.count_nonzero(fit.residuals.defined))
    if fit.is_converged and fit.n_used >= MIN_OBSERVATIONS and 2 * n_defined >= len(sample):
        return
    if len(fit.transform.names) == 1:
        msg = f"of {len(sample)} observations {fit.n_used} agree on one level, at least {MIN_OBSERVATIONS} are needed"
        raise AlignmentError(msg, "stable ground")
    msg = f"{_relief(fit, reference)}: the fit did not converge in {fit.n_evaluations} evaluations"
    raise AlignmentError(msg, "slope diversity")


def check_determined(fit: Fit, uncertainty: Uncertainty, sample: Sample, reference: ReferenceSurface) -> None:
    """Refuse a fit whose parameters the slopes of the ground do not determine."""
    covariance, limit = uncertainty.covariance, _LARGEST_STD * reference.reach
    if len(fit.transform.names) == 1:
        return
    agreement = instruments(sample, fit, fit.smoothing)[:, :2] * fit.jacobian()[:, :2]
    terms = sample.squares.total(agreement * (fit.consensus.weight > 0.0)[:, None])
    strength = terms.sum(axis=0) / np.sqrt(np.maximum((terms**2).sum(axis=0), 1e-300))
    if not strength.min() >= _LEAST_STRENGTH:
        msg = f"{_relief(fit, reference)}: no more than the noise of the reference makes"
        raise AlignmentError(msg, "slope diversity")
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    if not worst <= limit:
        msg = (
            f"{_relief(fit, reference)}: the horizontal shift would be known to {worst:.2f} m only ({limit:.2f} m "
            "allowed)"
        )
        raise AlignmentError(msg, "slope diversity")
    for k, name in enumerate(fit.transform.names[3:], start=3):
        std = float(np.sqrt(covariance[k, k])) * sample.radius
        if not std <= limit:
            msg = (
                f"{name.replace('_', ' ')} would be known to {std:.2f} m only at {sample.radius:.0f} m from the centre "
                f"({limit:.2f} m allowed)"
            )
            raise AlignmentError(msg, "slope diversity")


def _relief(fit: Fit, reference: ReferenceSurface) -> str:
    slopes = float(np.hypot(fit.slopes.wide_east.std(), fit.slopes.wide_north.std()))
    return f"slopes vary too little, by {100.0 * slopes:.1f} % rms over {2.0 * reference.reach:.1f} m"


def check_scatter(fit: Fit, stated: float = 0.0) -> None:
    """
    Refuse ground that was found to agree although it scatters as changed ground does.

    Parameters
    ----------
    fit : Fit
    stated : float, m
        Median standard deviation that the observations state; 0 where they state none.

    Notes
    -----
    What neighbouring observations do not share is their noise. Where the residuals of all the ground that agrees
    scatter by several times that and the uncertainty of the reference, either errors are correlated and large, or the
    ground changed nearly everywhere, gently, as beaches do; then the best transform would take the change for an
    error. The two look alike. Where observations state more than neighbours show, as those of photos do, whose poses
    err together over metres, what is stated counts.
    """
    kept = fit.consensus.weight > 0.0
    residual = fit.residuals.residual[kept]
    places = np.column_stack([fit.residuals.easting[kept], fit.residuals.northing[kept]])
    nearest = np.asarray(cKDTree(places).query(places, k=2)[1])[:, 1]
    local = nmad(residual - residual[nearest]) / math.sqrt(2.0)
    local = math.hypot(max(local, stated), math.sqrt(float(np.median(fit.residuals.surface_variance[kept]))))
    scatter = nmad(residual)
    is_simple = fit.transform.kind in ("vertical", "shift")
    limit = _LARGEST_SCATTER if is_simple else _LARGEST_SCATTER_TILTED
    if scatter > limit * max(local, 1e-3):
        msg = (
            f"Change cannot be told from error: residuals scatter by {scatter:.2f} m on the ground that agrees best, "
            f"where observations and reference are uncertain by {local:.2f} m ({limit:g} times as much are "
            "allowed). Give stable areas, or demand a kind of transform if the ground is known to be stable."
        )
        raise AlignmentError(msg, "stable ground")


def n_effective(fit: Fit, uncertainty: Uncertainty) -> float:
    """Number of independent observations that would determine the vertical shift as well."""
    up = fit.transform.names.index("up")
    n = fit.consensus.scale**2 / max(float(uncertainty.covariance[up, up]), 1e-300)
    return min(n, float(fit.n_used))


def check_effective(fit: Fit, uncertainty: Uncertainty) -> None:
    """Refuse stable ground that holds too few independent observations."""
    n_used, n = fit.n_used, n_effective(fit, uncertainty)
    if n_used < MIN_OBSERVATIONS or n < _MIN_EFFECTIVE:
        msg = (
            f"Too little stable ground: {n_used} observations agree with the reference (at least {MIN_OBSERVATIONS} "
            f"are needed), as good as {n:.1f} independent ones (at least {_MIN_EFFECTIVE:g}), since their errors are "
            "correlated in space. Give larger stable areas, or areas further apart."
        )
        raise AlignmentError(msg, "stable ground")
