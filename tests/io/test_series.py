"""The file of a series and its tables."""

from __future__ import annotations

import csv

import netCDF4
import numpy as np
import pytest

from changedetect.errors import OutputError
from changedetect.grid import Grid
from changedetect.io.series import CELL_LAYERS, TIME_LAYERS, SeriesMetadata, write_series, write_table

GRID = Grid.from_region((500000.0, 500003.0, 5300000.0, 5300002.0), 1.0, "EPSG:32632+5773")
META = SeriesMetadata(
    programme="site", run_id="r", config_sha256="c", created="2024-06-01T00:00:00Z", epochs=("a", "b"),
    times=(19000.0, 19100.5), confidence=0.95, false_alarm_level=0.05,
)  # fmt: skip


def cells():
    layers = {name: np.full(GRID.shape, 1.5) for name in CELL_LAYERS}
    layers["series_class"] = np.array([[0, 3, 255], [5, 8, 7]], np.uint8)
    layers["break_time"] = np.array([[19050.25, np.nan, np.nan], [19050.25, 19050.25, 19050.25]])
    layers["confirming_surveys"] = np.array([[2.0, np.nan, 0.0], [1.0, 1.0, 1.0]])
    return layers


def slab(k):
    layers = {name: np.full(GRID.shape, float(k)) for name in TIME_LAYERS}
    layers["dod"][0, 0] = np.nan
    layers["observed"] = np.array([[False, True, True], [True, True, True]])
    return layers


def test_layers_come_back_with_their_missing_values(tmp_path):
    write_series(tmp_path / "s.nc", cells(), slab, GRID, META)
    with netCDF4.Dataset(tmp_path / "s.nc") as file:
        assert file.variables["dod"].shape == (2, 2, 3)
        assert file.variables["dod"][1].mask.tolist() == [[True, False, False], [False] * 3]
        assert file.variables["dod"][1, 1, 1] == 1.0
        assert file.variables["observed"][0].tolist() == [[0, 1, 1], [1, 1, 1]]
        assert file.variables["series_class"][:].mask.tolist() == [[False, False, True], [False] * 3]
        assert file.variables["confirming_surveys"][:].mask.tolist() == [[False, True, False], [False] * 3]
        assert file.variables["break_time"][0, 0] == 19050.25 * 86400.0
        assert file.variables["time"][:].tolist() == [19000.0 * 86400.0, 19100.5 * 86400.0]
        assert file.variables["time_bnds"][1].tolist() == [19000.0 * 86400.0, 19100.5 * 86400.0]
        assert file.variables["epoch_id"][:].tolist() == ["a", "b"]
        assert file.time_coverage_end.startswith("2022-04-18T12:00:00")


def test_a_layer_that_is_missing_or_of_another_shape_is_refused(tmp_path):
    layers = cells()
    del layers["trend"]
    with pytest.raises(ValueError, match="trend"):
        write_series(tmp_path / "s.nc", layers, slab, GRID, META)
    layers["trend"] = np.zeros((3, 3))
    with pytest.raises(ValueError, match="shape"):
        write_series(tmp_path / "s.nc", layers, slab, GRID, META)
    assert not (tmp_path / "s.nc").exists()


def test_a_table_leaves_what_is_missing_empty(tmp_path):
    write_table(tmp_path / "t.csv", [{"zone": "a", "value": 1.25}, {"zone": "b", "value": float("nan")}])
    with (tmp_path / "t.csv").open() as stream:
        assert list(csv.DictReader(stream)) == [{"zone": "a", "value": "1.25"}, {"zone": "b", "value": ""}]
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        write_table(tmp_path / "file" / "t.csv", [{"zone": "a"}])
