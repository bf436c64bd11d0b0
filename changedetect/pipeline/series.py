"""The time axis of a programme: what every cell and zone did over all epochs."""

from __future__ import annotations

import logging
import math
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from changedetect.catalogue import plan
from changedetect.errors import InputDataError, OutputError
from changedetect.io.netcdf import Layer
from changedetect.io.series import SERIES_CLASSES, SeriesMetadata, ZoneSeries, write_series, write_table
from changedetect.io.zones import covered_cells, read_zones
from changedetect.pipeline.learn import ModelShelf, learned_region
from changedetect.pipeline.manifest import new_run_id, utc_now
from changedetect.pipeline.queries import require_absent, require_outside, require_suffix
from changedetect.pipeline.rasters import product_grid
from changedetect.pipeline.regions import describe_region
from changedetect.pipeline.stacking import add_errors, stack_epochs
from changedetect.timeseries.judgement import (
    ChangePrior,
    Judgement,
    estimate_prior,
    judge_series,
    monitoring_level,
)
from changedetect.timeseries.zones import Area, AreaSeries, area_budgets, area_series

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from changedetect.catalogue import Epoch, Programme
    from changedetect.differencing.areas import AreaBudget
    from changedetect.differencing.error_model import ErrorModel
    from changedetect.grid import Grid
    from changedetect.io.zones import Zone
    from changedetect.timeseries.differences import TermsOfEpochs
    from changedetect.timeseries.stack import Stack
    from changedetect.typing import FloatArray, JSONObject, Region

__all__ = ["make_series"]

logger = logging.getLogger(__name__)

#: Series judged at a time.
_BLOCK_CELLS = 200_000
#: Cells that tell how common changes are, about, and rows of the map they are from, at least.
_N_PRIOR_CELLS, _N_PRIOR_ROWS = 20_000, 20
_WHOLE = "all ground"
_ZONE_LAYERS = {
    "area_observed": Layer("ground of the zone observed by the first epoch and by this one", "m2"),
    "change": Layer("mean change of elevation of the zone since the first epoch", "m"),
    "change_std": Layer("standard deviation of the mean change of the zone", "m"),
    "change_lower": Layer("lower end of the interval of the mean change of the zone", "m"),
    "change_upper": Layer("upper end of the interval of the mean change of the zone", "m"),
    "epoch_std": Layer("standard deviation of this epoch's own error of the mean elevation of the zone", "m"),
    "volume_net": Layer("net volume change of the observed ground of the zone since the first epoch", "m3"),
    "volume_net_lower": Layer("lower end of the interval of the net volume change", "m3"),
    "volume_net_upper": Layer("upper end of the interval of the net volume change", "m3"),
}


@dataclass(frozen=True)
class _Problem:
    """All that the results follow from."""

    programme: Programme
    epochs: tuple[Epoch, ...]
    grid: Grid
    stack: Stack
    models: list[ErrorModel]
    terms: TermsOfEpochs
    level: float

    @property
    def time(self) -> FloatArray:
        """Days since 1970-01-01."""
        return np.array([epoch.survey_time for epoch in self.epochs])


