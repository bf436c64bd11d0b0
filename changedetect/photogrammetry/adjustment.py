"""
Bundle adjustment: poses, lens and points that explain all observations and the navigation together.

Levenberg-Marquardt on the reduced camera system (`changedetect.kernels.bundle`), with a robust loss by iterated weights
[1]_, pose priors with their correlation in time (`priors`), and as many lens parameters as the photos determine.

References
----------
.. [1] Holland, Welsch (1977), Robust regression using iteratively reweighted least-squares,
   doi:10.1080/03610927708827533.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError
from changedetect.kernels.bundle import point_steps, reduced_system
from changedetect.kernels.projection import N_CALIBRATION
from changedetect.photogrammetry.block import ImageBlock, Observations
from changedetect.photogrammetry.covariance import PixelCorrelation, pixel_correlation
from changedetect.photogrammetry.lens import corrected_intrinsics, intrinsics_correction
from changedetect.photogrammetry.lens_doubt import considered_covariance, contradiction, corner_units
from changedetect.photogrammetry.priors import boresight_pattern
from changedetect.photogrammetry.triangulation import are_determined, residuals, triangulate
from changedetect.typing import BoolArray, FloatArray

__all__ = ["LENS_PARAMETERS", "Adjustment", "AdjustmentSettings", "adjust"]

logger = logging.getLogger(__name__)

#: Names of the lens parameters, in the order of the unknowns.
LENS_PARAMETERS = ("focal", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "aspect")
#: Cauchy's constant with 95 % efficiency on normal errors.
_CAUCHY = 2.385
_MAX_ITERATIONS = 12
#: Relative change of the cost at which steps have become far smaller than their standard errors.
_CONVERGED = 1e-4
#: Squared deviation from navigation per pose parameter that correlated pixel errors alone do not explain.
_CONTRADICTION = 20.0
#: Pixels are never taken for more exact than this, pixels.
_MIN_SIGMA = 0.01
#: Nor for worse than this many times what was stated: larger residuals speak against the poses, not the pixels.
_MAX_SIGMA_RATIO = 3.0
#: Variance over that known before beyond which a doubted lens parameter is named in the log.
_TOLD_EXCESS = 4.0


@dataclass(frozen=True, kw_only=True)
class AdjustmentSettings:
    """
    What is adjusted, and how.

    Attributes
    ----------
    lens : tuple of str
        Parameters estimated, of `LENS_PARAMETERS`; the others stay as given.
    lens_std : tuple of 9 float
        How well the given lens is known where it is adjusted: relative focal length, cx and cy in pixels, k1, k2, k3,
        p1, p2, relative difference of fx and fy.
    lens_doubt : float, pixels
        What a lens that is not adjusted may at least err by in a corner of the photo, all parameters together; 0 takes
        it as exact.
    max_share : float
        Parameters whose standard error does not fall to this share of `lens_std` go back to the value given: what the
        photos hardly determine takes up whatever the model lacks. Their `lens_std` enters the covariances.
    heeds_contradiction : bool
        Enlarge the variance of modes in which photos and navigation contradict each other.
    boresight_std : float, rad
        How well the mounting angles are known; 0 takes them as exact.
    rounds : int
        Adjustments, each followed by the removal of gross errors and a new estimate of the pixel noise.
    max_error : float
        Observations are removed beyond this many standard deviations.
    min_views : int
        Points with fewer views after that are removed.
    """

    lens: tuple[str, ...] = ()
    lens_std: tuple[float, ...] = (0.01, 10.0, 10.0, 0.05, 0.1, 0.1, 0.002, 0.002, 0.002)
    lens_doubt: float = 0.1
    heeds_contradiction: bool = True
    max_share: float = 1.0
    boresight_std: float = 0.0
    rounds: int = 3
    max_error: float = 4.0
    min_views: int = 2


@dataclass(frozen=True)
class Adjustment:
    """
    Result of a bundle adjustment.

    Attributes
    ----------
    block : ImageBlock
        Adjusted poses and lenses.
    points : array, shape (n_points, 3), ENU, m
    observations : Observations
        Those kept, with the standard deviations estimated.
    weight : array, shape (n,), 1 / pixels^2
        Robust weights of the last iteration.
    origin : array, shape (n_points,), int64
        Number of each point among the observations given.
    camera_covariance : array, shape (6 n_images + 9 n_lenses, 6 n_images + 9 n_lenses)
        Marginal covariance of poses and lenses, the doubt about parameters not adjusted included.
    lens_slope : array, shape (6 n_images + 9 n_lenses, 9 n_lenses)
        How poses and lenses follow a change of each lens parameter that is not adjusted; zero for those adjusted.
    lens_correction, lens_std : array, shape (n_lenses, 9)
        Added to the lens given, and its standard error; in the order of `LENS_PARAMETERS`, focal lengths as logarithms.
    boresight, boresight_std : array, shape (n_flights, 3), rad
        Correction of the mounting angles about the camera's axes, and its standard error.
    pose_correction : array, shape (n_images, 6), m and rad
        Adjusted minus given.
    correlation : PixelCorrelation
        Of the residuals within photos; weights of the images against the priors, and covariances, heed it.
    prior_chi2 : float
        Squared deviation of poses from navigation, in units of its covariance, per pose parameter; about one or less
        where both agree.
    """

    block: ImageBlock
    points: FloatArray
    observations: Observations
    weight: FloatArray
    origin: np.ndarray[Any, np.dtype[np.int64]]
    camera_covariance: FloatArray
    lens_slope: FloatArray
    lens_correction: FloatArray
    lens_std: FloatArray
    boresight: FloatArray
    boresight_std: FloatArray
    pose_correction: FloatArray
    correlation: PixelCorrelation
    prior_chi2: float = 0.0

    @property
    def residuals(self) -> FloatArray:
        """Measured minus projected pixels, shape (n, 2)."""
        return residuals(self.block, self.points, self.observations)


def adjust(
    block: ImageBlock,
    observations: Observations,
    information: FloatArray,
    settings: AdjustmentSettings | None = None,
    *,
    start: ImageBlock | None = None,
    on_round: Callable[[], None] | None = None,
) -> Adjustment:
    """
    Adjust a block.

    Parameters
    ----------
    block : ImageBlock
        Poses and lenses given: the centre of the priors.
    observations : Observations
    information : array, shape (6 n_images, 6 n_images)
        Of the given poses, from `pose_information`; block diagonal over flights.
    settings : AdjustmentSettings, optional
    start : ImageBlock, optional
        Poses to begin with, from an earlier adjustment, and values of the lens parameters that are free; those given
        by default.
    on_round : callable, optional
        Called after each round.

    Raises
    ------
    InputDataError
        No point is seen by two photos, or observations and priors do not determine the poses.
    """
    settings = settings or AdjustmentSettings()
    problem = _Problem.prepare(block, observations, information, settings, start or block)
    for k in range(settings.rounds):
        problem.iterate()
        problem.remove_gross_errors(is_last=k == settings.rounds - 1)
        if on_round is not None:
            on_round()
    problem.iterate()
    if problem.prior_chi2() <= _CONTRADICTION:
        # Poses that contradict the photos bend them; what then correlates is not the photos' noise
        problem.inflation = problem.correlation().design_effect
        problem.iterate()
    if settings.lens and settings.max_share < 1 and problem.give_back_undetermined():
        problem.iterate()
        problem.remove_gross_errors(is_last=True)
        problem.iterate()
    return problem.result()


@dataclass
class _Problem:
    """Unknowns, observations and priors of a running adjustment."""

    given: ImageBlock
    block: ImageBlock
    points: FloatArray
    observations: Observations
    origin: np.ndarray[Any, np.dtype[np.int64]]
    prior: FloatArray
    free: BoolArray
    lens: FloatArray
    boresight: FloatArray
    settings: AdjustmentSettings
    scale: float = 1.0
    #: Observations per independent one: what the images weigh less against the priors.
    inflation: float = 1.0
    #: Standard deviation given for each kind of observation, pixels.
    stated: dict[int, float] = field(default_factory=dict)
    damping: float = 1e-8  # more would hold back the weakest modes, which decide heights; smoothed poses begin close

    @classmethod
    def prepare(
        cls,
        block: ImageBlock,
        observations: Observations,
        information: FloatArray,
        settings: AdjustmentSettings,
        start: ImageBlock,
    ) -> _Problem:
        lens = _free_lens(block, start, settings)
        begin = replace(start, intrinsics=corrected_intrinsics(block.intrinsics, lens))
        first = triangulate(begin, observations)
        fixed = np.isfinite(first.points[:, 0])
        fixed[fixed] = are_determined(begin, first.points, observations)[fixed]
        kept, origin = observations.keep(fixed[observations.point], min_views=2)
        if kept.n_points == 0:
            msg = (
                f"None of {observations.n_points} points is fixed by two of the {len(block)} photos. Check that poses "
                "and photos belong together and that photos overlap."
            )
            raise InputDataError(msg)
        n_flights = int(block.flight.max()) + 1
        prior, free = _prior(block, information, settings, n_flights)
        problem = cls(
            given=block,
            block=begin,
            points=first.points[origin],
            observations=kept,
            origin=origin,
            prior=prior,
            free=free,
            lens=lens,
            boresight=np.zeros((n_flights, 3)),
            settings=settings,
        )
        problem.scale = max(1.0, problem.robust_scale())
        problem.stated = {int(kind): float(np.median(kept.sigma[kept.kind == kind])) for kind in np.unique(kept.kind)}
        return problem

    @property
    def n_reduced(self) -> int:
        """Unknowns of poses and lenses, without boresight."""
        return 6 * len(self.block) + self.lens.size

    def standardised(self) -> FloatArray:
        """Length of each residual over its standard deviation; large for points behind a camera."""
        error = residuals(self.block, self.points, self.observations)
        length = np.sqrt(np.sum(error**2, axis=1) / 2) / self.observations.sigma
        return np.asarray(np.nan_to_num(length, nan=1e6), dtype=np.float64)

    def robust_scale(self) -> float:
        """Median of the standardised residuals over that of normal errors (Rayleigh), degrees of freedom heeded."""
        n, unknowns = 2 * len(self.observations), 3 * len(self.points) + 6 * len(self.block)
        share = max((n - unknowns) / n, 0.05)
        return float(np.median(self.standardised()) / (np.sqrt(np.log(2.0)) * np.sqrt(share)))

    def correlation(self) -> PixelCorrelation:
        """Correlation of residuals within photos."""
        width, height = self.block.size.mean(axis=0)
        error = residuals(self.block, self.points, self.observations)
        return pixel_correlation(error, self.observations, float(np.hypot(width, height)))

    def weights(self) -> FloatArray:
        """Robust weights of the observations, each taken as independent."""
        s = self.standardised() / (_CAUCHY * self.scale)
        return np.asarray(1.0 / ((1.0 + s * s) * self.observations.sigma**2))

    def deviation(self) -> FloatArray:
        """Unknowns of the camera side minus what the priors expect, boresight last."""
        turn = Rotation.from_matrix(self.block.rotation @ self.given.rotation.transpose(0, 2, 1)).as_rotvec()
        pose = np.hstack([self.block.position - self.given.position, turn])
        return np.concatenate([pose.ravel(), self.lens.ravel(), self.boresight.ravel()])

    def prior_chi2(self) -> float:
        """Squared deviation of the poses from navigation in units of its covariance, per pose parameter."""
        e = self.deviation()
        return float(e @ self.prior @ e) / (6 * len(self.block))

    def cost(self) -> float:
        s = self.standardised() / (_CAUCHY * self.scale)
        e = self.deviation()
        loss = (_CAUCHY * self.scale) ** 2 * float(np.log1p(s * s).sum())
        return 2 * loss / self.inflation + float(e @ self.prior @ e)

    def system(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal matrix, gradient and observation weights."""
        weight = self.weights() / self.inflation
        whole, total = self.whole_matrix(weight, damping)
        return whole[np.ix_(self.free, self.free)], total[self.free], weight

    def whole_matrix(self, weight: FloatArray, damping: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and gradient of all unknowns, adjusted or not, with given observation weights."""
        system: Any = reduced_system
        matrix, gradient = system(*self.arrays(), weight, damping)
        whole, total = self.prior.copy(), -(self.prior @ self.deviation())
        whole[: self.n_reduced, : self.n_reduced] += matrix
        total[: self.n_reduced] += gradient
        return whole, total

    def arrays(self) -> tuple[Any, ...]:
        b, o = self.block, self.observations
        return self.points, b.rotation, b.position, b.intrinsics, b.lens, o.start, o.image, o.pixel

    def iterate(self) -> None:
        """Levenberg-Marquardt until the cost stands still."""
        steps: Any = point_steps
        cost = self.cost()
        for _ in range(_MAX_ITERATIONS):
            matrix, gradient, weight = self.system(self.damping)
            matrix[np.diag_indices_from(matrix)] *= 1.0 + self.damping
            step = np.zeros(len(self.prior))
            step[self.free] = cho_solve(_factor(matrix), gradient)
            moved = steps(*self.arrays(), weight, self.damping, step[: self.n_reduced])
            trial = self.moved(step, moved)
            new = trial.cost()
            if not new <= cost:
                if new - cost < _CONVERGED * cost or self.damping >= 1e6:
                    break
                self.damping *= 10
                continue
            self.block, self.points, self.lens, self.boresight = trial.block, trial.points, trial.lens, trial.boresight
            self.damping = max(self.damping / 10, 1e-12)
            if cost - new < _CONVERGED * cost:
                break
            cost = new

    def moved(self, step: FloatArray, point_step: FloatArray) -> _Problem:
        n = len(self.block)
        pose = step[: 6 * n].reshape(n, 6)
        lens = self.lens + step[6 * n : self.n_reduced].reshape(self.lens.shape)
        rotation = Rotation.from_rotvec(pose[:, 3:]).as_matrix() @ self.block.rotation
        block = replace(
            self.block,
            rotation=rotation,
            position=self.block.position + pose[:, :3],
            intrinsics=corrected_intrinsics(self.given.intrinsics, lens),
        )
        boresight = self.boresight + step[self.n_reduced :].reshape(self.boresight.shape)
        return replace(self, block=block, points=self.points + point_step, lens=lens, boresight=boresight)

    def remove_gross_errors(self, *, is_last: bool) -> None:
        """Drop observations far beyond the noise, re-estimate the noise of each kind."""
        error = self.standardised()
        self.scale = 1.0 if is_last else max(1.0, self.robust_scale())
        factor = self.robust_scale()
        limit = self.settings.max_error * max(factor, 0.1)
        n_views = self.settings.min_views if is_last else 2
        determined = are_determined(self.block, self.points, self.observations)
        good = (error < limit) & determined[self.observations.point]
        kept, stays = self.observations.keep(good, min_views=n_views)
        if kept.n_points == 0:
            msg = (
                "No point is left in agreement with the poses. Check that photos, camera file and logs belong together."
            )
            raise InputDataError(msg)
        self.observations = self._with_noise(kept, stays)
        self.points, self.origin = self.points[stays], self.origin[stays]
        self.scale = 1.0

    def _with_noise(self, kept: Observations, stays: Any) -> Observations:
        """Standard deviation per kind of observation from its residuals."""
        error = residuals(self.block, self.points[stays], kept)
        share = 1.0 - 1.5 / kept.n_views[kept.point]  # three of 2 n coordinates go into the point
        sigma = kept.sigma.copy()
        for kind in np.unique(kept.kind):
            mine = (kept.kind == kind) & np.isfinite(error[:, 0])
            redundancy = float(share[mine].sum()) * 2 * max(1 - 3 * len(self.block) / max(len(kept), 1), 0.1)
            square = float(np.sum(error[mine] ** 2))
            if redundancy > 20 and square > 0:
                most = _MAX_SIGMA_RATIO * self.stated[int(kind)]
                sigma[kept.kind == kind] = np.clip(np.sqrt(square / redundancy), _MIN_SIGMA, most)
        return replace(kept, sigma=sigma)

    def give_back_undetermined(self) -> bool:
        """Set lens parameters that the photos hardly determine to the values given; say whether there are any."""
        n = 6 * len(self.block)
        std = np.sqrt(np.diag(self.covariance(self.weights()))[n : self.n_reduced])
        known = np.tile(np.asarray(self.settings.lens_std), len(self.block.intrinsics))
        poor = np.zeros(len(self.prior), dtype=bool)
        poor[n : self.n_reduced] = std > self.settings.max_share * known
        poor &= self.free
        if not poor.any():
            return False
        names = {LENS_PARAMETERS[k % N_CALIBRATION] for k in np.flatnonzero(poor[n : self.n_reduced])}
        logger.info("not determined by these photos, left as given: %s", ", ".join(sorted(names)))
        self.free = self.free & ~poor
        self.lens = np.where(poor[n : self.n_reduced].reshape(self.lens.shape), 0.0, self.lens)
        self.block = replace(self.block, intrinsics=corrected_intrinsics(self.given.intrinsics, self.lens))
        self.damping = 1e-8
        return True

    def covariance(self, weight: FloatArray) -> FloatArray:
        """Covariance of the unknowns that are adjusted, zero for the others."""
        x = np.flatnonzero(self.free)
        whole = self.whole_matrix(weight / self.inflation)[0]
        out = np.zeros_like(whole)
        out[np.ix_(x, x)] = cho_solve(_factor(whole[np.ix_(x, x)]), np.eye(x.size))
        return out

    def doubted_covariance(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Covariance of all unknowns, with the doubts about the lens, and how poses and lenses follow the lens."""
        whole, gradient = self.whole_matrix(weight / self.inflation)
        known, lens = self.known_lens(), slice(6 * len(self.block), self.n_reduced)
        out, slope, variance = considered_covariance(whole, gradient, self.prior, self.free, known)
        if self.settings.heeds_contradiction:
            x = np.ix_(self.free, self.free)
            out[x] += contradiction(whole[x], self.prior[x], self.deviation()[self.free])
        for k in np.flatnonzero(variance > _TOLD_EXCESS * known):
            name = LENS_PARAMETERS[(int(k) - lens.start) % N_CALIBRATION]
            logger.info(
                "photos contradict the %s given: ± %.2g instead of %.2g", name, *np.sqrt([variance[k], known[k]])
            )
        return out, slope[: self.n_reduced, lens]

    def known_lens(self) -> FloatArray:
        """Variance known before of each lens parameter that is not adjusted, zero for all other unknowns."""
        stated = [name in self.settings.lens for name in LENS_PARAMETERS]
        std = np.where(stated, self.settings.lens_std, self.settings.lens_doubt * corner_units(self.block))
        known = np.zeros(len(self.prior))
        known[6 * len(self.block) : self.n_reduced] = std.ravel() ** 2
        known[self.free] = 0.0
        return known

    def result(self) -> Adjustment:
        weight = self.weights()
        deviation = self.deviation()
        covariance, lens_slope = self.doubted_covariance(weight)
        std = np.sqrt(np.diag(covariance))
        n = 6 * len(self.block)
        return Adjustment(
            block=self.block,
            points=self.points,
            observations=self.observations,
            weight=weight,
            origin=self.origin,
            camera_covariance=covariance[: self.n_reduced, : self.n_reduced],
            lens_slope=lens_slope,
            lens_correction=self.lens,
            lens_std=std[n : self.n_reduced].reshape(self.lens.shape),
            boresight=self.boresight,
            boresight_std=std[self.n_reduced :].reshape(self.boresight.shape),
            pose_correction=deviation[:n].reshape(-1, 6),
            correlation=self.correlation(),
            prior_chi2=self.prior_chi2(),
        )


def _free_lens(given: ImageBlock, start: ImageBlock, settings: AdjustmentSettings) -> FloatArray:
    """Corrections that take the given lenses to those of the start, zero for parameters that are not free."""
    between = intrinsics_correction(given.intrinsics, start.intrinsics)
    return np.where([name in settings.lens for name in LENS_PARAMETERS], between, 0.0)


def _prior(
    block: ImageBlock, information: FloatArray, settings: AdjustmentSettings, n_flights: int
) -> tuple[FloatArray, BoolArray]:
    """Information of poses, lenses and boresight; which of them are adjusted."""
    unknown = sorted(set(settings.lens) - set(LENS_PARAMETERS))
    if unknown:
        msg = f"Unknown lens parameters {unknown}. Choose of {', '.join(LENS_PARAMETERS)}."
        raise ValueError(msg)
    n = 6 * len(block)
    if information.shape != (n, n):
        msg = f"The information of {len(block)} poses has shape {information.shape}; expected {(n, n)}."
        raise ValueError(msg)
    n_lenses = len(block.intrinsics)
    lens = np.tile(np.asarray(settings.lens_std) ** -2.0, n_lenses)
    prior: FloatArray = block_diag(information, np.diag(lens), np.zeros((3 * n_flights, 3 * n_flights)))
    free = np.ones(len(prior), dtype=bool)
    free[n : n + lens.size] = np.tile([name in settings.lens for name in LENS_PARAMETERS], n_lenses)
    if settings.boresight_std <= 0:
        free[n + lens.size :] = False
        return prior, free
    pattern = np.zeros((n, 3 * n_flights))
    for flight in range(n_flights):
        rows = np.repeat(block.flight == flight, 6)
        pattern[rows, 3 * flight : 3 * flight + 3] = boresight_pattern(block.rotation[block.flight == flight])
    cross = information @ pattern
    at = slice(n + lens.size, None)
    prior[:n, at], prior[at, :n] = -cross, -cross.T
    prior[at, at] = pattern.T @ cross + np.eye(3 * n_flights) / settings.boresight_std**2
    return prior, free


def _factor(matrix: FloatArray) -> Any:
    try:
        return cho_factor(matrix, check_finite=False)
    except LinAlgError as error:
        msg = (
            "Observations and priors do not determine the poses. Give positive accuracies for positions and angles, "
            f"or adjust fewer lens parameters. ({error})"
        )
        raise InputDataError(msg) from error
