"""
The contract of a surface model, as checks that any model can be put through.

Each check takes a factory, which makes a fresh model, and raises `ContractViolationError` when the model breaks a
promise of `SurfaceModel`. `check_surface_model` runs them all. A model that cannot keep a promise is exempted from
that check by name, where everybody can see it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from changedetect.models.base import Prediction

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from changedetect.models.base import SurfaceModel
    from changedetect.typing import Coordinates, FloatArray

__all__ = [
    "CHECKS",
    "ContractViolationError",
    "ModelFactory",
    "check_copy_is_independent",
    "check_far_away_is_unknown",
    "check_fit_forgets",
    "check_inputs_are_untouched",
    "check_later_epoch_is_followed",
    "check_learned_state_is_own",
    "check_order_changes_little",
    "check_prediction_is_well_formed",
    "check_read_only_inputs_are_accepted",
    "check_rejects_bad_observations",
    "check_rejects_bad_places",
    "check_rejects_earlier_epoch",
    "check_save_and_load_are_exact",
    "check_shifted_elevation_shifts_the_answer",
    "check_surface_is_learned",
    "check_surface_model",
    "check_translation_changes_little",
    "check_unfitted_model_knows_nothing",
]

ModelFactory: TypeAlias = "Callable[[], SurfaceModel]"

#: South-west corner of the checks' ground, m: UTM magnitudes.
_CORNER = (500_000.0, 5_300_000.0)
_SIDE = 24.0
_NOISE_STD = 0.03
_LAYERS = ("elevation", "elevation_std", "noise_std", "n_effective", "age_days")


class ContractViolationError(AssertionError):
    """A model breaks a promise of `SurfaceModel`."""


def check_surface_model(factory: ModelFactory, exempt: Collection[str] = ()) -> None:
    """
    Put a model through the whole contract.

    Parameters
    ----------
    factory : callable
        Makes a fresh, unfitted model.
    exempt : collection of str
        Names of checks to leave out.

    Raises
    ------
    ContractViolationError
        The model breaks a promise.
    ValueError
        A name in `exempt` is not that of a check.
    """
    unknown = set(exempt) - {check.__name__ for check in CHECKS}
    if unknown:
        msg = f"No check is called {', '.join(sorted(unknown))}; see changedetect.models.checks.CHECKS."
        raise ValueError(msg)
    for check in CHECKS:
        if check.__name__ not in exempt:
            check(factory)


def check_surface_is_learned(factory: ModelFactory) -> None:
    """The surface comes out within a few centimetres on gentle ground, and the noise within a factor of two."""
    coordinates, elevation = _survey(1)
    places = _places(1)
    answer = factory().fit(coordinates, elevation).predict(places)
    error = answer.elevation - _ground(*places)
    _require(bool(np.isfinite(error).all()), "a place amid observations has no answer")
    rmse = float(np.sqrt(np.mean(error**2)))
    _require(rmse < 2.0 * _NOISE_STD, f"RMSE {rmse:.4f} m on gentle ground with noise of {_NOISE_STD} m")
    noise = float(np.median(answer.noise_std))
    _require(0.5 * _NOISE_STD < noise < 2.0 * _NOISE_STD, f"noise_std {noise:.4f} m where {_NOISE_STD} m was added")


def check_prediction_is_well_formed(factory: ModelFactory) -> None:
    """All layers are float64 of the places' shape; spreads are not negative; NaN and n_effective 0 go together."""
    model = factory().fit(*_survey(2))
    places = tuple(np.append(values, _CORNER[axis] + 1e6) for axis, values in enumerate(_places(2)))
    for n_places in (0, 1, places[0].size):
        answer = model.predict((places[0][:n_places], places[1][:n_places]))
        _require(isinstance(answer, Prediction), f"predict returned a {type(answer).__name__}")
        for name in _LAYERS:
            layer = getattr(answer, name)
            _require(layer.shape == (n_places,), f"{name} has shape {layer.shape} for {n_places} places")
            _require(layer.dtype == np.float64, f"{name} has dtype {layer.dtype}")
        known = np.isfinite(answer.elevation)
        _require(bool((answer.n_effective[known] > 0.0).all()), "n_effective is not positive at an answer")
        _require(bool((answer.n_effective[~known] == 0.0).all()), "n_effective is not 0 where there is no answer")
        for name in ("elevation_std", "noise_std", "age_days"):
            layer = getattr(answer, name)
            _require(bool((layer[known] >= 0.0).all()), f"{name} is negative or NaN at an answer")
            _require(bool(np.isnan(layer[~known]).all()), f"{name} is not NaN where there is no answer")
        _require(bool((answer.age_days[known] == 0.0).all()), "age_days is not 0 in the only epoch")


