"""The settings of a programme as frozen values: every key, its default and its range, declared once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any, Literal, get_origin, get_type_hints

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from changedetect.typing import Region

__all__ = [
    "FORMAT_VERSION",
    "KEYS",
    "PROGRAMME_FILE",
    "SECTIONS",
    "AdaptiveConfig",
    "CoregistrationConfig",
    "DifferencingConfig",
    "FlightsConfig",
    "Key",
    "LWPRConfig",
    "MachineConfig",
    "ProgrammeConfig",
]

#: Version of the layout of `programme.toml`.
FORMAT_VERSION = 1
PROGRAMME_FILE = "programme.toml"

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class AdaptiveConfig:
    """
    Settings of the adaptive surface model; what is None is chosen from the data of the first epoch.

    Attributes
    ----------
    cell_size_m : float or None, m
        Edge of the micro-cells whose moments are kept.
    kernel_min_m, kernel_max_m : float or None, m
        Kernel size the density of an epoch supports, and the coarsest kernel of the pyramid of receptive fields. The
        kernel is LWPR's bisquare, which ends at twice this size.
    kernel_ratio : float
        Kernel of one level of the pyramid over that of the next finer one.
    lattice_spacing : float
        Distance of neighbouring receptive fields of one level, in kernels.
    shrinkage : float
        Strength of the empirical-Bayes shrinkage of the local planes; 0 switches it off.
    prior_observations : float
        What a micro-cell remembers of earlier epochs counts for at most this many observations.
    outlier_limit : float
        An observation is left out as a gross error where the third nearest in height among those around it is this
        many times further away than is common there; 0 keeps all.
    """

    cell_size_m: Annotated[float, Field(gt=0)] | None = None
    kernel_min_m: Annotated[float, Field(gt=0)] | None = None
    kernel_max_m: Annotated[float, Field(gt=0)] | None = None
    kernel_ratio: Annotated[float, Field(gt=1, lt=4)] = 1.7
    lattice_spacing: Annotated[float, Field(gt=0, le=2)] = 0.8
    shrinkage: Annotated[float, Field(ge=0)] = 1.0
    prior_observations: Annotated[float, Field(gt=0)] = 1.0
    outlier_limit: Annotated[float, Field(ge=0)] = 11.0

    def __post_init__(self) -> None:
        """Refuse an empty range of kernels."""
        if self.kernel_min_m is not None and self.kernel_max_m is not None and self.kernel_min_m > self.kernel_max_m:
            msg = f"kernel_min_m = {self.kernel_min_m} is larger than kernel_max_m = {self.kernel_max_m}"
            raise ValueError(msg)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class LWPRConfig:
    """
    Settings of the reference mode, the algorithm of Vijayakumar, D'Souza and Schaal (2005).

    Attributes
    ----------
    kernel : {"gaussian", "bisquare"}
        Shape of the activation.
    activation_threshold : float
        A point that activates no receptive field more than this gets a new one.
    prune_threshold : float
        Of two receptive fields that a point activates more than this, one goes; 1 switches it off.
    initial_kernel_m : float or None, m
        Kernel of a new receptive field; None chooses it from the density of the first points.
    observations_per_field : float
        Activation mass that this choice aims at.
    initial_forgetting_factor, final_forgetting_factor, forgetting_annealing : float
        The forgetting factor of a receptive field goes from the first to the second, at a pace given by the third.
    learn_metric, diagonal_metric : bool
        Adapt each kernel by gradient descent on the leave-one-out error; its axes stay aligned with the grid.
    learning_rate, penalty : float or None
        Of that descent; None scales those of the published library to the first kernel.
    meta_learning, meta_rate : bool, float
        Adapt the learning rates too (incremental delta-bar-delta).
    cutoff : float
        A receptive field answers where its activation exceeds this.
    noise_prior_observations : float
        Weight of the pooled noise variance in each receptive field's own, as a number of observations.
    """

    kernel: Literal["gaussian", "bisquare"] = "gaussian"
    activation_threshold: Annotated[float, Field(gt=0, lt=1)] = 0.1
    prune_threshold: Annotated[float, Field(gt=0, le=1)] = 1.0
    initial_kernel_m: Annotated[float, Field(gt=0)] | None = None
    observations_per_field: Annotated[float, Field(gt=0)] = 20.0
    initial_forgetting_factor: Annotated[float, Field(gt=0, le=1)] = 0.99
    final_forgetting_factor: Annotated[float, Field(gt=0, le=1)] = 0.999
    forgetting_annealing: Annotated[float, Field(ge=0, le=1)] = 0.9995
    learn_metric: bool = False
    diagonal_metric: bool = True
    learning_rate: Annotated[float, Field(gt=0)] | None = None
    penalty: Annotated[float, Field(ge=0)] | None = None
    meta_learning: bool = False
    meta_rate: Annotated[float, Field(ge=0)] = 250.0
    cutoff: Annotated[float, Field(ge=0, lt=1)] = 0.001
    noise_prior_observations: Annotated[float, Field(gt=0)] = 4.0


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class CoregistrationConfig:
    """
    How each new epoch is aligned to the surface of the first one.

    Attributes
    ----------
    enabled : bool
    transform : {"auto", "none", "vertical", "shift", "shift_tilt", "rigid", "rigid_scale"}
        "auto" takes the simplest transform that suffices, and none, with a warning, where the epoch cannot be aligned;
        "none" measures and reports the offset but moves nothing. Another kind is demanded: an epoch that does not
        allow it is refused.
    stable_areas : str or None
        Vector file with polygons of ground that does not change, relative to the programme's folder; None: unchanged
        ground is found.
    """

    enabled: bool = True
    transform: Literal["auto", "none", "vertical", "shift", "shift_tilt", "rigid", "rigid_scale"] = "auto"
    stable_areas: Annotated[str, Field(min_length=1)] | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class DifferencingConfig:
    """
    Settings of the difference of two epochs.

    Attributes
    ----------
    confidence : float
        Two-sided confidence of the level of detection and of the intervals in the summary.
    change_threshold_m : float, m
        The change whose exceedance `change_probability` states.
    predict_errors : {"never", "stable", "always"}
        Whether correlated errors are predicted from the unchanged ground around and taken off the difference: where
        stable areas are named, or also from ground found not to have changed, at the price that weak change over much
        of a map, which cannot be found, is in part taken for error.
    colour_limit_m : float or None, m
        Change that maps show in full colour; None takes what suits the first map of the programme, for all maps.
    """

    confidence: Annotated[float, Field(gt=0.5, lt=1)] = 0.95
    change_threshold_m: Annotated[float, Field(ge=0)] = 0.10
    predict_errors: Literal["never", "stable", "always"] = "stable"
    colour_limit_m: Annotated[float, Field(gt=0)] | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class FlightsConfig:
    """
    How points are made from flights.

    Attributes
    ----------
    joint : {"auto", "never", "always"}
        Whether a flight is adjusted to the photos of the first flight of the programme and of the one before, whose
        poses, points and models stay as they are. "auto" does so where enough ground is seen by both, "always"
        refuses a flight where it is not.
    dense : bool
        A point for every cell of a fine grid.
    calibrate : bool
        Estimate the lens parameters that the photos of each flight determine.
    """

    joint: Literal["auto", "never", "always"] = "auto"
    dense: bool = False
    calibrate: bool = False


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class MachineConfig:
    """How a machine runs the work; results do not depend on it. `workers` = 0 takes all cores."""

    workers: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class ProgrammeConfig:
    """
    Everything `programme.toml` may say.

    Attributes
    ----------
    format_version : int
        Version of the file's layout.
    name : str
        Name of the programme, for people; the folder's name where it is not given.
    crs : str
        Horizontal CRS of all results, with the vertical one after a plus: ``EPSG:32632+5773``. Projected, metres.
    resolution : float, m
        Cell size of the rasters. Kernels that the adaptive mode chooses itself are not finer than this.
    bounds : tuple (west, east, south, north) or None, m
        Ground the programme covers, in its CRS: points outside are left out and every raster covers exactly
        this region, snapped outwards to the resolution. None: whatever the surveys observed.
    profile : str or None
        A file of `configs/` whose values suit one kind of survey.
    model : {"adaptive", "reference"}
        Surface model: the adaptive mode, or LWPR as published.
    memory_days : float, days
        Time constant of forgetting: evidence inherited over t days is scaled by exp(-t / memory_days).
    pairs : {"consecutive", "first", "all"}
        Which epochs `update` differences: neighbours in time and the first with the last; each with the first;
        every two.
    adaptive, lwpr, coregistration, flights, differencing, machine
        The sections of the file.
    """

    crs: str
    format_version: Annotated[int, Field(ge=1, le=FORMAT_VERSION)] = FORMAT_VERSION
    name: str = ""
    resolution: Annotated[float, Field(gt=0, le=1000)] = 1.0
    bounds: Region | None = None
    profile: str | None = None
    model: Literal["adaptive", "reference"] = "adaptive"
    memory_days: Annotated[float, Field(gt=0)] = 730.0
    pairs: Literal["consecutive", "first", "all"] = "consecutive"
    adaptive: AdaptiveConfig = Field(default_factory=AdaptiveConfig)
    lwpr: LWPRConfig = Field(default_factory=LWPRConfig)
    coregistration: CoregistrationConfig = Field(default_factory=CoregistrationConfig)
    flights: FlightsConfig = Field(default_factory=FlightsConfig)
    differencing: DifferencingConfig = Field(default_factory=DifferencingConfig)
    machine: MachineConfig = Field(default_factory=MachineConfig)

    def __post_init__(self) -> None:
        """Refuse bounds that enclose nothing; the usual cause is another order of the four numbers."""
        if self.bounds is None:
            return
        west, east, south, north = self.bounds
        if not (west < east and south < north):
            msg = f"bounds are (west, east, south, north) with west < east and south < north, not {self.bounds}"
            raise ValueError(msg)

    @property
    def learning_settings(self) -> dict[str, Any]:
        """Settings a learned model depends on, by dotted key, as JSON knows them."""
        common = {
            "crs": self.crs,
            "bounds": None if self.bounds is None else list(self.bounds),
            "model": self.model,
            "memory_days": self.memory_days,
        } | _dotted("coregistration", self.coregistration)
        if self.model == "reference":
            return common | _dotted("lwpr", self.lwpr)
        return common | {"resolution": self.resolution} | _dotted("adaptive", self.adaptive)

    def product_settings(self, *, differencing: bool) -> dict[str, Any]:
        """Settings the rasters depend on besides their models: the grid, and those of the difference if asked."""
        grid = {
            "crs": self.crs,
            "resolution": self.resolution,
            "bounds": None if self.bounds is None else list(self.bounds),
        }
        return grid | _dotted("differencing", self.differencing) if differencing else grid

    @property
    def flight_settings(self) -> dict[str, Any]:
        """Settings that the points made from a flight depend on by themselves, by dotted key."""
        own = _dotted("flights", self.flights)
        del own["flights.joint"]  # what a flight was adjusted to is recorded flight by flight
        return {"crs": self.crs} | own

    @property
    def learning_sha256(self) -> str:
        """Fingerprint of the settings a learned model depends on."""
        return _fingerprint(self.learning_settings)

    @property
    def config_sha256(self) -> str:
        """Fingerprint of the settings any result depends on; names, pairs and the machine are left out."""
        flights = self.flight_settings | {"flights.joint": self.flights.joint}
        return _fingerprint(self.learning_settings | flights | self.product_settings(differencing=True))


def _dotted(section: str, settings: Any) -> dict[str, Any]:
    return {f"{section}.{name}": value for name, value in asdict(settings).items()}


def _fingerprint(settings: Mapping[str, Any]) -> str:
    canonical = json.dumps(settings, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


SECTIONS: dict[str, type[Any]] = {
    "adaptive": AdaptiveConfig,
    "lwpr": LWPRConfig,
    "coregistration": CoregistrationConfig,
    "flights": FlightsConfig,
    "differencing": DifferencingConfig,
    "machine": MachineConfig,
}


@plain_dataclass(frozen=True)
class Key:
    """
    One setting: where it stands, its default (MISSING where there is none), and how its text is read.

    `takes_auto` is true where the word ``"auto"`` means None; `is_text` where the value is a word and not a number.
    """

    section: str
    name: str
    default: Any
    takes_auto: bool
    is_text: bool

    @property
    def dotted(self) -> str:
        """The name with its section: "lwpr.activation_threshold"."""
        return f"{self.section}.{self.name}" if self.section else self.name


def _declared_keys() -> Iterator[Key]:
    owners: dict[str, type[Any]] = {"": ProgrammeConfig, **SECTIONS}
    for section, owner in owners.items():
        annotations = get_type_hints(owner)
        for field in fields(owner):
            if field.name not in SECTIONS:
                text = annotations[field.name] in {str, str | None} or get_origin(annotations[field.name]) is Literal
                yield Key(section, field.name, field.default, takes_auto=field.default is None, is_text=text)


#: Every setting by its dotted name, in the order of the file.
KEYS: dict[str, Key] = {key.dotted: key for key in _declared_keys()}
