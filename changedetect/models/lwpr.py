"""
LWPR in adaptive mode: the surface model of a survey programme.

A model holds the exact evidence of its own epoch (micro-cell moments), and a memory of the epochs before it: their
evidence, moved to the present surface, faded with time and capped to a small weight. Receptive fields are a pure
function of these two and are rebuilt from them when first needed, so nothing about them can drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from changedetect.config import AdaptiveConfig
from changedetect.models.base import Prediction
from changedetect.models.cells import Cells, Evidence, merge_cells
from changedetect.models.lwpr_state import read_state, write_state
from changedetect.models.outliers import gross_errors
from changedetect.models.pyramid import SUPPORT_KERNELS, CellPyramid, Level, noise_variance, refine, scale_bank, support
from changedetect.models.rough_ground import refine_by_processes
from changedetect.models.steered import steer

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.typing import BoolArray, Coordinates, FloatArray, Region

__all__ = ["LWPRSurface", "check_observations", "point_density"]

#: Finest kernel in mean point spacings: about nine observations, effectively, in a receptive field.
_FINEST_KERNEL = 1.16
#: Kernel, in the finest the density supports, from which an epoch counts as dense.
_DENSE = 2.0
#: The pyramid goes half an octave below the kernel that the density supports on average: where there is detail the
#: shrinkage keeps it.
_FINEST_LEVEL = 2.0**-0.5
#: Levels of the pyramid where no coarsest kernel is set: ten, a factor of 22 in kernel size.
_N_STEPS = 9
#: Shrinkage of what a new epoch changes in the memory; stronger than the surface's, since most ground stays.
_CHANGE_SHRINKAGE = 2.0
#: Spacing, in kernels, of the places where the noise is estimated: neighbours share little data.
_NOISE_SPACING = 1.6
#: Growth, when a kernel grows by half an octave, of what ground that bends inside it adds to the noise: 4 where the
#: ground has a curvature, 2 where it is as rough as a random walk.
_BEND_GROWTH = 3.0


@dataclass(frozen=True)
class _Own:
    """Cells of the present epoch with the noise found, and the typical noise variance of unit weight."""

    cells: Cells
    noise_factor: float


@dataclass(frozen=True)
class _Built:
    """Receptive fields and what they were computed from."""

    level: Level
    cells: Cells
    own_support: Level


def check_observations(
    coordinates: Coordinates, elevation: FloatArray, sigma: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
    """
    Contiguous float64 copies-if-needed of one batch of observations.

    Raises
    ------
    ValueError
        Shapes differ, or a value is not finite, or a sigma is not positive.
    """
    arrays = [np.ascontiguousarray(a, dtype=np.float64) for a in (*coordinates, elevation)]
    if sigma is not None:
        arrays.append(np.ascontiguousarray(np.broadcast_to(np.asarray(sigma, np.float64), arrays[0].shape)))
    names = ("easting", "northing", "elevation", "sigma")
    for name, array in zip(names, arrays, strict=False):
        if array.ndim != 1 or array.shape != arrays[0].shape:
            msg = f"{name} has shape {array.shape}; all observations must be one-dimensional and of the same length"
            raise ValueError(msg)
        if not np.isfinite(array).all():
            msg = f"{name} holds {np.count_nonzero(~np.isfinite(array))} values that are not finite"
            raise ValueError(msg)
    if sigma is not None and not (arrays[3] > 0.0).all():
        msg = "sigma must be positive everywhere"
        raise ValueError(msg)
    return arrays[0], arrays[1], arrays[2], arrays[3] if sigma is not None else None


def point_density(easting: FloatArray, northing: FloatArray) -> float:
    """
    Observations per m2 where there are observations.

    Parameters
    ----------
    easting, northing : array, shape (n,), m

    Returns
    -------
    density : float, 1/m2
        Upper quartile, over the occupied squares of a lattice that holds about twelve observations a square.
    """
    extent = max(float(np.ptp(easting)), float(np.ptp(northing)), 1e-3)
    side = 2.0 ** round(math.log2(max(extent / math.sqrt(max(easting.size / 12.0, 1.0)), 1e-3)))
    density = 0.0
    for _ in range(12):
        row = np.floor(northing / side).astype(np.int64)
        column = np.floor(easting / side).astype(np.int64)
        key = (row - row.min()) * (int(np.ptp(column)) + 1) + (column - column.min())
        # counting needs no sorting, but a place for every square: clusters far apart would leave most empty
        if key.max() < 8 * key.size:
            count = np.bincount(key)
            count = count[count > 0]
        else:
            count = np.unique(key, return_counts=True)[1]
        density = float(np.percentile(count, 75)) / side**2
        wanted = 2.0 ** round(math.log2(math.sqrt(12.0 / density)))
        if wanted >= side:
            break
        side = wanted
    return density


class LWPRSurface:
    """
    A continuous surface learned from scattered observations, adapted epoch after epoch.

    Parameters
    ----------
    settings : AdaptiveConfig, optional
        What is None there is chosen from the first data.
    memory_days : float, days
        Time constant of forgetting.
    resolution : float, m, optional
        Cell size of the rasters wanted; the finest kernel is not chosen smaller.

    Attributes
    ----------
    evidence_ : Evidence
        Of the present epoch.
    memory_ : Cells or None
        Of the epochs before, weights in 1 / m2.
    survey_time_ : float, days since 1970-01-01
        Of the present epoch.
    own_kernel_, memory_kernel_ : float, m
        Finest kernel that the density of the present epoch, of the thinnest epoch before, supports.
    kernels_ : tuple of float, m
        Kernel sizes of the pyramid, coarse to fine; the finest suits the densest epoch so far.

    Notes
    -----
    Coordinates are metres in one projected CRS; each micro-cell is its own local origin, so large coordinates cost
    no precision. The result does not depend on the order of the observations.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> easting, northing = rng.uniform(0.0, 20.0, (2, 4000)) + 500000.0
    >>> elevation = 100.0 + 0.1 * (easting - 500000.0) + rng.normal(0.0, 0.05, 4000)
    >>> model = LWPRSurface().fit((easting, northing), elevation)
    >>> answer = model.predict((np.array([500010.0]), np.array([500010.0])))
    >>> abs(answer.elevation[0] - 101.0) < 0.02
    True
    """

    evidence_: Evidence
    memory_: Cells | None
    survey_time_: float
    own_kernel_: float
    memory_kernel_: float
    kernels_: tuple[float, ...]

    def __init__(
        self, settings: AdaptiveConfig | None = None, memory_days: float = 730.0, resolution: float | None = None
    ) -> None:
        self.settings = settings if settings is not None else AdaptiveConfig()
        self.memory_days = memory_days
        self.resolution = resolution

    def fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
    ) -> Self:
        """Forget everything, then learn; see `partial_fit`."""
        for name in [key for key in self.__dict__ if key.endswith("_") or key in {"_built", "_own"}]:
            del self.__dict__[name]
        return self.partial_fit(coordinates, elevation, sigma, survey_time)

    def without_gross_errors(self, coordinates: Coordinates, elevation: FloatArray) -> BoolArray:
        """
        Which observations of a whole epoch others support.

        Parameters
        ----------
        coordinates : (easting, northing), each shape (n,), m
        elevation : array, shape (n,), m

        Returns
        -------
        kept : array, shape (n,), bool

        Notes
        -----
        To be asked before `partial_fit`, which may get an epoch in parts and leaves nothing out: what stands alone in a
        part need not do so in the whole.
        """
        easting, northing, z, _ = check_observations(coordinates, elevation, None)
        if self.settings.outlier_limit == 0.0 or z.size == 0:
            return np.ones(z.size, np.bool_)
        density = point_density(easting, northing)
        is_dense = self._finest_kernel(1.0 / math.sqrt(density)) >= _DENSE * _FINEST_KERNEL / math.sqrt(density)
        return ~gross_errors((easting, northing), z, density, self.settings.outlier_limit, is_dense=is_dense)

    def partial_fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
    ) -> Self:
        """
        Learn observations of the present epoch, or of a new one.

        Parameters
        ----------
        coordinates : (easting, northing), each shape (n,), m
        elevation : array, shape (n,), m
        sigma : array, shape (n,), m, optional
            Standard deviation of each observation; all of an epoch's observations have one or none has.
        survey_time : float, days since 1970-01-01, optional
            A later time than the present epoch's starts a new epoch; None continues the present one.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            Arrays do not match, values are not finite, or the time lies before the present epoch.
        """
        easting, northing, z, s = check_observations(coordinates, elevation, sigma)
        if easting.size == 0:
            msg = "there are no observations to learn from"
            raise ValueError(msg)
        present = self.__dict__.get("survey_time_")
        time = float(survey_time) if survey_time is not None else (present if present is not None else 0.0)
        if not math.isfinite(time):
            msg = f"survey_time {time} is not finite; it counts days since 1970-01-01"
            raise ValueError(msg)
        if present is not None and time < present:
            msg = f"survey_time {time} lies before the present epoch, {present}; epochs are learned in order of time"
            raise ValueError(msg)
        if present is None or time > present:
            parent = None if present is None else self.copy()
            spacing = 1.0 / math.sqrt(point_density(easting, northing))
            self.own_kernel_ = self._finest_kernel(spacing)
            self.evidence_ = Evidence(self._cell_size(spacing), is_weighted=s is not None)
            self.survey_time_ = time
            self._inherit(parent)
        if self.evidence_.is_weighted != (s is not None):
            msg = "some observations of this epoch have a sigma and others have none; give all of them one, or none"
            raise ValueError(msg)
        self.evidence_.add((easting, northing), z, s)
        self.__dict__.pop("_built", None)
        self.__dict__.pop("_own", None)
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
            NaN where no observations surround the place.
        """
        zero = np.zeros(np.shape(coordinates[0]))
        easting, northing, _, _ = check_observations(coordinates, zero, None)
        blended = self._receptive_fields().level.blend(easting, northing)
        known = (blended[:, 7] > 0.0) & (blended[:, 5] >= 0.5)
        variance = np.where(known, blended[:, 3], np.nan)
        noise = np.where(known, blended[:, 4], np.nan)
        with np.errstate(divide="ignore"):
            effective = np.where(known, noise / variance, 0.0)
        return Prediction(
            elevation=np.where(known, blended[:, 0], np.nan),
            elevation_std=np.sqrt(variance),
            noise_std=np.sqrt(noise),
            n_effective=effective,
            # a weighted mean of equal times rounds; a tenth of a second is nobody's age
            age_days=np.where(known, np.round(np.maximum(self.survey_time_ - blended[:, 6], 0.0), 6), np.nan),
        )

    def observed(self, coordinates: Coordinates) -> BoolArray:
        """Whether observations of the present epoch itself surround each place; array, shape (n,)."""
        easting, northing, _, _ = check_observations(coordinates, np.zeros(np.shape(coordinates[0])), None)
        return self._receptive_fields().own_support.blend(easting, northing)[:, 5] >= 0.5

    @property
    def region(self) -> Region:
        """(west, east, south, north) of the ground observed in this epoch or before, m."""
        regions = [self.evidence_.cells(self.survey_time_).region]
        if self.memory_ is not None and len(self.memory_):
            regions.append(self.memory_.region)
        west, east, south, north = np.array(regions).T
        return float(west.min()), float(east.max()), float(south.min()), float(north.max())

    def copy(self) -> Self:
        """Return a model that shares no state with this one."""
        other = type(self)(self.settings, self.memory_days, self.resolution)
        other.__dict__.update(self.__dict__)
        if "evidence_" in self.__dict__:
            other.evidence_ = self.evidence_.copy()
        return other

    def rebuilt_on(self, parent: Self | None) -> Self:
        """
        Learn this model's own epoch again on top of another parent, from the stored evidence alone.

        Parameters
        ----------
        parent : LWPRSurface or None
            Model of the epoch before; None makes this the first epoch.

        Returns
        -------
        model : LWPRSurface

        Raises
        ------
        ValueError
            The parent is not earlier.
        """
        if parent is not None and parent.survey_time_ >= self.survey_time_:
            msg = f"the parent's survey_time {parent.survey_time_} is not before this epoch's, {self.survey_time_}"
            raise ValueError(msg)
        model = self.copy()
        model._inherit(parent)
        return model

    def save(self, directory: Path) -> None:
        """Persist into a folder, which is made if need be; NetCDF files, one a tile."""
        write_state(directory, self)

    @classmethod
    def load(cls, directory: Path) -> Self:
        """
        Read a model back; predictions are bit-identical.

        Raises
        ------
        ModelStateError
            A file is missing, damaged, or of another format version.
        """
        return read_state(directory, cls)

    def own_cells(self) -> Cells:
        """
        Cells of the present epoch with the noise variance found around them.

        Weights are scaled, all by one factor, to one over the typical noise variance. They do not follow the noise
        from place to place: where quiet and noisy ground meet, weighted planes would follow the quiet side only.
        """
        return self._own_noise().cells

    def chosen_settings(self) -> dict[str, float]:
        """
        Return what was chosen from the density of the present epoch.

        Returns
        -------
        chosen : dict
            Side of a micro-cell, the kernel that this epoch's density supports, finest and coarsest kernel of the
            pyramid, all in m.
        """
        return {
            "cell_size_m": self.evidence_.cell_size,
            "epoch_kernel_m": self.own_kernel_,
            "kernel_min_m": self.kernels_[-1],
            "kernel_max_m": self.kernels_[0],
        }

    def stated_sigma_ratio(self) -> float | None:
        """
        Noise found in the present epoch over the standard deviations that its observations came with.

        Returns
        -------
        ratio : float or None
            Median; 2 says that the true noise is twice the stated one. None where none was stated.
        """
        if not self.evidence_.is_weighted:
            return None
        return math.sqrt(self._own_noise().noise_factor)

    def _own_noise(self) -> _Own:
        """Noise of the present epoch, found when first asked for: every map and every difference needs it."""
        own = self.__dict__.get("_own")
        if own is None:
            own = self._find_noise()
            self._own = own
        return own

    def _find_noise(self) -> _Own:
        cells = self.evidence_.cells(self.survey_time_)
        sizes = CellPyramid(cells)
        kernel = self.own_kernel_
        noise = [
            noise_variance(sizes.for_kernel(size), size, _NOISE_SPACING * size).blend(*cells.centres)[:, 0]
            for size in (kernel, math.sqrt(2.0) * kernel)
        ]
        bend = np.maximum(noise[1] - noise[0], 0.0) / (_BEND_GROWTH - 1.0)
        factor = np.maximum(noise[0] - bend, 0.25 * noise[0])
        typical = float(np.median(factor))
        observed = factor * cells.moments[:, 0] / cells.moments[:, 1]
        return _Own(cells.with_noise(observed).with_weights_scaled(1.0 / typical), typical)

    def _inherit(self, parent: Self | None) -> None:
        """Take over the memory and the kernel bank of the epoch before."""
        self.__dict__.pop("_built", None)
        finest = max(self.own_kernel_ * _FINEST_LEVEL, min(self.own_kernel_, self.resolution or 0.0))
        self.memory_ = None
        self.memory_kernel_ = self.own_kernel_
        if parent is not None:
            self.memory_ = parent._faded_memory(self.survey_time_)
            self.memory_kernel_ = max(parent.own_kernel_, parent.memory_kernel_)
            finest = min(finest, parent.kernels_[-1])
        coarsest = self.settings.kernel_max_m or self.memory_kernel_ * math.sqrt(2.0) ** _N_STEPS
        self.kernels_ = tuple(scale_bank(finest, max(finest, coarsest), self.settings.kernel_ratio))

    def _finest_kernel(self, spacing: float) -> float:
        """Finest kernel for a mean spacing of observations, in half octaves of a metre, unless it is set."""
        if self.settings.kernel_min_m is not None:
            return self.settings.kernel_min_m
        wanted = max(_FINEST_KERNEL * spacing, self.resolution or 0.0)
        return float(2.0 ** (round(2.0 * math.log2(wanted)) / 2.0))

    def _cell_size(self, spacing: float) -> float:
        """
        Edge of the micro-cells, a power of two of a metre.

        Half the finest kernel; the whole of it where it is wide for the density, because then a cell of that size
        holds six observations or more and the plane inside it is known.
        """
        kernel = self.own_kernel_
        is_dense = kernel >= _DENSE * _FINEST_KERNEL * spacing
        wanted = self.settings.cell_size_m or (kernel if is_dense else 0.5 * kernel)
        return float(2.0 ** math.floor(math.log2(wanted) + 1e-9))

    def _refine(self, cells: Cells, kernel: float) -> Level:
        """Surface of cells whose density supports a kernel."""
        how = self.kernels_, self.settings.lattice_spacing, self.settings.shrinkage
        if cells.cell_size <= 0.5 * kernel:
            level, left_out = refine_by_processes(cells, *how)
            return steer(cells, level, kernel, left_out)
        # observations are dense against the kernel wanted: it averages many of them, and fields will do
        level, unresolved = refine(cells, *how)
        level = steer(cells, level, kernel)
        level.planes[3] += unresolved
        return level

    def _moved_memory(self, own: Cells) -> Cells | None:
        """
        The memory, lifted or lowered by what changed since.

        The change is a surface of its own, fitted to what the new observations leave over the remembered surface;
        without it a change would be attenuated by the memory, and ground that was not seen again would stand at its
        old height amid new ground.
        """
        memory = self.memory_
        if memory is None or len(memory) == 0:
            return None
        remembered = self._refine(memory, self.memory_kernel_)
        remembered.planes[6] = _support_at(memory, remembered, self.memory_kernel_)[0]
        surface = remembered.blend(*own.places)
        known = surface[:, 5] >= 0.5
        if not known.any():
            return memory
        both = Cells(own.cell_size, own.row[known], own.column[known], own.moments[known])
        left_over = both.with_surface_removed(surface[known])
        change, _ = refine(left_over, self.kernels_, self.settings.lattice_spacing, _CHANGE_SHRINKAGE)
        change.planes[6] = _support_at(left_over, change, self.own_kernel_)[0]
        moved = change.blend(*memory.places)
        moved[moved[:, 5] < 0.5, :3] = 0.0
        return memory.with_surface_removed(-moved)

    def _receptive_fields(self) -> _Built:
        if "evidence_" not in self.__dict__:
            msg = "the model has learned nothing yet; call fit first"
            raise ValueError(msg)
        built = self.__dict__.get("_built")
        if built is None:
            built = self._build()
            self._built = built
        return built

    def _build(self) -> _Built:
        own = self.own_cells()
        memory = self._moved_memory(own)
        cells = own if memory is None else merge_cells([memory, own])
        level = self._refine(cells, self.own_kernel_)
        supported, _, noise, nearby = _support_at(own, level, self.own_kernel_)
        own_support = Level(level.lattice, level.planes.copy())
        own_support.planes[6] = supported
        time = np.full(supported.shape, self.survey_time_)
        if memory is not None:
            remembered = _support_at(memory, level, self.memory_kernel_)
            # at the rim of both, ground counts as seen by the epoch that has observations there
            is_own = (supported > 0.0) | ((nearby > 0.0) & (remembered[0] == 0.0))
            supported = np.maximum(supported, remembered[0])
            time = np.where(is_own, time, remembered[1])
            noise = np.where(is_own, noise, remembered[2])
        level.planes[5] = noise
        level.planes[6] = supported
        level.planes[7] = time
        return _Built(level, cells, own_support)

    def _faded_memory(self, time: float) -> Cells:
        """Evidence of this epoch and before, as the next one remembers it."""
        built = self._receptive_fields()
        cells = built.cells
        last = built.level.blend(*cells.centres)
        moments = cells.moments.copy()
        moments[:, 11] = moments[:, 1] * np.where(last[:, 7] > 0.0, last[:, 6], moments[:, 11] / moments[:, 1])
        fade = math.exp(-(time - self.survey_time_) / self.memory_days)
        # weights in observations; counts and noise variances stay, so that ground which is not seen again keeps the
        # precision it was observed with while it counts for little beside new observations
        observations = moments[:, 1] * moments[:, 12] / moments[:, 0]
        factor = fade * np.minimum(1.0, self.settings.prior_observations / (fade * observations))
        return Cells(cells.cell_size, cells.row, cells.column, moments).with_weights_scaled(factor)


def _support_at(cells: Cells, level: Level, finest: float) -> FloatArray:
    kernel = SUPPORT_KERNELS * finest
    # whole cells count where their observations are on average: cells of a kernel's size will do
    return support(CellPyramid(cells).for_kernel(2.0 * kernel), level.lattice, kernel)