def check_far_away_is_unknown(factory: ModelFactory) -> None:
    """A million metres from all observations there is no elevation."""
    model = factory().fit(*_survey(3))
    away = 1e6
    east, north = np.array([away, -away, 0.0]) + _CORNER[0], np.array([0.0, away, -away]) + _CORNER[1]
    answer = model.predict((east, north))
    _require(bool(np.isnan(answer.elevation).all()), f"elevation {answer.elevation} is claimed far from all data")
    _require(bool((answer.n_effective == 0.0).all()), f"n_effective is {answer.n_effective} far from all data")


def check_inputs_are_untouched(factory: ModelFactory) -> None:
    """Learning and predicting leave the caller's arrays as they were."""
    (easting, northing), elevation = _survey(4)
    sigma = np.full(elevation.shape, _NOISE_STD)
    places = _places(4)
    arrays = (easting, northing, elevation, sigma, *places)
    before = [array.copy() for array in arrays]
    model = factory().fit((easting, northing), elevation, sigma)
    model.partial_fit((easting, northing), elevation, sigma)
    model.predict(places)
    for array, original in zip(arrays, before, strict=True):
        _require(bool(np.array_equal(array, original)), "an input array was changed")


def check_read_only_inputs_are_accepted(factory: ModelFactory) -> None:
    """Arrays that may not be written to, as memory-mapped files give them, teach as well as others."""
    (easting, northing), elevation = _survey(22)
    expected = factory().fit((easting, northing), elevation).predict(_places(22))
    east, north = _places(22)
    for array in (easting, northing, elevation, east, north):
        array.flags.writeable = False
    answer = factory().fit((easting, northing), elevation).predict((east, north))
    _require_equal(expected, answer, "read-only arrays give another surface")


def check_learned_state_is_own(factory: ModelFactory) -> None:
    """Writing into the caller's arrays after learning does not change the model."""
    (easting, northing), elevation = _survey(5)
    model = factory().fit((easting, northing), elevation)
    before = model.predict(_places(5))
    easting += 3.0
    elevation *= -1.0
    _require_equal(before, model.predict(_places(5)), "a model follows its caller's arrays")
    before.elevation[:] = 0.0
    again = model.predict(_places(5))
    _require(bool(np.any(again.elevation != 0.0)), "a model answers with an array it gave away before")


def check_copy_is_independent(factory: ModelFactory) -> None:
    """A copy answers the same; learning more in either leaves the other as it was."""
    model = factory().fit(*_survey(6), survey_time=100.0)
    before = model.predict(_places(6))
    twin = model.copy()
    _require(type(twin) is type(model), f"copy of a {type(model).__name__} is a {type(twin).__name__}")
    _require_equal(before, twin.predict(_places(6)), "a copy answers differently")
    coordinates, elevation = _survey(7)
    twin.partial_fit(coordinates, elevation + 1.0, survey_time=200.0)
    _require_equal(before, model.predict(_places(6)), "learning in a copy changed the original")
    twin = model.copy()
    model.partial_fit(coordinates, elevation - 1.0, survey_time=200.0)
    _require_equal(before, twin.predict(_places(6)), "learning in the original changed its copy")


def check_save_and_load_are_exact(factory: ModelFactory) -> None:
    """A model read back answers bit for bit as before, also after both learned more."""
    model = factory().fit(*_survey(8), survey_time=100.0)
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "state"
        model.save(directory)
        restored = type(model).load(directory)
        _require_equal(model.predict(_places(8)), restored.predict(_places(8)), "a reloaded model answers differently")
    coordinates, elevation = _survey(9)
    for each in (model, restored):
        each.partial_fit(coordinates, elevation + 0.2, survey_time=300.0)
    _require_equal(
        model.predict(_places(8)), restored.predict(_places(8)), "a reloaded model learns differently afterwards"
    )


def check_fit_forgets(factory: ModelFactory) -> None:
    """`fit` on a model that learned something else is `partial_fit` on a fresh one."""
    coordinates, elevation = _survey(10)
    used = factory().fit(*_survey(11), survey_time=50.0)
    used.fit(coordinates, elevation, survey_time=20.0)
    fresh = factory().partial_fit(coordinates, elevation, survey_time=20.0)
    _require_equal(used.predict(_places(10)), fresh.predict(_places(10)), "fit does not forget what was learned before")


