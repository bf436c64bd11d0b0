"""Surface model in reference mode: Locally Weighted Projection Regression as published, epoch after epoch."""

from __future__ import annotations

import logging
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from changedetect.config import LWPRConfig
from changedetect.kernels.lwpr import learn
from changedetect.kernels.lwpr_predict import SurfacePrediction, predict_surface
from changedetect.kernels.lwpr_search import LWPRState
from changedetect.kernels.lwpr_state import BISQUARE, GAUSSIAN, Parameters
from changedetect.models.base import Prediction
from changedetect.models.lwpr import check_observations, point_density
from changedetect.models.reference_epochs import OBSERVED_MASS, inherit, move_to, noise_prior
from changedetect.models.reference_state import read_state, write_state

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.typing import Coordinates, FloatArray, IntArray, Region

__all__ = ["ReferenceLWPR", "ReferenceSettings"]

logger = logging.getLogger(__name__)

#: Positions that agree to this are the same place to the pseudo-random order of samples, m.
_ORDER_QUANTUM_M = 1e-3


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class ReferenceSettings:
    """
    Settings of reference mode.

    Attributes
    ----------
    kernel : {"gaussian", "bisquare"}
        Shape of the activation.
    activation_threshold, prune_threshold : float
        A receptive field is added where no activation exceeds the first, and the wider of two is deleted where both
        exceed the second (1: never).
    initial_kernel_m : float or None, m
        Kernel (standard deviation of the Gaussian) of new fields. None: chosen from the density of the first data, so
        that a field sees `observations_per_field`.
    initial_distance_metric : 2 x 2 floats or None, 1 / input_scale^2
        Metric of new fields, instead of `initial_kernel_m`: symmetric, positive definite.
    observations_per_field : float
        Effective number of observations, (sum w)^2 / sum w^2, that new fields are made for; see `initial_kernel_m`.
    initial_forgetting_factor, final_forgetting_factor, forgetting_annealing : float
        The forgetting factor lambda of a field moves from the first to the second as
        lambda <- annealing lambda + (1 - annealing) final, with each sample. A field estimates noise after
        0.1 / (1 - lambda) samples: 10 at 0.99, 107 at the 0.999 of the library.
    learn_metric : bool
        Learn the metrics by gradient descent. Off: for some orders of the data it diverges.
    diagonal_metric : bool
        Learn only the diagonal of the metric's factor.
    learning_rate, penalty : float or None
        Of metric learning. None: those of the library for a metric of 25, scaled to the initial metric.
    meta_learning, meta_rate : bool, float
        Adapt learning rates (incremental delta-bar-delta).
    initial_s2 : float
        Start value of the projections' sums of squares.
    input_scale, output_scale : float, m
        Positions and elevations are divided by these before everything.
    cutoff : float
        A field answers where its activation exceeds this.
    noise_prior_observations : float
        Weight of the pooled noise variance in each field's own, as a number of observations.
    """

    kernel: Literal["gaussian", "bisquare"] = "gaussian"
    activation_threshold: Annotated[float, Field(gt=0, lt=1)] = 0.1
    prune_threshold: Annotated[float, Field(gt=0, le=1)] = 1.0
    initial_kernel_m: Annotated[float, Field(gt=0)] | None = None
    initial_distance_metric: tuple[tuple[float, float], tuple[float, float]] | None = None
    observations_per_field: Annotated[float, Field(gt=0)] = 20.0
    initial_forgetting_factor: Annotated[float, Field(gt=0, le=1)] = 0.99
    final_forgetting_factor: Annotated[float, Field(gt=0, le=1)] = 0.999
    forgetting_annealing: Annotated[float, Field(ge=0, le=1)] = 0.9995
    learn_metric: bool = False
    diagonal_metric: bool = True
    learning_rate: Annotated[float, Field(gt=0)] | None = None
    meta_learning: bool = False
    meta_rate: Annotated[float, Field(ge=0)] = 250.0
    penalty: Annotated[float, Field(ge=0)] | None = None
    initial_s2: Annotated[float, Field(gt=0)] = 1e-10
    input_scale: Annotated[float, Field(gt=0)] = 1.0
    output_scale: Annotated[float, Field(gt=0)] = 1.0
    cutoff: Annotated[float, Field(ge=0, lt=1)] = 0.001
    noise_prior_observations: Annotated[float, Field(gt=0)] = 4.0

    def __post_init__(self) -> None:
        """Refuse two sizes of new fields, and a metric that is none."""
        if self.initial_distance_metric is None:
            return
        if self.initial_kernel_m is not None:
            msg = "initial_kernel_m and initial_distance_metric both set the size of new fields: give one of them"
            raise ValueError(msg)
        (xx, xy), (yx, yy) = self.initial_distance_metric
        if xy != yx or xx <= 0 or xx * yy - xy * yx <= 0:
            msg = f"initial_distance_metric = {self.initial_distance_metric} is not symmetric and positive definite"
            raise ValueError(msg)


