"""Methods on the same held-out points: equal terms, honest gaps, cost measured, failures told."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from constant_model import ConstantModel

from changedetect.config import ProgrammeConfig
from changedetect.errors import InputDataError
from changedetect.pointcloud import PointCloud
from changedetect.validation import ComparisonOptions, Method, compare_methods, known_methods, plan_comparison
from changedetect.validation.measuring import MethodFailedError, measure_isolated
from changedetect.validation.plot import plot_comparison

CONFIG = ProgrammeConfig(crs="EPSG:32632+5773", resolution=0.5)
QUICK = ComparisonOptions(is_isolated=False)


def survey(n=3000, seed=0):
    """Rippled ground of 40 m, 2 cm noise in the west, 10 cm in the east."""
    rng = np.random.default_rng(seed)
    easting, northing = rng.uniform(0.0, 40.0, (2, n))
    noise = np.where(easting < 20.0, 0.02, 0.10)
    elevation = 10.0 + np.sin(easting / 6.0) + 0.5 * np.cos(northing / 5.0) + noise * rng.normal(size=n)
    return PointCloud(easting + 5e5, northing + 5.3e6, elevation)


def chosen(*names):
    known = known_methods(CONFIG)
    return [known[name] for name in names]


@pytest.fixture(scope="module")
def compared():
    return compare_methods(survey(), chosen("adaptive", "kriging", "block_mean"), QUICK)


def test_all_methods_answer_for_the_same_observations(compared):
    assert [item.kind for item in compared.hold_outs] == ["random", "blocks"]
    for hold_out in compared.hold_outs:
        assert hold_out.n_learned + hold_out.n_held_out == 3000
        np.testing.assert_allclose(hold_out.n_held_out, 300, rtol=0, atol=60)
        assert {item.common.n for item in hold_out.evaluations} == {hold_out.n_common}
        for item in hold_out.evaluations:
            assert item.own.n == item.n_answered >= hold_out.n_common
            assert item.n_learned == hold_out.n_learned
            assert item.cpu_seconds > 0.0
            assert item.peak_memory_bytes is None


def test_scores_tell_good_models_from_poor_ones_and_gaps_from_single_points(compared):
    random, blocks = ({item.name: item for item in hold_out.evaluations} for hold_out in compared.hold_outs)
    assert random["adaptive"].common.rmse < 0.7 * random["block_mean"].common.rmse
    np.testing.assert_allclose(random["adaptive"].common.coverage_95, 0.95, rtol=0, atol=0.04)
    for name in ("adaptive", "kriging"):
        assert blocks[name].common.mae > random[name].common.mae
    assert blocks["block_mean"].n_answered < 0.8 * compared.hold_outs[1].n_held_out


def test_quarters_are_those_of_the_first_method(compared):
    hold_out = compared.hold_outs[0]
    assert hold_out.quartered_by == "adaptive"
    adaptive, kriging, _ = hold_out.evaluations
    np.testing.assert_allclose([adaptive.quiet.n, adaptive.noisy.n], hold_out.n_common / 4, rtol=0.02, atol=1)
    assert adaptive.quiet.n == kriging.quiet.n
    np.testing.assert_allclose([adaptive.quiet.rmse, adaptive.noisy.rmse], (0.02, 0.10), rtol=0.3, atol=0)
    # one noise for all ground: too wide in the west, too narrow in the east
    assert kriging.quiet.coverage_95 > 0.99
    assert kriging.noisy.coverage_95 < 0.92


def test_the_result_is_the_same_every_time_and_json_knows_it(compared):
    again = compare_methods(survey(), chosen("kriging", "block_mean"), QUICK)
    for one, other in zip(compared.hold_outs, again.hold_outs, strict=True):
        assert [item.own for item in one.evaluations[1:]] == [item.own for item in other.evaluations]
    document = json.loads(json.dumps(compared.to_dict(), allow_nan=False))
    assert document["hold_outs"][0]["evaluations"][0]["common"]["n"] == compared.hold_outs[0].n_common
    assert document["options"]["share"] == 0.1


def test_a_method_that_rarely_answers_does_not_decide_where_the_others_are_scored():
    pair = [Method("all", "answers", ConstantModel), Method("west", "answers in the west", partial(ConstantModel, 0.3))]
    (hold_out,) = compare_methods(survey(), pair, replace(QUICK, hold_outs=("random",))).hold_outs
    assert hold_out.n_common == hold_out.n_held_out
    every, west = hold_out.evaluations
    assert every.common.n == hold_out.n_held_out
    assert west.common.n == west.n_answered < 0.5 * hold_out.n_held_out
    pair[1] = replace(pair[1], build=partial(ConstantModel, 0.7))
    (hold_out,) = compare_methods(survey(), pair, replace(QUICK, hold_outs=("random",))).hold_outs
    assert {item.common.n for item in hold_out.evaluations} == {hold_out.n_common}
    assert hold_out.n_common < hold_out.n_held_out


def test_constant_noise_has_no_quarters():
    (hold_out,) = compare_methods(
        survey(), [Method("all", "answers", ConstantModel)], replace(QUICK, hold_outs=("random",))
    ).hold_outs
    assert hold_out.quartered_by is None
    assert hold_out.evaluations[0].quiet is None


def test_what_cannot_cope_is_skipped_with_the_reason_or_learns_a_subsample():
    small = replace(chosen("kriging")[0], max_points=500)
    (hold_out,) = compare_methods(survey(), [small], replace(QUICK, hold_outs=("random",))).hold_outs
    (item,) = hold_out.evaluations
    assert item.skipped == f"copes with 500 points, not with {hold_out.n_learned:,}"
    assert item.common is None
    assert hold_out.n_common == hold_out.n_held_out
    options = replace(QUICK, hold_outs=("random",), is_subsampled=True)
    other = replace(chosen("kriging")[0], name="unlimited")
    (hold_out,) = compare_methods(survey(), [small, other], options).hold_outs
    thinned, whole = hold_out.evaluations
    assert (thinned.n_learned, thinned.is_subsampled) == (500, True)
    assert (whole.n_learned, whole.is_subsampled) == (hold_out.n_learned, False)
    assert thinned.common.rmse > whole.common.rmse


def test_thinning_the_survey_puts_all_methods_on_equal_terms():
    options = replace(QUICK, hold_outs=("random",), max_points=1000)
    compared = compare_methods(survey(), chosen("kriging", "block_mean"), options)
    assert (compared.n_points, compared.n_available) == (1000, 3000)
    assert {item.n_learned for item in compared.hold_outs[0].evaluations} == {compared.hold_outs[0].n_learned}
    assert compared.hold_outs[0].n_learned < 1000


def test_a_missing_package_is_a_reason_with_its_fix():
    absent = replace(chosen("gpr_rbf")[0], requires="no-such-package")
    (hold_out,) = compare_methods(survey(), [absent], replace(QUICK, hold_outs=("random",))).hold_outs
    assert hold_out.evaluations[0].skipped == "needs no-such-package: pip install 'changedetect[compare]'"


def test_a_failure_is_told_and_the_others_go_on(caplog):
    pair = [Method("bad", "fails", partial(ConstantModel, 1.0, True)), Method("all", "answers", ConstantModel)]
    (hold_out,) = compare_methods(survey(), pair, replace(QUICK, hold_outs=("random",))).hold_outs
    assert hold_out.evaluations[0].skipped == "failed: I cannot learn this"
    assert hold_out.evaluations[1].common.n == hold_out.n_held_out
    assert "I cannot learn this" in caplog.text


def test_a_plan_says_what_would_run_without_running_it():
    small = replace(chosen("kriging")[0], max_points=500)
    failing = Method("bad", "would fail", partial(ConstantModel, 1.0, True))
    plan = plan_comparison(survey(), [small, failing], QUICK)
    ran = compare_methods(survey(), [small, failing], QUICK)
    for planned, done in zip(plan.hold_outs, ran.hold_outs, strict=True):
        assert (planned.n_learned, planned.n_held_out) == (done.n_learned, done.n_held_out)
        assert planned.block_side == done.block_side
        assert planned.evaluations[0].skipped == done.evaluations[0].skipped
        assert planned.evaluations[1].skipped is None


def test_progress_names_each_method_and_ends():
    seen = []
    compare_methods(survey(), chosen("block_mean", "delaunay"), QUICK, lambda *step: seen.append(step))
    assert [step[:2] for step in seen] == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]
    assert seen[1][2] == "Delaunay, linear, random hold-out"


def test_methods_are_told_apart_by_their_names():
    with pytest.raises(ValueError, match="Names of methods must differ; got kriging, kriging"):
        compare_methods(survey(), chosen("kriging", "kriging"), QUICK)


def test_too_few_points_are_refused():
    with pytest.raises(InputDataError, match="at least 20 held out and 100 learned are needed"):
        compare_methods(survey(150), chosen("block_mean"), replace(QUICK, hold_outs=("random",)))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory is measured on Linux alone")
def test_memory_is_what_the_method_took_in_a_process_of_its_own():
    cloud = survey(2000)
    places = cloud.coordinates[0][:100], cloud.coordinates[1][:100]
    measured = measure_isolated(partial(ConstantModel, 1.0, False, 300_000_000), cloud, places)
    np.testing.assert_allclose(measured.peak_memory_bytes, 3e8, rtol=0.05, atol=0)
    expected = ConstantModel().fit(cloud.coordinates, cloud.elevation).predict(places)
    np.testing.assert_array_equal(measured.prediction.elevation, expected.elevation)


def test_an_error_comes_back_from_the_other_process():
    with pytest.raises(MethodFailedError, match="I cannot learn this"):
        measure_isolated(partial(ConstantModel, 1.0, True), survey(2000), survey(2000).coordinates)


def test_the_picture_is_a_png_and_shows_skipped_methods_too(tmp_path):
    pair = [*chosen("kriging"), replace(chosen("block_mean")[0], max_points=500), *chosen("delaunay")]
    compared = compare_methods(survey(1500), pair, QUICK)
    plot_comparison(compared, tmp_path / "compare.png", "A survey")
    data = (tmp_path / "compare.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    assert len(data) > 20_000
    assert [path.name for path in tmp_path.iterdir()] == ["compare.png"]
