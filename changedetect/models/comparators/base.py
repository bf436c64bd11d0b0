"""What the comparators share: they keep their observations, learn them as a whole, and answer in blocks."""

from __future__ import annotations

import dataclasses
import json
import logging
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import xarray as xr

from changedetect.errors import ModelStateError
from changedetect.models.base import Prediction
from changedetect.models.comparators.observations import (
    MIN_POINTS,
    Observations,
    check_positions,
    check_time,
    observations_from,
    stack_observations,
)
from changedetect.storage import read_dataset, write_dataset

if TYPE_CHECKING:
    from changedetect.typing import Coordinates, FloatArray

__all__ = ["LocalAnswer", "PointModel"]

logger = logging.getLogger(__name__)

_FORMAT_VERSION = 1
_FILE_NAME = "comparator.nc"

Prepared = TypeVar("Prepared")


@dataclass(frozen=True, eq=False)
class LocalAnswer:
    """What a method says at n places: arrays as in `Prediction`, elevation relative to the datum."""

    elevation: FloatArray
    elevation_std: FloatArray
    noise_std: FloatArray
    n_effective: FloatArray


@dataclass(kw_only=True, eq=False)
class PointModel(ABC, Generic[Prepared]):
    """
    A surface model that keeps the observations of the newest epoch and learns them anew whenever some are added.

    A subclass is a dataclass whose fields are its settings. It estimates parameters from observations (`_estimate`),
    builds what answers need from both (`_prepare`), and answers for a block of places (`_answer`).

    Attributes
    ----------
    max_points : int or None
        Largest number of observations the method is meant for; more are refused.
    parameters_ : dict of str to float
        What was learned; stored with the observations.

    Notes
    -----
    These methods have no way to weigh one epoch against another. An observation of a later `survey_time` therefore
    begins anew: what was learned before is dropped, and every answer has an age of 0 days.
    """

    max_points: int | None = None
    parameters_: dict[str, float] = field(init=False, default_factory=dict, repr=False)
    _points: FloatArray = field(init=False, default_factory=lambda: np.empty((4, 0)), repr=False)
    _survey_time: float = field(init=False, default=0.0, repr=False)
    _observations: Observations | None = field(init=False, default=None, repr=False)
    _prepared: Prepared | None = field(init=False, default=None, repr=False)

    #: Places answered at once.
    _block_size: ClassVar[int] = 20_000

    def fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
    ) -> Self:
        """
        Forget everything, then learn.

        Parameters
        ----------
        coordinates : (easting, northing), arrays of shape (n,), m
        elevation : array, shape (n,), m
        sigma : array, shape (n,), m, optional
            Standard deviation of each observation; noise beyond it is estimated.
        survey_time : float, days since 1970-01-01, optional
            0 where none is given.

        Raises
        ------
        ValueError
            Shapes differ, values are not finite, sigmas are not positive, there are fewer than 10 points or more than
            `max_points`.
        """
        points = stack_observations(coordinates, elevation, sigma)
        self._learn(points, check_time(survey_time, default=0.0))
        return self

    def partial_fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
    ) -> Self:
        """
        Learn more of the present epoch, or begin a later one; arguments as in `fit`.

        Raises
        ------
        ValueError
            As in `fit`; or `survey_time` lies before the present epoch's.
        """
        points = stack_observations(coordinates, elevation, sigma)
        if self._observations is None:
            self._learn(points, check_time(survey_time, default=0.0))
            return self
        time = check_time(survey_time, default=self._survey_time)
        if time < self._survey_time:
            msg = (
                f"survey_time {time!r} lies before the present epoch's {self._survey_time!r} (days since 1970-01-01). "
                "Learn epochs in order of time."
            )
            raise ValueError(msg)
        if time > self._survey_time:
            logger.info("%s begins a new epoch and drops %d points", type(self).__name__, len(self._observations))
            self._learn(points, time)
        else:
            self._learn(np.hstack([self._points, points]), time)
        return self

    def predict(self, coordinates: Coordinates) -> Prediction:
        """
        Evaluate the surface.

        Parameters
        ----------
        coordinates : (easting, northing), arrays of shape (m,), m

        Returns
        -------
        prediction : Prediction
            NaN and `n_effective` 0 where the observations say nothing; `age_days` is 0 elsewhere.

        Raises
        ------
        ValueError
            Nothing was learned yet, or the coordinates are not finite or differ in shape.
        """
        observations, prepared = self._observations, self._prepared
        if observations is None or prepared is None:
            msg = f"{type(self).__name__} has learned nothing yet; call fit first."
            raise ValueError(msg)
        easting, northing = check_positions(coordinates)
        layers = np.empty((4, easting.size))
        with _one_thread():
            for first in range(0, easting.size, self._block_size):
                block = slice(first, first + self._block_size)
                answer = self._answer(
                    prepared, easting[block] - observations.origin[0], northing[block] - observations.origin[1]
                )
                layers[:, block] = answer.elevation, answer.elevation_std, answer.noise_std, answer.n_effective
        return _prediction(layers, observations.datum)

    def copy(self) -> Self:
        """Return a model that shares no state with this one; arrays that nothing changes are shared."""
        twin = type(self)(**self.settings())
        twin.parameters_ = dict(self.parameters_)
        twin._points, twin._survey_time = self._points, self._survey_time
        twin._observations, twin._prepared = self._observations, self._prepared
        return twin

    def settings(self) -> dict[str, Any]:
        """Return what the constructor was given, by name."""
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self) if item.init}

    def save(self, directory: Path) -> None:
        """
        Persist observations, settings and parameters into `directory`, in one NetCDF file.

        Raises
        ------
        ValueError
            Nothing was learned yet.
        OutputError
            The folder cannot be written.
        """
        if self._observations is None:
            msg = f"{type(self).__name__} has learned nothing yet; there is nothing to save."
            raise ValueError(msg)
        names = ("easting", "northing", "elevation", "variance")
        units = ("m", "m", "m", "m2")
        dataset = xr.Dataset(
            {name: ("point", row, {"units": unit}) for name, row, unit in zip(names, self._points, units, strict=True)},
            attrs={
                "format_version": _FORMAT_VERSION,
                "model": type(self).__name__,
                "settings": json.dumps(self.settings()),
                # hexadecimal, so that the parameters come back bit for bit
                "parameters": json.dumps({name: value.hex() for name, value in self.parameters_.items()}),
                "survey_time": self._survey_time.hex(),
            },
        )
        write_dataset(Path(directory) / _FILE_NAME, dataset)

    @classmethod
    def load(cls, directory: Path) -> Self:
        """
        Read a model back; its predictions are bit-identical on the same machine.

        Raises
        ------
        MissingInputError
            No model was saved there.
        ModelStateError
            The file is damaged, of another format version, or of another kind of model.
        """
        path = Path(directory) / _FILE_NAME
        dataset = read_dataset(path)
        _require_kind(dataset, cls.__name__, path)
        try:
            model = cls(**json.loads(dataset.attrs["settings"]))
            parameters = json.loads(dataset.attrs["parameters"])
            model.parameters_ = {name: float.fromhex(value) for name, value in parameters.items()}
            time = float.fromhex(dataset.attrs["survey_time"])
            points = np.stack([dataset[name].values for name in ("easting", "northing", "elevation", "variance")])
            model._observations = observations_from(points)
            with _one_thread():
                model._prepared = model._prepare(model._observations, model.parameters_)
        except (KeyError, TypeError, ValueError) as error:
            msg = f"{path} is not a whole {cls.__name__}: {error}. Fit the model again and save it."
            raise ModelStateError(msg) from error
        model._points, model._survey_time = points, time
        return model

    def _learn(self, points: FloatArray, survey_time: float) -> None:
        """Learn `points` alone; the model is untouched when this fails."""
        n_points = points.shape[1]
        if n_points < MIN_POINTS:
            msg = f"{type(self).__name__} needs at least {MIN_POINTS} points; got {n_points}."
            raise ValueError(msg)
        if self.max_points is not None and n_points > self.max_points:
            msg = (
                f"{type(self).__name__} takes at most {self.max_points} points; got {n_points}. "
                "Thin the points, raise max_points, or use a method that scales."
            )
            raise ValueError(msg)
        points = points[:, np.lexsort(points[::-1])]
        observations = observations_from(points)
        with _one_thread():
            parameters = self._estimate(observations)
            prepared = self._prepare(observations, parameters)
        self._points, self._survey_time = points, survey_time
        self._observations, self.parameters_, self._prepared = observations, parameters, prepared

    @abstractmethod
    def _estimate(self, observations: Observations) -> dict[str, float]:
        """Return the parameters of the method, learned from observations."""

    @abstractmethod
    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> Prepared:
        """Build what answers need; a pure function of its arguments and the settings."""

    @abstractmethod
    def _answer(self, prepared: Prepared, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        """Answer at places relative to the origin; `n_effective` is 0 where the observations say nothing."""


def _one_thread() -> AbstractContextManager[object]:
    """
    Keep BLAS to one thread inside a `with` block, if threadpoolctl, which comes with scikit-learn, is there.

    Threads that wait for each other made factorisations of a few hundred points ten times slower on a busy machine,
    and their number changes the last bits of the result.
    """
    try:
        threadpoolctl = import_module("threadpoolctl")
    except ImportError:
        return nullcontext()
    limit: AbstractContextManager[object] = threadpoolctl.threadpool_limits(limits=1, user_api="blas")
    return limit


def _prediction(layers: FloatArray, datum: float) -> Prediction:
    elevation, elevation_std, noise_std, n_effective = layers
    is_known = n_effective > 0.0
    return Prediction(
        elevation=np.where(is_known, elevation + datum, np.nan),
        elevation_std=np.where(is_known, elevation_std, np.nan),
        noise_std=np.where(is_known, noise_std, np.nan),
        n_effective=np.where(is_known, n_effective, 0.0),
        age_days=np.where(is_known, 0.0, np.nan),
    )


def _require_kind(dataset: xr.Dataset, model: str, path: Path) -> None:
    version, kind = dataset.attrs.get("format_version"), dataset.attrs.get("model")
    if version != _FORMAT_VERSION:
        msg = f"{path} has format version {version}; this version reads {_FORMAT_VERSION}. Fit the model again."
        raise ModelStateError(msg)
    if kind != model:
        msg = f"{path} holds a {kind!r}, not a {model!r}. Load it with the class that saved it."
        raise ModelStateError(msg)