class ReferenceLWPR:
    """
    A surface learned by Locally Weighted Projection Regression, point after point [1]_, [2]_.

    Parameters
    ----------
    settings : ReferenceSettings or LWPRConfig, optional
        What a programme's `lwpr` section leaves out keeps its default.
    memory_days : float, days
        Time constant of forgetting between epochs.
    prior_observations : float
        Most effective observations that an epoch's statistics count for in the next.

    Attributes
    ----------
    origin_ : tuple of float, m
        Easting and northing that positions are taken relative to.
    parameters_ : Parameters
        What the kernels learn with.
    state_ : LWPRState
        The receptive fields.
    survey_time_ : float, days since 1970-01-01
        Of the newest epoch; 0 where no time was given.

    Notes
    -----
    Each receptive field is a weighted linear regression about its centre, updated by every point that activates it. It
    forgets by the point: after n more points, what it saw before counts lambda^n.

    *Epochs.* When a later epoch starts, the sums of each field are scaled by exp(-dt / memory_days), and further if
    they count for more than `prior_observations`; all by one factor, so that its plane stays as it is until points of
    the new epoch arrive. Its forgetting factor starts again. Points that arrive first move the plane to their level,
    so that a change is not attenuated; then they are learned. A field counts as observed in an epoch that brought it an
    activation mass of one.

    *Uncertainty.* `noise_std` comes from cross-validation residuals of the fields, Gamma_k. A field that has seen few
    takes the pooled variance of all as a prior that counts for a few observations. `elevation_std` is the standard
    deviation of the planes, taken as fully correlated, and their disagreement. `n_effective` is the effective number
    of observations, (sum w)^2 / sum w^2, that the answering fields remember.

    Standard deviations of single observations are not used: the algorithm knows no weights other than its activations.

    The result depends on the order of points. They are taken in a pseudo-random order that follows from their positions
    alone, within each call of `partial_fit`.

    References
    ----------
    .. [1] Vijayakumar, D'Souza & Schaal (2005), Incremental online learning in high dimensions, Neural Computation 17,
       doi:10.1162/089976605774320557.
    .. [2] Klanke, Vijayakumar & Schaal (2008), A library for locally weighted projection regression, JMLR 9, 623-626.

    Examples
    --------
    >>> import numpy as np
    >>> easting, northing = (axis.ravel() for axis in np.meshgrid(np.arange(0, 20, 0.5), np.arange(0, 20, 0.5)))
    >>> model = ReferenceLWPR().fit((easting, northing), 100.0 + 0.1 * easting)
    >>> model.predict((np.array([10.0]), np.array([10.0]))).elevation.round(1)
    array([101.])
    """

    def __init__(
        self,
        settings: ReferenceSettings | LWPRConfig | None = None,
        memory_days: float = 730.0,
        prior_observations: float = 1.0,
    ) -> None:
        for name, value in (("memory_days", memory_days), ("prior_observations", prior_observations)):
            if not value > 0:
                msg = f"{name} must be positive, not {value}"
                raise ValueError(msg)
        if not isinstance(settings, ReferenceSettings):
            settings = ReferenceSettings(**({} if settings is None else asdict(settings)))
        self.settings = settings
        self.memory_days = float(memory_days)
        self.prior_observations = float(prior_observations)
        self._reset()

    def _reset(self) -> None:
        self.origin_ = (0.0, 0.0)
        self.parameters_ = Parameters()
        self.state_ = LWPRState()
        self.survey_time_ = 0.0
        self.region_: Region = (math.inf, -math.inf, math.inf, -math.inf)
        #: Number, mean and sum of squares of all elevations, which bound the noise while nothing else does.
        self.elevations_ = (0.0, 0.0, 0.0)

    def fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
        order: Literal["hash", "given"] = "hash",
    ) -> Self:
        """
        Forget everything, then learn; see `partial_fit`.

        Returns
        -------
        self
        """
        self._reset()
        return self.partial_fit(coordinates, elevation, sigma, survey_time, order)

    def partial_fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
        order: Literal["hash", "given"] = "hash",
    ) -> Self:
        """
        Learn observations of the present epoch, or of a new one.

        Parameters
        ----------
        coordinates : (easting, northing), each shape (n,), m
        elevation : array, shape (n,), m
        sigma : array, shape (n,), m, optional
            Checked but not used, see the class.
        survey_time : float, days since 1970-01-01, optional
            A later time than the present epoch's starts a new epoch; None continues the present one.
        order : {"hash", "given"}
            Take the points in pseudo-random order, or as they come.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            Arrays do not match, values are not finite, there are none, or the time lies before the present epoch.
        """
        easting, northing, z, _ = check_observations(coordinates, elevation, sigma)
        if easting.size == 0:
            msg = "there are no observations to learn from"
            raise ValueError(msg)
        if order not in ("hash", "given"):
            msg = f"order must be 'hash' or 'given', not {order!r}"
            raise ValueError(msg)
        if order == "hash":
            at = _hashed_order(easting, northing, z)
            easting, northing, z = easting[at], northing[at], z[at]
        self._begin(easting, northing, survey_time)
        x, y = self._normalised(easting, northing)
        z = z / self.settings.output_scale
        self.elevations_ = _merged_moments(self.elevations_, z)
        move_to(self.state_, x, y, z, self.parameters_.kernel)
        learn(self.state_, x, y, z, self.parameters_)
        west, east, south, north = self.region_
        self.region_ = (
            min(west, float(easting.min())),
            max(east, float(easting.max())),
            min(south, float(northing.min())),
            max(north, float(northing.max())),
        )
        return self

    def predict(self, coordinates: Coordinates) -> Prediction:
        """
        Evaluate the surface.

        Parameters
        ----------
        coordinates : (easting, northing), each shape (n,), m

        Returns
        -------
        prediction : Prediction
            NaN where no trusted receptive field is active.
        """
        answer, scale = self._answer(coordinates), self.settings.output_scale
        return Prediction(
            elevation=answer.value * scale,
            elevation_std=np.sqrt(answer.value_variance) * scale,
            noise_std=np.sqrt(answer.noise_variance) * scale,
            n_effective=answer.n_effective,
            age_days=self.survey_time_ - answer.observed_time,
        )

    def observed(self, coordinates: Coordinates) -> FloatArray:
        """
        Effective number of observations of the newest epoch behind the answer at each place.

        Parameters
        ----------
        coordinates : (easting, northing), each shape (n,), m

        Returns
        -------
        n_observed : array, shape (n,)
            Twice the activation mass that the answering fields received in this epoch, each weighted by its
            activation at the place; 0 where none answers. Below about 2 the surface there is inherited, or
            extrapolated.

        Notes
        -----
        For evenly spread points (sum w)^2 / sum w^2 is 2 sum w. The sum is taken because it tells the difference that
        the ratio does not: a few points at the far rim of a field count for next to nothing.
        """
        return 2.0 * self._answer(coordinates).n_epoch

    @property
    def region(self) -> Region:
        """(west, east, south, north) of all observations so far, m."""
        return self.region_

    @property
    def kernel_size(self) -> float:
        """Kernel size of a new receptive field, m: the geometric mean of its two axes."""
        factor = self.parameters_
        return self.settings.input_scale / math.sqrt(factor.init_m_xx * factor.init_m_yy)

    def copy(self) -> Self:
        """Return a model that shares no state with this one."""
        other = type(self)(self.settings, self.memory_days, self.prior_observations)
        other.__dict__.update(self.__dict__)
        other.state_ = self.state_.copy()
        return other

    def save(self, directory: Path) -> None:
        """
        Persist into a folder, which is made if need be: one NetCDF file.

        Raises
        ------
        ModelStateError
            The model has learned nothing yet.
        OutputError
            The folder cannot be written.
        """
        write_state(directory, self)

    @classmethod
    def load(cls, directory: Path) -> Self:
        """
        Read a model back; predictions are bit-identical.

        Raises
        ------
        MissingInputError
            There is no state in the folder.
        ModelStateError
            The state is damaged, incomplete, or of another format version.
        """
        return read_state(directory, cls, ReferenceSettings)

    def _begin(self, easting: FloatArray, northing: FloatArray, survey_time: float | None) -> None:
        """Set up the learner with the first data; start a new epoch where the time says so."""
        present = self.survey_time_ if self.state_.n_fields else None
        time = float(survey_time) if survey_time is not None else (0.0 if present is None else present)
        if not math.isfinite(time):
            msg = f"survey_time must be finite, not {time}"
            raise ValueError(msg)
        if present is None:
            # rounded: a short number that people can read, and exact in float64
            self.origin_ = (round(float(easting.mean()), -1), round(float(northing.mean()), -1))
            self.parameters_ = _parameters(self.settings, easting, northing)
        elif time < present:
            msg = f"survey_time {time} lies before the present epoch, {present}; epochs are learned in order of time"
            raise ValueError(msg)
        elif time > present:
            decay = math.exp(-(time - present) / self.memory_days)
            inherit(self.state_, decay, self.prior_observations, present, self.settings.initial_forgetting_factor)
        self.survey_time_ = time
        self.parameters_ = self.parameters_._replace(survey_time=time)

    def _normalised(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        scale = self.settings.input_scale
        return (easting - self.origin_[0]) / scale, (northing - self.origin_[1]) / scale

    def _answer(self, coordinates: Coordinates) -> SurfacePrediction:
        easting, northing, _, _ = check_observations(coordinates, np.zeros(np.shape(coordinates[0])), None)
        if self.state_.n_fields == 0:
            nothing, none = np.full(easting.shape, np.nan), np.zeros(easting.shape)
            return SurfacePrediction(nothing, nothing, nothing, none, none, nothing, none)
        x, y = self._normalised(easting, northing)
        prior = noise_prior(self.state_, self.elevations_, self.settings.noise_prior_observations)
        answer = predict_surface(self.state_, x, y, self.parameters_.kernel, prior, cutoff=self.settings.cutoff)
        # what this epoch observed is entered in the fields only when it ends
        answer.observed_time[answer.field_epoch_mass >= OBSERVED_MASS] = self.survey_time_
        return answer


def _parameters(settings: ReferenceSettings, easting: FloatArray, northing: FloatArray) -> Parameters:
    """Settings as the kernels take them, with what is left open chosen from the first data."""
    if settings.initial_distance_metric is not None:
        metric = np.array(settings.initial_distance_metric)
    else:
        kernel_m = settings.initial_kernel_m
        if kernel_m is None:
            # of a uniform density a Gaussian sees sum w = 2 pi kernel^2 density, sum w^2 = pi kernel^2 density
            kernel_m = math.sqrt(settings.observations_per_field / (4.0 * math.pi * point_density(easting, northing)))
            logger.info("Kernel of new receptive fields: %.4g m, from the density of the points", kernel_m)
        metric = np.eye(2) * (settings.input_scale / kernel_m) ** 2
    factor = np.linalg.cholesky(metric).T
    # the library's penalty and rate belong to a metric of 25; the penalty acts on D^2, the rate moves sqrt(D)
    ratio = 25.0 / float(np.sqrt(np.linalg.det(metric)))
    return Parameters(
        kernel=GAUSSIAN if settings.kernel == "gaussian" else BISQUARE,
        w_gen=settings.activation_threshold,
        w_prune=settings.prune_threshold,
        init_lambda=settings.initial_forgetting_factor,
        final_lambda=settings.final_forgetting_factor,
        tau_lambda=settings.forgetting_annealing,
        init_s2=settings.initial_s2,
        init_m_xx=float(factor[0, 0]),
        init_m_xy=float(factor[0, 1]),
        init_m_yy=float(factor[1, 1]),
        update_d=settings.learn_metric,
        diag_only=settings.diagonal_metric,
        meta=settings.meta_learning,
        penalty=1e-6 * ratio**2 if settings.penalty is None else settings.penalty,
        init_alpha=15.0 / ratio if settings.learning_rate is None else settings.learning_rate,
        meta_rate=settings.meta_rate,
    )


def _hashed_order(easting: FloatArray, northing: FloatArray, elevation: FloatArray) -> IntArray:
    """
    Pseudo-random order of points that follows from the points alone.

    Positions are taken to the millimetre and mixed by the finaliser of splitmix64 (Steele, Lea & Flood 2014,
    doi:10.1145/2714064.2660195); points that share a place are ordered by elevation, then by their exact position.
    """
    mixed = np.zeros(easting.shape, dtype=np.uint64)
    for axis in (easting, northing):
        with np.errstate(over="ignore", invalid="ignore"):
            mixed ^= np.rint(axis / _ORDER_QUANTUM_M).astype(np.int64).view(np.uint64)
            mixed += np.uint64(0x9E3779B97F4A7C15)
            mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mixed ^= mixed >> np.uint64(31)
    order: IntArray = np.argsort(mixed, kind="stable")
    ranked = mixed[order]
    is_equal = ranked[1:] == ranked[:-1]
    if is_equal.any():
        at = np.flatnonzero(np.r_[False, is_equal] | np.r_[is_equal, False])
        tied = order[at]
        order[at] = tied[np.lexsort((northing[tied], easting[tied], elevation[tied], mixed[tied]))]
    return order


def _merged_moments(moments: tuple[float, float, float], values: FloatArray) -> tuple[float, float, float]:
    """Number, mean and sum of squares about it, of what was and of new values (Chan, Golub & LeVeque 1983)."""
    count, mean, squares = moments
    n, new_mean = len(values), float(values.mean())
    total, step = count + n, new_mean - mean
    new_squares = float(np.square(values - new_mean).sum())
    return total, mean + step * n / total, squares + new_squares + step * step * count * n / total
