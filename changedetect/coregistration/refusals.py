"""What cannot be aligned, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from changedetect.coregistration.robust import nmad
from changedetect.errors import InputDataError

if TYPE_CHECKING:
    from changedetect.coregistration.estimation import Fit
    from changedetect.coregistration.sample import Sample
    from changedetect.coregistration.settings import AlignmentSettings
    from changedetect.coregistration.surfaces import ReferenceSurface
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["check_effective", "check_overlap", "check_units", "select_stable", "undetermined"]

#: Metres per foot, and feet per metre; the US survey foot differs by 2 ppm.
_UNIT_FACTORS = ((0.3048, "feet, not metres"), (1.0 / 0.3048, "metres, while the reference is in feet"))
#: A unit factor must bring elevations this much closer to the reference to be named.
_UNIT_GAIN = 0.05
_SPREAD_GAIN = 0.7


def select_stable(observations: PointCloud, stable: BoolArray | None, settings: AlignmentSettings) -> PointCloud:
    """
    Observations on stable ground.

    Raises
    ------
    ValueError
        The mask does not match the observations.
    InputDataError
        Too few of them.
    """
    if stable is not None:
        if np.shape(stable) != observations.elevation.shape:
            msg = f"The mask of stable ground has shape {np.shape(stable)} for {len(observations)} observations."
            raise ValueError(msg)
        observations = observations.select(np.asarray(stable, dtype=np.bool_))
    if len(observations) < settings.min_observations:
        where = "" if stable is None else " on the stable ground given"
        msg = (
            f"Too little stable ground: {len(observations)} observations{where}, at least "
            f"{settings.min_observations} are needed to align. Give larger stable areas, or none to have unchanged "
            "ground found."
        )
        raise InputDataError(msg)
    return observations


def check_overlap(
    cloud: PointCloud, defined: BoolArray, reference: ReferenceSurface, settings: AlignmentSettings
) -> None:
    """
    Refuse an epoch that does not lie on the reference.

    Raises
    ------
    InputDataError
        Names exchanged axes or a wrong unit if these explain it.
    """
    n = int(np.count_nonzero(defined))
    if n >= settings.min_observations:
        return
    west, east, south, north = cloud.region
    where = f"easting {west:.1f} to {east:.1f}, northing {south:.1f} to {north:.1f}"
    if n > 0:
        msg = (
            f"Overlap too small to align: of {len(cloud)} observations ({where}) {n} lie on ground that the reference "
            f"covers, at least {settings.min_observations} are needed."
        )
        raise InputDataError(msg)
    msg = f"No overlap: none of {len(cloud)} observations ({where}) lies on ground that the reference covers. "
    explanations = {
        "With easting and northing exchanged they would: check the order of the columns.": (
            cloud.northing,
            cloud.easting,
        ),
        "Times 0.3048 they would: the coordinates are in feet; state their CRS.": (
            0.3048 * cloud.easting,
            0.3048 * cloud.northing,
        ),
    }
    for explanation, (easting, northing) in explanations.items():
        if reference.surface(np.ascontiguousarray(easting), np.ascontiguousarray(northing)).defined.any():
            raise InputDataError(msg + explanation)
    raise InputDataError(msg + "Check the CRS and whether this is the right file.")


def check_units(elevation: FloatArray, surface: FloatArray) -> None:
    """
    Refuse elevations in another unit than the reference's.

    Parameters
    ----------
    elevation, surface : array, shape (n,), m
        Observed, and of the reference at the same places.

    Raises
    ------
    InputDataError
    """
    difference = elevation - surface
    distance, spread = float(np.median(np.abs(difference))), nmad(difference)
    for factor, unit in _UNIT_FACTORS:
        scaled = factor * elevation - surface
        closer = float(np.median(np.abs(scaled))) < _UNIT_GAIN * distance
        if closer and nmad(scaled) < _SPREAD_GAIN * spread:
            msg = (
                f"Elevations look like {unit}: they differ from the reference by {distance:.2f} m in the median, and "
                f"times {factor:.4f} by {float(np.median(np.abs(scaled))):.2f} m. State the vertical CRS or unit of "
                "the source."
            )
            raise InputDataError(msg)


def undetermined(fit: Fit, sample: Sample, n_before: int, limit: float) -> str | None:
    """
    Why the parameters of a fit are not determined by the ground; None where they are.

    Parameters
    ----------
    fit : Fit
    sample : Sample
    n_before : int
        Observations on the reference before aligning.
    limit : float, m
        Largest standard deviation accepted.
    """
    solution, transform = fit.solution, fit.transform
    if np.count_nonzero(solution.misfit.defined) < 0.5 * n_before:
        return "the fit drifted off the reference"
    if not (solution.is_converged and np.isfinite(fit.covariance).all()):
        return f"the fit did not converge in {solution.n_iterations} iterations"
    variance = np.diag(fit.covariance)
    for k, name in enumerate(transform.names[3:], start=3):
        std = float(np.sqrt(variance[k])) * sample.radius
        if std > limit:
            return (
                f"{name.replace('_', ' ')} is known to {std:.2f} m only at {sample.radius:.0f} m from the centre "
                f"({limit:.2f} m allowed)"
            )
    if len(transform.names) > 1:
        worst = float(np.sqrt(np.linalg.eigvalsh(fit.covariance[:2, :2])[-1]))
        if worst > limit:
            slopes = solution.misfit.jacobian[solution.consensus.weight > 0.0, :2]
            return (
                f"slopes vary too little, by {100.0 * float(np.hypot(*slopes.std(axis=0))):.1f} % rms: the horizontal "
                f"shift would be known to {worst:.2f} m only ({limit:.2f} m allowed)"
            )
    return None


def check_effective(fit: Fit, settings: AlignmentSettings) -> None:
    """
    Refuse stable ground that holds too few independent observations.

    Raises
    ------
    InputDataError
    """
    n_used, n_effective = fit.solution.n_used, fit.n_effective
    if n_used < settings.min_observations or n_effective < settings.min_effective:
        msg = (
            f"Too little stable ground: {n_used} observations agree with the reference (at least "
            f"{settings.min_observations} are needed), as good as {n_effective:.1f} independent ones (at least "
            f"{settings.min_effective:g}), since their errors are correlated in space. Give larger stable areas, or "
            "areas further apart."
        )
        raise InputDataError(msg)