def make_series(
    programme: Programme,
    output: Path,
    *,
    zones: Path | None = None,
    layer: str | None = None,
    name_column: str | None = None,
    resolution: float | None = None,
    bounds: Region | None = None,
    monitoring: bool = False,
    overwrite: bool = False,
    dry_run: bool = False,
) -> JSONObject:
    """
    Write what every cell, and every zone, did over all learned epochs of a programme.

    Parameters
    ----------
    programme : Programme
    output : Path
        CF NetCDF (``.nc``). With zones two tables stand beside it: ``NAME_zones.csv``, one row a zone, and
        ``NAME_budgets.csv``, one row a zone and pair of epochs.
    zones : Path, optional
        Vector file of polygons.
    layer, name_column : str, optional
        As for `read_zones`.
    resolution : float, m, optional
    bounds : tuple (west, east, south, north), m, optional
        The programme's own by default.
    monitoring : bool
        Hold the rate of false alarms over all looks at the growing series, one after each survey, and not in this one
        alone.
    overwrite, dry_run : bool

    Returns
    -------
    details : dict
        Epochs, area of each class, `whole` and `zones` with their trend and break, files, warnings.

    Raises
    ------
    UsageError
        The output does not end in ``.nc``.
    InputDataError
        Fewer than two epochs have been learned; the bounds lie in a gap of the data; the zones cannot be used.
    MissingInputError, CRSMismatchError
        The zones cannot be read.
    ConfigError
        Resolution or bounds enclose nothing, or the bounds no data.
    OutputExistsError, OutputError
        An output exists, or cannot be written.
    """
    files = _files(output, with_zones=zones is not None)
    require_outside(programme, output)
    for path in files.values():
        require_absent(path, overwrite=overwrite)
    epochs, warnings = _learned_epochs(programme)
    listed = () if zones is None else read_zones(zones, programme.config.crs, layer=layer, name_column=name_column)
    details: JSONObject = {
        "epochs": [{"epoch_id": epoch.epoch_id, "date": epoch.date_text} for epoch in epochs],
        "confidence": programme.config.differencing.confidence,
        "n_zones": len(listed),
        "monitoring": monitoring,
        "files": {name: str(path) for name, path in files.items()},
    }
    ids = [epoch.epoch_id for epoch in epochs]
    grid = product_grid(programme.config, learned_region(programme, ids), resolution=resolution, bounds=bounds)
    areas, names, told = _areas(listed, grid)
    warnings += told
    if dry_run:
        return details | {"warnings": warnings}
    models = ModelShelf(programme, capacity=1)
    with _scratch(output) as scratch:
        stack = stack_epochs(models.get, ids, grid, scratch)
        if not stack.observed.any():
            msg = (
                f"No epoch observed anything in {describe_region(grid.region)}, a gap in all data. Choose other bounds."
            )
            raise InputDataError(msg)
        rate = 1.0 - programme.config.differencing.confidence
        level = monitoring_level(len(epochs), rate) if monitoring else rate
        problem = _Problem(programme, epochs, grid, stack, *add_errors(programme, ids, stack, grid), level)
        prior, cells = _judge_cells(problem)
        found = _judge_areas(problem, areas, prior)
        tables = _tables(problem, names, areas, found) if listed else None
        zone_series = ZoneSeries(names[1:], tables.over_time, found.judged(1)) if tables is not None else None
        write_series(output, cells, _slabs(problem), grid, _metadata(problem), zone_series)
        if tables is not None:
            write_table(files["zones"], tables.zones)
            write_table(files["budgets"], tables.budgets)
    described = [found.document(row, name, epochs) for row, name in enumerate(names)]
    return details | {
        "shape": list(grid.shape),
        "region": list(grid.region),
        "area_m2": _class_areas(cells, grid),
        "whole": described[0],
        "zones": described[1:],
        "warnings": warnings,
    }


def _files(output: Path, *, with_zones: bool) -> dict[str, Path]:
    require_suffix(output, (".nc",), "A series is written as NetCDF, tables of zones beside it.")
    tables = {name: output.with_name(f"{output.stem}_{name}.csv") for name in ("zones", "budgets")}
    return {"series": output} | (tables if with_zones else {})


def _learned_epochs(programme: Programme) -> tuple[tuple[Epoch, ...], list[str]]:
    """Epochs that have a model, and what is to be said of the others and of models that are not current."""
    learned, warnings = [], []
    due = {item.item_id: item for item in plan(programme) if item.kind == "model" and item.is_due}
    for epoch in programme.epochs:
        if not programme.state_directory(epoch.epoch_id).is_dir():
            warnings.append(f"epoch {epoch.epoch_id} has not been learned and is left out")
            continue
        learned.append(epoch)
        if epoch.epoch_id in due:
            warnings.append(
                f"the model of {epoch.epoch_id} is not up to date: {'; '.join(due[epoch.epoch_id].reasons)}"
            )
    if len(learned) < 2:
        n = len(programme.epochs)
        msg = (
            f"A series needs two learned epochs; '{programme.directory}' has {n} epoch{'s' * (n != 1)}, "
            f"{len(learned)} of them learned. Add surveys with `changedetect add`, then run: "
            f"changedetect update {programme.directory}"
        )
        raise InputDataError(msg)
    return tuple(learned), warnings