def check_order_changes_little(factory: ModelFactory) -> None:
    """The same observations in another order give the same surface."""
    (easting, northing), elevation = _survey(12)
    order = np.random.default_rng(12).permutation(elevation.size)
    one = factory().fit((easting, northing), elevation).predict(_places(12))
    two = factory().fit((easting[order], northing[order]), elevation[order]).predict(_places(12))
    _require_close(one, two, 1e-7, "the order of the observations changes the surface")


def check_translation_changes_little(factory: ModelFactory) -> None:
    """
    The same survey elsewhere gives the same surface, at local coordinates and at UTM coordinates alike.

    Models may cut the ground along fixed multiples of some length, which a translation shifts against the
    observations; so the answers may differ by a part of the noise, but not by more.
    """
    (easting, northing), elevation = _survey(13)
    east, north = _places(13)
    here = factory().fit((easting, northing), elevation).predict((east, north))
    for shift in ((-_CORNER[0], -_CORNER[1]), (2.0**17, 2.0**20)):
        there = factory().fit((easting + shift[0], northing + shift[1]), elevation)
        answer = there.predict((east + shift[0], north + shift[1]))
        difference = answer.elevation - here.elevation
        rms = float(np.sqrt(np.mean(difference**2)))
        _require(rms <= 0.3 * _NOISE_STD, f"translation by {shift} m changes the surface by {rms:.2e} m rms")


def check_shifted_elevation_shifts_the_answer(factory: ModelFactory) -> None:
    """Raising all observations by 100 m raises the surface by 100 m and leaves spreads as they were."""
    for n_points in (860, 1_200):
        coordinates, elevation = _survey(14, n_points)
        low = factory().fit(coordinates, elevation).predict(_places(14))
        high = factory().fit(coordinates, elevation + 100.0).predict(_places(14))
        rise = high.elevation - low.elevation
        worst = float(np.nanmax(np.abs(rise - 100.0)))
        _require(worst < 1e-5, f"raising the observations by 100 m raises the surface by that only to {worst:.1e} m")
        for name in ("elevation_std", "noise_std"):
            ratio = getattr(high, name) / getattr(low, name)
            worst = float(np.nanmax(np.abs(ratio - 1.0)))
            _require(worst < 1e-3, f"raising the observations by 100 m changes {name} by up to {worst:.1%}")


def check_later_epoch_is_followed(factory: ModelFactory) -> None:
    """After a later survey that covers everything the surface stands where that survey saw it."""
    model = factory().fit(*_survey(15), survey_time=19_000.0)
    coordinates, elevation = _survey(16)
    model.partial_fit(coordinates, elevation + 0.5, survey_time=19_180.0)
    answer = model.predict(_places(15))
    step = float(np.mean(answer.elevation - _ground(*_places(15))))
    _require(abs(step - 0.5) < 0.025, f"a step of 0.500 m between two epochs is followed by {step:.3f} m")
    _require(bool((answer.age_days < 1.0).all()), "ground seen by the newest epoch has an age")


def check_unfitted_model_knows_nothing(factory: ModelFactory) -> None:
    """Before anything was learned, predict either refuses with a ValueError or answers nowhere."""
    try:
        answer = factory().predict(_places(17))
    except ValueError:
        return
    is_silent = bool(np.isnan(answer.elevation).all() and (answer.n_effective == 0.0).all())
    _require(is_silent, "predict answers before anything was learned")


def check_rejects_bad_observations(factory: ModelFactory) -> None:
    """Unequal shapes, NaN, infinities, two dimensions, words and bad sigmas are ValueErrors; nothing is lost."""
    (easting, northing), elevation = _survey(18)
    model = factory().fit((easting, northing), elevation)
    before = model.predict(_places(18))
    broken = elevation.copy()
    broken[7] = np.nan
    endless = easting.copy()
    endless[3] = np.inf
    words = np.full(elevation.shape, "high")
    ones = np.ones_like(elevation)
    cases: dict[str, Callable[[], object]] = {
        "elevation is too short": lambda: model.partial_fit((easting, northing), elevation[:-1]),
        "northing is too short": lambda: model.partial_fit((easting, northing[:-1]), elevation),
        "sigma is too short": lambda: model.partial_fit((easting, northing), elevation, ones[:-1]),
        "elevation holds NaN": lambda: model.partial_fit((easting, northing), broken),
        "easting is infinite": lambda: model.partial_fit((endless, northing), elevation),
        "sigma holds NaN": lambda: model.partial_fit((easting, northing), elevation, broken),
        "sigma is zero": lambda: model.partial_fit((easting, northing), elevation, 0.0 * ones),
        "elevation has two dimensions": lambda: model.partial_fit((easting, northing), elevation[:, None]),
        "elevation is words": lambda: model.partial_fit((easting, northing), words),
        "survey_time is NaN": lambda: model.partial_fit((easting, northing), elevation, survey_time=float("nan")),
    }
    for case, attempt in cases.items():
        _require_value_error(attempt, case)
    _require_equal(before, model.predict(_places(18)), "refused observations changed the model")


