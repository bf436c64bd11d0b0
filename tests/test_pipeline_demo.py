"""The committed demonstration: it is what `simulate` writes, and its maps agree with its truth."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from small_surveys import reopen

from changedetect.catalogue import Programme
from changedetect.io.cog import read_cog
from changedetect.io.points import read_points
from changedetect.pipeline.simulate import simulate
from changedetect.pipeline.update import update
from changedetect.pipeline.verify import verify
from changedetect.storage import read_json
from changedetect.synthetic import DEMO_SEED

DEMO = Path(__file__).resolve().parents[1] / "surveys" / "demo"
FIRST, SECOND, THIRD = "2024-03-15", "2024-09-10", "2025-03-20"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The committed demonstration, learned in a copy."""
    ignored = shutil.ignore_patterns("state", "products", "runs", ".lock", "*.tmp-*")
    copy = shutil.copytree(DEMO, tmp_path_factory.mktemp("demo") / "demo", ignore=ignored)
    programme = Programme.open(copy, environment={})
    result = update(programme)
    assert (result.exit_code, result.warnings) == (0, ())
    return programme


def maps(demo, earlier, later, name="dod"):
    return read_cog(demo.product_directory(f"{earlier}_{later}") / f"{name}.tif")[0]


def truth(demo, earlier, later):
    return read_cog(demo.directory / "truth" / f"dod_{earlier}_{later}.tif")[0]


def test_the_committed_demo_is_what_simulate_writes(tmp_path):
    simulate(tmp_path / "demo", DEMO_SEED, density=9.0)
    for name in ("programme.toml", "truth/truth.json"):
        assert (tmp_path / "demo" / name).read_text() == (DEMO / name).read_text()
    for epoch_id in (FIRST, SECOND, THIRD):
        one, other = (read_points(folder / "inputs" / f"{epoch_id}.laz") for folder in (tmp_path / "demo", DEMO))
        for name in ("easting", "northing", "elevation"):
            # stored to 1 mm; libraries may round the last bit of a simulated value the other way
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=0.0011)


def test_the_committed_files_match_their_checksums():
    findings = verify(Programme.open(DEMO, environment={}))
    assert [finding for finding in findings if finding.subject.startswith("epochs/")] == []


def test_the_plateau_of_half_a_metre_is_half_a_metre_high(demo):
    plateau = ndimage.binary_erosion(np.isclose(truth(demo, FIRST, SECOND), 0.5, rtol=0, atol=1e-6), iterations=2)
    assert plateau.sum() > 500
    np.testing.assert_allclose(maps(demo, FIRST, SECOND)[plateau].mean(), 0.5, rtol=0, atol=0.005)


@pytest.mark.parametrize(("earlier", "later"), [(FIRST, SECOND), (SECOND, THIRD), (FIRST, THIRD)])
def test_differences_agree_with_the_truth(demo, earlier, later):
    error = maps(demo, earlier, later) - truth(demo, earlier, later)
    is_known = np.isfinite(error)
    assert np.sqrt(np.mean(error[is_known] ** 2)) < 0.035  # the edges of the plateau weigh most
    unchanged = is_known & (truth(demo, earlier, later) == 0.0)
    unchanged &= ndimage.binary_erosion(truth(demo, earlier, later) == 0.0, iterations=4)
    classes = maps(demo, earlier, later, "change_class")
    assert np.mean(np.isin(classes[unchanged], (1, 2))) < 0.09  # nominal 5 %, few independent cells


def test_net_volumes_agree_with_the_truth(demo):
    expected = read_json(demo.directory / "truth" / "truth.json")["volumes"]
    for pair_id in (f"{FIRST}_{SECOND}", f"{FIRST}_{THIRD}"):
        summary = read_json(demo.product_directory(pair_id) / "summary.json")
        difference = summary["volume_net_m3"] - expected[pair_id]["volume_net_m3"]
        assert abs(difference) < 4.0 * summary["volume_net_std_m3"]


def test_ground_in_the_gap_of_the_second_epoch_is_not_observed_there_and_ages(demo):
    gap = (slice(90, 98), slice(25, 31))  # 14 m east and 13 m north of the south-west corner, inside the gap
    assert set(np.unique(maps(demo, FIRST, SECOND, "change_class")[gap])) == {3}
    assert np.isnan(maps(demo, FIRST, SECOND)[gap]).all()
    elevation = read_cog(demo.product_directory(SECOND) / "elevation.tif")[0]
    age = read_cog(demo.product_directory(SECOND) / "age_days.tif")[0]
    true = read_cog(demo.directory / "truth" / f"elevation_{SECOND}.tif")[0]
    np.testing.assert_allclose(elevation[gap], true[gap], rtol=0, atol=0.1)
    np.testing.assert_allclose(age[gap], 179.0, rtol=0, atol=0.5)
    assert np.nanmedian(age) == 0.0


def test_running_it_again_does_nothing(demo):
    assert update(reopen(demo)).run_id is None