@contextmanager
def _scratch(output: Path) -> Iterator[Path]:
    """Folder beside the output for what does not fit into memory; shows early that the place can be written."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix=f".{output.stem}-", dir=output.parent)
    except OSError as error:
        msg = (
            f"Cannot write into {output.parent}: {error.strerror or error}. Choose another folder, or make it writable."
        )
        raise OutputError(msg) from error
    with folder as name:
        yield Path(name)


def _judge_cells(problem: _Problem) -> tuple[ChangePrior, dict[str, FloatArray]]:
    """Judge all cells, block of rows by block of rows."""
    stack, time = problem.stack, problem.time
    confidence = problem.programme.config.differencing.confidence
    n_rows, n_cols = stack.shape
    step = max(1, min(round(n_rows * n_cols / _N_PRIOR_CELLS), n_rows // _N_PRIOR_ROWS))
    prior = estimate_prior(*stack.series(slice(None, None, step)), time)
    layers: dict[str, FloatArray] = {}
    height = max(1, _BLOCK_CELLS // n_cols)
    for first in range(0, n_rows, height):
        rows = slice(first, min(first + height, n_rows))
        judged = judge_series(*stack.series(rows), time, prior, confidence, problem.level)
        for name in Judgement.names():
            values = getattr(judged, name)
            layer = layers.setdefault(name, np.empty(stack.shape, values.dtype))
            layer[rows] = values.reshape(-1, n_cols)
    first_value = np.full(stack.shape, np.nan)
    for k in range(stack.n_epochs):
        first_value = np.where(np.isfinite(first_value), first_value, stack.value[k])
    layers["elevation"] = stack.terrain[0] + first_value
    return prior, layers


def _slabs(problem: _Problem) -> Callable[[int], Mapping[str, FloatArray]]:
    stack = problem.stack

    def own_variance(k: int) -> FloatArray:
        total = stack.variance[k].astype(np.float64) + stack.correlated[k] + stack.coherent[k]
        return np.where(np.isfinite(stack.value[k]), total, np.nan)

    first_variance = own_variance(0)

    def slab(k: int) -> Mapping[str, FloatArray]:
        variance = own_variance(k)
        change = stack.value[k].astype(np.float64) - stack.value[0]
        change_variance = np.where(np.isfinite(change), 0.0 if k == 0 else variance + first_variance, np.nan)
        return {
            "dod": change,
            "dod_std": np.sqrt(change_variance),
            "epoch_std": np.sqrt(variance),
            "observed": stack.observed[k],
            "n_observations": np.asarray(stack.count[k], np.float64),
        }

    return slab


def _metadata(problem: _Problem) -> SeriesMetadata:
    config = problem.programme.config
    return SeriesMetadata(
        programme=config.name,
        run_id=new_run_id(),
        config_sha256=config.config_sha256,
        created=utc_now(),
        epochs=tuple(epoch.epoch_id for epoch in problem.epochs),
        times=tuple(problem.time.tolist()),
        confidence=config.differencing.confidence,
        false_alarm_level=problem.level,
    )


def _class_areas(cells: Mapping[str, FloatArray], grid: Grid) -> dict[str, float]:
    classes = cells["series_class"]
    return {c.meaning: int(np.count_nonzero(classes == c.value)) * grid.resolution**2 for c in SERIES_CLASSES}


def _areas(zones: Sequence[Zone], grid: Grid) -> tuple[list[Area], tuple[str, ...], list[str]]:
    """All ground and every zone as cells; a zone outside the map has none."""
    everywhere = (slice(0, grid.n_rows), slice(0, grid.n_cols))
    areas: list[Area] = [(everywhere, np.ones(grid.shape, bool))]
    warnings = []
    for zone in zones:
        covered = covered_cells(zone.polygon, grid)
        if covered is None or not covered[1].any():
            warnings.append(f"zone '{zone.name}' lies outside the ground of the programme, or between its cells")
            covered = ((slice(0, 1), slice(0, 1)), np.zeros((1, 1), bool))
        areas.append(covered)
    return areas, (_WHOLE, *(zone.name for zone in zones)), warnings


@dataclass(frozen=True)
class _AreaResults:
    """Series of all areas, and what they did."""

    series: AreaSeries
    judgement: Judgement

    def judged(self, first: int) -> dict[str, FloatArray]:
        """Arrays of the areas from a number on."""
        return {name: getattr(self.judgement, name)[first:] for name in Judgement.names()}

    def document(self, row: int, name: str, epochs: Sequence[Epoch]) -> JSONObject:
        """Describe one area."""
        change, own = self.series.change[row], self.series.variance[row]
        std = np.sqrt(own + own[0])
        std[0] = 0.0 if math.isfinite(change[0]) else math.nan
        over_time = [
            {
                "epoch_id": epoch.epoch_id,
                "area_observed_m2": float(self.series.area_observed[row, k]),
                "change_mean_m": _number(change[k]),
                "change_mean_std_m": _number(std[k]),
            }
            for k, epoch in enumerate(epochs)
        ]
        return {"name": name, **_judged_row(self.judgement, row), "series": over_time}


def _judge_areas(problem: _Problem, areas: Sequence[Area], prior: ChangePrior) -> _AreaResults:
    settings = problem.programme.config.differencing
    series = area_series(problem.stack, problem.models, problem.terms, areas, settings)
    tested = series.is_tested
    values = np.where(tested, series.change, np.nan)
    variances = np.where(tested, series.variance, np.nan)
    # zones are few and chosen because something may happen there: what is common among cells does not hold for them
    prior = ChangePrior(prior.size)
    judgement = judge_series(values, variances, None, problem.time, prior, settings.confidence, problem.level)
    return _AreaResults(series, judgement)


def _judged_row(judgement: Judgement, row: int) -> JSONObject:
    meanings = {c.value: c.meaning for c in SERIES_CLASSES} | {255: "not_observed"}
    described: JSONObject = {"class": meanings[int(judgement.series_class[row])]}
    units = {"trend": "_m_per_year", "trend_std": "_m_per_year", "break_size": "_m", "break_size_std": "_m"}
    for name in Judgement.names():
        if name == "series_class":
            continue
        value = _number(getattr(judgement, name)[row])
        if name.endswith(("_time", "_earliest", "_latest")):
            date = None if value is None else str(np.datetime64(round(value * 86400.0), "s"))
            described[name] = date
        else:
            is_count = name.endswith("surveys") or name == "surveys_before"
            described[name + units.get(name, "")] = int(value) if is_count and value is not None else value
    return described


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class _Tables:
    """Rows of the tables, and series of the zones for the NetCDF file."""

    zones: list[JSONObject]
    budgets: list[JSONObject]
    over_time: dict[str, tuple[FloatArray, Layer]]


def _tables(problem: _Problem, names: Sequence[str], areas: Sequence[Area], found: _AreaResults) -> _Tables:
    """Budgets of every zone since the first and since the previous epoch."""
    n = len(problem.epochs)
    settings = problem.programme.config.differencing
    over_time = {name: np.full((len(names) - 1, n), np.nan) for name in _ZONE_LAYERS}
    own = found.series.variance[1:]
    std = np.sqrt(own + own[:, :1])
    std[:, 0] = np.where(np.isfinite(found.series.change[1:, 0]), 0.0, np.nan)
    reach = float(stats.norm.ppf(0.5 + 0.5 * settings.confidence)) * std
    over_time["area_observed"] = found.series.area_observed[1:]
    over_time["change"], over_time["change_std"] = found.series.change[1:], std
    over_time["change_lower"], over_time["change_upper"] = over_time["change"] - reach, over_time["change"] + reach
    over_time["epoch_std"] = np.sqrt(own)
    rows: list[JSONObject] = []
    for later in range(1, n):
        for since, earlier in (("first", 0), ("previous", later - 1)):
            if since == "previous" and earlier == 0:
                continue  # that is the row since the first
            budgets = area_budgets(problem.stack, problem.models, problem.terms, (earlier, later), areas, settings)
            rows += _budget_rows(problem, names, budgets, since, (earlier, later))
            if since == "first":
                for row, budget in enumerate(budgets[1:]):
                    over_time["volume_net"][row, later] = budget.net.value
                    over_time["volume_net_lower"][row, later] = budget.net.lower
                    over_time["volume_net_upper"][row, later] = budget.net.upper
                    if budget.mean is not None:
                        over_time["change_lower"][row, later] = budget.mean.lower
                        over_time["change_upper"][row, later] = budget.mean.upper
    for name in ("volume_net", "volume_net_lower", "volume_net_upper"):
        over_time[name][:, 0] = 0.0
    zones = [{"zone": name, **_judged_row(found.judgement, row)} for row, name in enumerate(names)]
    return _Tables(zones, rows, {name: (values, _ZONE_LAYERS[name]) for name, values in over_time.items()})


def _budget_rows(
    problem: _Problem, names: Sequence[str], budgets: Sequence[AreaBudget], since: str, pair: tuple[int, int]
) -> list[JSONObject]:
    earlier, later = (problem.epochs[k] for k in pair)
    rows = []
    for name, budget in zip(names, budgets, strict=True):
        row: JSONObject = {
            "zone": name,
            "since": since,
            "epoch_earlier": earlier.epoch_id,
            "epoch_later": later.epoch_id,
            "date_earlier": earlier.date_text,
            "date_later": later.date_text,
        }
        for key, value in budget.document().items():
            if "_interval_" in key:
                low, high = value if value is not None else (None, None)
                row[key.replace("_interval_", "_lower_")], row[key.replace("_interval_", "_upper_")] = low, high
            else:
                row[key] = value
        rows.append(row)
    return rows