def check_rejects_earlier_epoch(factory: ModelFactory) -> None:
    """A survey time before the present epoch's is a ValueError."""
    model = factory().fit(*_survey(19), survey_time=200.0)
    _require_value_error(lambda: model.partial_fit(*_survey(20), survey_time=100.0), "survey_time runs backwards")


def check_rejects_bad_places(factory: ModelFactory) -> None:
    """Unequal shapes, NaN and words among the places asked for are ValueErrors."""
    model = factory().fit(*_survey(21))
    east, north = _places(21)
    missing = east.copy()
    missing[0] = np.nan
    cases: dict[str, Callable[[], object]] = {
        "northing is too short": lambda: model.predict((east, north[:-1])),
        "easting holds NaN": lambda: model.predict((missing, north)),
        "places have two dimensions": lambda: model.predict((east[:, None], north[:, None])),
        "places are words": lambda: model.predict((np.full(east.shape, "there"), north)),
    }
    for case, attempt in cases.items():
        _require_value_error(attempt, case)


#: All checks, in the order `check_surface_model` runs them.
CHECKS: tuple[Callable[[ModelFactory], None], ...] = (
    check_surface_is_learned,
    check_prediction_is_well_formed,
    check_far_away_is_unknown,
    check_inputs_are_untouched,
    check_read_only_inputs_are_accepted,
    check_learned_state_is_own,
    check_copy_is_independent,
    check_save_and_load_are_exact,
    check_fit_forgets,
    check_order_changes_little,
    check_translation_changes_little,
    check_shifted_elevation_shifts_the_answer,
    check_later_epoch_is_followed,
    check_unfitted_model_knows_nothing,
    check_rejects_bad_observations,
    check_rejects_earlier_epoch,
    check_rejects_bad_places,
)


def _ground(easting: FloatArray, northing: FloatArray) -> FloatArray:
    """Gentle ground: a slope and one wave, about 50 m up."""
    east, north = easting - _CORNER[0], northing - _CORNER[1]
    return np.asarray(50.0 + 0.08 * east - 0.05 * north + 0.3 * np.sin(2.0 * np.pi * (east + 0.5 * north) / 15.0))


def _survey(seed: int, n_points: int = 860) -> tuple[Coordinates, FloatArray]:
    """Scattered observations of the ground, about 1.5 per m2, with white noise."""
    rng = np.random.default_rng([2_718, seed])
    easting, northing = rng.uniform(0.0, _SIDE, (2, n_points))
    easting, northing = easting + _CORNER[0], northing + _CORNER[1]
    return (easting, northing), _ground(easting, northing) + rng.normal(0.0, _NOISE_STD, n_points)


def _places(seed: int, n_places: int = 200) -> Coordinates:
    """Places amid the observations, 3 m from their border."""
    rng = np.random.default_rng([3_141, seed])
    easting, northing = rng.uniform(3.0, _SIDE - 3.0, (2, n_places))
    return easting + _CORNER[0], northing + _CORNER[1]


def _require(is_kept: bool, violation: str) -> None:
    if not is_kept:
        msg = f"Contract of SurfaceModel broken: {violation}."
        raise ContractViolationError(msg)


def _require_equal(one: Prediction, two: Prediction, violation: str) -> None:
    for name in _LAYERS:
        first, second = getattr(one, name), getattr(two, name)
        _require(bool(np.array_equal(first, second, equal_nan=True)), f"{violation} ({name})")


def _require_close(one: Prediction, two: Prediction, tolerance: float, violation: str) -> None:
    for name in ("elevation", "elevation_std", "noise_std"):
        first, second = getattr(one, name), getattr(two, name)
        is_close = np.allclose(first, second, rtol=0.0, atol=tolerance, equal_nan=True)
        _require(bool(is_close), f"{violation} ({name} by up to {np.nanmax(np.abs(first - second)):.2e})")


def _require_value_error(attempt: Callable[[], object], case: str) -> None:
    try:
        attempt()
    except ValueError:
        return
    except Exception as error:
        msg = f"Contract of SurfaceModel broken: where {case}, {type(error).__name__} is raised, not ValueError."
        raise ContractViolationError(msg) from error
    _require(False, f"{case}, and no ValueError is raised")
