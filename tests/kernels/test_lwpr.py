"""Reference mode against its slow oracle and recorded vectors; the index changes no result."""

import itertools
import os
from pathlib import Path

import conformity
import numpy as np
import pytest
from naive_lwpr import NaiveField, NaiveLWPR, NaiveSettings

from changedetect.kernels.lwpr import learn
from changedetect.kernels.lwpr_predict import NO_ANSWER, NoisePrior, mean_residuals, predict, predict_surface
from changedetect.kernels.lwpr_search import LWPRState, search_level
from changedetect.kernels.lwpr_state import BISQUARE, FIELD_DTYPE, GAUSSIAN, Parameters
from changedetect.kernels.lwpr_update import activation, activation_derivatives, squared_reach

VECTORS = Path(os.environ.get("CHANGEDETECT_DATA", "../shared/data")).parent / "lwpr" / "reference_cases.npz"


def samples(n=180, seed=3):
    """Inputs over 12 x 12, a wavy target with a step, and queries that reach beyond."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0.0, 12.0, (n, 2))
    y = 2.0 * np.sin(x[:, 0] / 2.0) + 0.1 * x[:, 1] + np.where(x[:, 1] > 6.0, 1.5, 0.0) + 0.1 * rng.standard_normal(n)
    return x, y, rng.uniform(-4.0, 16.0, (40, 2))


def settings_pair(kernel, is_diagonal, is_meta, w_prune, is_normalised, update_d=True, w_gen=0.2):
    """The same settings for the oracle and for the kernels; residuals count early, so that metrics learn."""
    norm_in, norm_out = (np.array([20.0, 10.0]), 3.0) if is_normalised else (np.ones(2), 1.0)
    init_d = np.diag([0.3, 0.2]) if is_diagonal else np.array([[0.3, 0.1], [0.1, 0.2]])
    init_d = init_d * np.outer(norm_in, norm_in)
    common = {
        "diag_only": is_diagonal,
        "meta": is_meta,
        "meta_rate": 20.0,
        "penalty": 1e-4 / norm_in[0] ** 4,
        "w_gen": w_gen,
        "w_prune": w_prune,
        "init_lambda": 0.95,
        "final_lambda": 0.99,
        "tau_lambda": 0.99,
        "init_alpha": 20.0 if is_normalised else 0.2,
    }
    naive = NaiveSettings(init_D=init_d, kernel=kernel, update_D=update_d, norm_in=norm_in, norm_out=norm_out, **common)
    factor = np.linalg.cholesky(init_d).T
    parameters = Parameters(
        kernel=GAUSSIAN if kernel == "gaussian" else BISQUARE,
        update_d=update_d,
        init_m_xx=factor[0, 0],
        init_m_xy=factor[0, 1],
        init_m_yy=factor[1, 1],
        **common,
    )
    return naive, parameters


def learned(parameters, x, y, norm_in=1.0, norm_out=1.0, use_index=True):
    state = LWPRState()
    columns = np.ascontiguousarray((x / norm_in).T)
    return state, learn(state, *columns, y / norm_out, parameters, use_index=use_index)


def used(state):
    return state.fields[: state.n_fields], state.metrics[: state.n_fields]


COMBINATIONS = list(
    itertools.product(["gaussian", "bisquare"], [True, False], [True, False], [1.0, 0.55], [True, False])
)


@pytest.mark.parametrize(("kernel", "is_diagonal", "is_meta", "w_prune", "is_normalised"), COMBINATIONS)
def test_learning_equals_the_oracle(kernel, is_diagonal, is_meta, w_prune, is_normalised):
    x, y, queries = samples()
    naive_settings, parameters = settings_pair(kernel, is_diagonal, is_meta, w_prune, is_normalised)
    norm_in, norm_out = naive_settings.norm_in, naive_settings.norm_out
    oracle, online, count = NaiveLWPR(naive_settings), [], []
    for sample, target in zip(x, y, strict=True):
        online.append(oracle.update(sample, target))
        count.append(len(oracle.fields))
    state, trace = learned(parameters, x, y, norm_in, norm_out)
    fields, metrics = used(state)

    assert trace.n_fields.tolist() == count
    assert state.n_pruned == oracle.n_pruned
    assert (oracle.n_pruned > 0) == (w_prune < 1.0)
    np.testing.assert_allclose(trace.online_prediction * norm_out, online, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(fields["beta0"], [rf.beta0 for rf in oracle.fields], rtol=0.0, atol=1e-9)
    for name, a, b in (("xx", 0, 0), ("xy", 0, 1), ("yy", 1, 1)):
        largest = np.array([np.abs(rf.D).max() for rf in oracle.fields])
        expected = np.array([rf.D[a, b] for rf in oracle.fields])
        np.testing.assert_allclose(fields["D_" + name] / largest, expected / largest, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(metrics["alpha_" + name], [rf.alpha[a, b] for rf in oracle.fields], rtol=1e-8)
    for name, attribute, j in (("Ecv_2", "Ecv", 1), ("Ecv_1", "Ecv", 0), ("SSs2_2", "SSs2", 1), ("W", "W", 0)):
        expected = [getattr(rf, attribute)[j] for rf in oracle.fields]
        np.testing.assert_allclose(fields[name], expected, rtol=1e-7, atol=1e-12)
    # the metric has really been learned
    assert np.abs(fields["D_xx"] / naive_settings.init_D[0, 0] - 1.0).max() > 0.02

    for cutoff in (0.001, 0.0):
        answer = predict(state, *np.ascontiguousarray((queries / norm_in).T), parameters.kernel, cutoff)
        expected = np.array([oracle.predict(query, cutoff) for query in queries])
        np.testing.assert_allclose(answer.value * norm_out, expected[:, 0], rtol=0.0, atol=1e-8)
        if cutoff:  # with 0 the bound divides by sums of weights of 1e-100 and less
            np.testing.assert_allclose(answer.bound * norm_out, expected[:, 1], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("kernel", ["gaussian", "bisquare"])
@pytest.mark.parametrize(
    ("update_d", "w_gen", "w_prune"), [(False, 0.2, 1.0), (False, 0.001, 1.0), (True, 0.3, 0.0005)]
)
def test_learning_equals_the_oracle_at_unusual_thresholds(kernel, update_d, w_gen, w_prune):
    x, y, _ = samples(120, seed=4)
    naive_settings, parameters = settings_pair(kernel, False, False, w_prune, False, update_d, w_gen)
    oracle = NaiveLWPR(naive_settings)
    online = [oracle.update(sample, target) for sample, target in zip(x, y, strict=True)]
    state, trace = learned(parameters, x, y)
    assert (state.n_fields, state.n_pruned) == (len(oracle.fields), oracle.n_pruned)
    np.testing.assert_allclose(trace.online_prediction, online, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(used(state)[0]["beta0"], [rf.beta0 for rf in oracle.fields], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("kernel", ["gaussian", "bisquare"])
@pytest.mark.parametrize("update_d", [True, False])
@pytest.mark.parametrize(("w_gen", "w_prune"), [(0.2, 1.0), (0.2, 0.5), (0.001, 1.0), (0.3, 0.0005)])
def test_the_index_changes_not_one_bit(kernel, update_d, w_gen, w_prune):
    x, y, queries = samples(250, seed=5)
    _, parameters = settings_pair(kernel, False, True, w_prune, False, update_d, w_gen)
    (state, trace), (scanned, scan_trace) = (learned(parameters, x, y, use_index=flag) for flag in (True, False))
    assert used(state)[0].tobytes() == used(scanned)[0].tobytes()
    assert used(state)[1].tobytes() == used(scanned)[1].tobytes()
    for a, b in zip(trace, scan_trace, strict=True):
        np.testing.assert_array_equal(a, b)
    for cutoff in (0.1, 0.001, 0.0):
        places = np.ascontiguousarray(queries.T)
        for a, b in zip(
            predict(state, *places, parameters.kernel, cutoff),
            predict(scanned, *places, parameters.kernel, cutoff, use_index=False),
            strict=True,
        ):
            np.testing.assert_array_equal(a, b)


def test_metrics_of_very_different_sizes_and_needles_do_not_confuse_the_index():
    x, y, _ = samples(300, seed=6)
    # a rate far too large: some metrics explode, some collapse
    _, parameters = settings_pair("gaussian", False, False, 0.7, False)
    parameters = parameters._replace(init_alpha=20.0, penalty=0.0)
    (state, _), (scanned, _) = (learned(parameters, x, y, use_index=flag) for flag in (True, False))
    fields = used(state)[0]
    trace = fields["D_xx"] + fields["D_yy"]
    assert trace.max() / trace.min() > 1e3
    assert fields.tobytes() == used(scanned)[0].tobytes()


def test_learning_in_pieces_equals_learning_at_once():
    x, y, _ = samples(250, seed=7)
    _, parameters = settings_pair("gaussian", False, True, 0.55, False)
    whole, _ = learned(parameters, x, y)
    pieces = LWPRState()
    for start, stop in ((0, 1), (1, 2), (2, 90), (90, 250)):
        learn(pieces, *np.ascontiguousarray(x[start:stop].T), y[start:stop], parameters)
        # predicting in between, with an index of another reach, disturbs nothing
        predict(pieces, np.array([1.0]), np.array([2.0]), parameters.kernel, 0.0)
    assert used(whole)[0].tobytes() == used(pieces)[0].tobytes()
    assert used(whole)[1].tobytes() == used(pieces)[1].tobytes()
    assert whole.n_pruned == pieces.n_pruned


def test_a_copy_shares_nothing():
    x, y, _ = samples(100)
    _, parameters = settings_pair("gaussian", True, False, 1.0, False)
    state, _ = learned(parameters, x, y)
    before = used(state)[0].tobytes()
    other = state.copy()
    learn(other, *np.ascontiguousarray(x.T), y, parameters)
    assert used(state)[0].tobytes() == before
    assert used(other)[0].tobytes() != before


def test_a_noise_free_plane_is_learned_closely_and_a_level_one_exactly():
    x, _, queries = samples(2000, seed=8)
    parameters = Parameters(init_m_xx=0.5, init_m_yy=0.5, init_lambda=0.99, final_lambda=0.99, update_d=False)
    inside = queries[((queries > 2.0) & (queries < 10.0)).all(axis=1)]
    # the axes of the local regression keep turning with the samples, so a plane is approached, never reached
    for slope, tolerance in ((0.0, 1e-12), (0.5, 0.01)):
        state, _ = learned(parameters, x, 3.0 + slope * x[:, 0] - 0.5 * slope * x[:, 1])
        answer = predict(state, *np.ascontiguousarray(inside.T), GAUSSIAN)
        expected = 3.0 + slope * inside[:, 0] - 0.5 * slope * inside[:, 1]
        np.testing.assert_allclose(answer.value, expected, rtol=0.0, atol=tolerance)


def test_the_wider_of_two_crowded_fields_goes_and_the_last_takes_its_place():
    rng = np.random.default_rng(0)
    state = LWPRState()
    parameters = Parameters(init_m_xx=1.0, init_m_yy=1.0, update_d=False, w_prune=0.6)
    learn(state, np.array([0.0, 3.0, 6.0]), np.zeros(3), np.zeros(3), parameters)
    assert state.n_fields == 3
    state.fields["centre_x"][1] = 0.4
    for name in ("D_xx", "D_yy"):
        state.fields[name][:3] = (1.0, 1.5, 1.0)
    narrow_is_second, equal = state, state.copy()
    narrow_is_second.index = None
    learn(narrow_is_second, np.array([0.1]), np.zeros(1), rng.normal(size=1), parameters)
    assert narrow_is_second.fields["centre_x"][:2].tolist() == [6.0, 0.4]
    for name in ("D_xx", "D_yy"):
        equal.fields[name][:3] = 1.0
    learn(equal, np.array([0.1]), np.zeros(1), rng.normal(size=1), parameters)
    assert equal.fields["centre_x"][:2].tolist() == [0.0, 6.0]  # equally wide: the second most active goes


def test_nothing_is_trusted_before_the_sixth_update():
    parameters = Parameters(init_m_xx=1.0, init_m_yy=1.0, update_d=False)
    place = np.array([0.05])
    for n_updates, is_trusted in ((5, False), (6, True)):
        x = np.linspace(0.0, 0.1, n_updates + 1)  # the first sample makes the field
        state = LWPRState()
        learn(state, x, np.zeros_like(x), 7.0 + x, parameters)
        answer = predict(state, place, np.zeros(1), GAUSSIAN)
        assert (answer.value[0] != 0.0) == is_trusted
        assert (answer.bound[0] < NO_ANSWER) == is_trusted
        surface = predict_surface(state, place, np.zeros(1), GAUSSIAN, NoisePrior(0.01, 4.0))
        assert np.isfinite(surface.value[0]) == is_trusted
        assert (surface.n_effective[0] > 0.0) == is_trusted


def test_where_no_field_is_active_the_answer_is_zero_and_the_bound_says_so():
    x, y, _ = samples(100)
    _, parameters = settings_pair("bisquare", True, False, 1.0, False)
    state, _ = learned(parameters, x, y)
    far = predict(state, np.array([1e3]), np.array([-1e3]), BISQUARE, 0.0)
    assert (far.value[0], far.bound[0], far.largest_activation[0]) == (0.0, NO_ANSWER, 0.0)


@pytest.mark.parametrize("kernel", [GAUSSIAN, BISQUARE])
def test_activation_derivatives_are_those_of_the_activation(kernel):
    step = 1e-5
    for q in (0.1, 1.0, 2.5, 3.7):
        w = activation(q, kernel)
        low, high = activation(q - step, kernel), activation(q + step, kernel)
        first, second = activation_derivatives(q, w, kernel)
        np.testing.assert_allclose(first, (high - low) / (2.0 * step), rtol=1e-8, atol=0.0)
        np.testing.assert_allclose(second, (high - 2.0 * w + low) / step**2, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("kernel", [GAUSSIAN, BISQUARE])
@pytest.mark.parametrize("level", [0.5, 0.001, 1e-4, 0.0])
def test_nothing_beyond_the_reach_exceeds_the_level(kernel, level):
    reach = squared_reach(level, kernel)
    assert activation(reach * (1.0 + 1e-9), kernel) <= level
    if level > 0.0:
        np.testing.assert_allclose(activation(reach, kernel), level, rtol=1e-9, atol=0.0)


def test_the_search_goes_as_far_as_the_rule_that_looks_farthest():
    assert search_level(Parameters()) == 0.001
    assert search_level(Parameters(w_gen=0.001)) == pytest.approx(1e-4)
    assert search_level(Parameters(w_prune=2e-5)) == 2e-5


@pytest.mark.parametrize("is_diagonal", [True, False])
def test_the_oracles_metric_derivatives_are_those_of_distance_and_penalty(is_diagonal):
    settings, _ = settings_pair("gaussian", is_diagonal, False, 1.0, False)
    oracle, delta, step = NaiveLWPR(settings), np.array([0.7, -0.4]), 1e-4
    g = settings.penalty / 2

    def at(m):
        d = m.T @ m
        return delta @ d @ delta, g * (d**2).sum()

    rf = NaiveField(np.zeros(2), 0.0, settings)
    derivatives = oracle._metric_derivatives(rf, delta)
    for a, b in [(0, 0), (1, 1)] if is_diagonal else [(0, 0), (0, 1), (1, 1)]:
        shift = np.zeros((2, 2))
        shift[a, b] = step
        low, middle, high = (np.array(at(rf.M + s * shift)) for s in (-1, 0, 1))
        first, second = (high - low) / (2 * step), (high - 2 * middle + low) / step**2
        dq, ddq, dj, ddj = (array[a, b] for array in derivatives)
        np.testing.assert_allclose((dq, dj), first, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose((ddq, ddj), second, rtol=1e-5, atol=1e-10)


def test_mean_residuals_are_how_far_samples_lie_above_a_plane():
    x, _, _ = samples(300, seed=9)
    parameters = Parameters(init_m_xx=0.5, init_m_yy=0.5, init_lambda=0.9, final_lambda=0.9, update_d=False)
    state, _ = learned(parameters, x, np.full(300, 2.0))
    mean, mass = mean_residuals(state, *np.ascontiguousarray(x.T), np.full(300, 2.5), GAUSSIAN)
    centres = np.stack([used(state)[0]["centre_x"], used(state)[0]["centre_y"]], axis=1)
    expected = np.exp(-0.5 * 0.25 * ((x[:, None] - centres) ** 2).sum(axis=2))
    np.testing.assert_allclose(mass, np.where(expected > 0.001, expected, 0.0).sum(axis=0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(mean, 0.5, rtol=0.0, atol=1e-12)


def test_records_fill_cache_lines():
    assert FIELD_DTYPE.itemsize == 5 * 64
    assert LWPRState().fields.ctypes.data % 64 == 0


def write_case(path, **changes):
    """A file of the format of tests/conformity.py, with what the oracle gives for one case."""
    x, y, queries = samples(150, seed=10)
    settings, parameters = settings_pair("bisquare", False, True, 0.55, True)
    oracle, online, count = NaiveLWPR(settings), [], []
    for sample, target in zip(x, y, strict=True):
        online.append(oracle.update(sample, target))
        count.append(len(oracle.fields))
    low, zero = (np.array([oracle.predict(query, cutoff) for query in queries]) for cutoff in (0.001, 0.0))
    values = {**parameters._asdict(), "add_threshold": 0.5, "kernel": 1.0}
    arrays = {
        "Xq": queries,
        "param_names": np.array(conformity.PARAMETER_NAMES),
        "c9_X": x,
        "c9_y": y,
        "c9_params": np.array([float(values[name.lower()]) for name in conformity.PARAMETER_NAMES]),
        "c9_init_D": settings.init_D,
        "c9_norm_in": settings.norm_in,
        "c9_norm_out": np.array([settings.norm_out]),
        "c9_K": np.array(len(oracle.fields)),
        "c9_n_pruned": np.array(oracle.n_pruned),
        "c9_K_history": np.array(count, dtype=np.int32),
        "c9_online_yp": np.array(online),
        "c9_rf_beta0": np.array([rf.beta0 for rf in oracle.fields]),
        "c9_rf_D": np.array([rf.D for rf in oracle.fields]),
        "c9_pred": low[:, 0],
        "c9_conf": low[:, 1],
        "c9_pred_cut0": zero[:, 0],
        "c9_conf_cut0": zero[:, 1],
    }
    for name, change in changes.items():
        arrays[name] = change(arrays[name]) if callable(change) else change
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return [str(path)]


def test_the_conformity_script_accepts_what_conforms(tmp_path, capsys):
    assert conformity.main(write_case(tmp_path / "a.npz", case_names=np.array(["c9_bisquare", "c8_absent"]))) == 0
    printed = capsys.readouterr().out.splitlines()
    assert "c8_absent" in printed[0]
    assert printed[1].startswith("c9: K ")
    assert printed[1].endswith("ok")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("c9_K", lambda k: k + 1),
        ("c9_n_pruned", lambda k: k + 1),
        ("c9_K_history", lambda k: np.r_[k[1:], k[-1]]),
        ("c9_online_yp", lambda v: v + 2e-8),
        ("c9_rf_beta0", lambda v: v + 2e-8),
        ("c9_rf_D", lambda v: v * (1 + 2e-8)),
        ("c9_pred", lambda v: v + 2e-8),
        ("c9_conf", lambda v: v + np.where(v < 1e10, 2e-6, 0.0)),
        ("c9_conf", lambda v: np.r_[1e20 * 3.0, v[1:]] if v[0] < 1e10 else np.r_[0.1, v[1:]]),
        ("c9_pred_cut0", lambda v: np.r_[np.nan, v[1:]]),
        ("c9_rf_D", lambda v: v[1:]),
    ],
)
def test_the_conformity_script_tells_every_missed_mark(tmp_path, capsys, name, change):
    assert conformity.main(write_case(tmp_path / "a.npz", **{name: change})) == 1
    assert "MISSED" in capsys.readouterr().out


def test_the_conformity_script_tolerates_absent_arrays_and_says_so(tmp_path, capsys):
    absent = dict.fromkeys(("c9_conf", "c9_online_yp", "c9_K_history", "param_names"))
    assert conformity.main(write_case(tmp_path / "a.npz", **absent)) == 0
    assert "not in the file: K_history, online_yp, conf" in capsys.readouterr().out


def test_a_bound_the_reference_does_not_know_better_gets_the_wider_mark(tmp_path):
    wider = {"c9_conf": lambda v: v + np.where(v < 1e10, 5e-6, 0.0)}
    assert conformity.main(write_case(tmp_path / "a.npz", c9_tol=np.array([0, 0, 0, 1e-11, 0]), **wider)) == 1
    assert conformity.main(write_case(tmp_path / "b.npz", c9_tol=np.array([0, 0, 0, 2e-6, 0]), **wider)) == 0


def test_the_conformity_script_refuses_what_it_cannot_read(tmp_path, capsys):
    (tmp_path / "broken.npz").write_text("not an archive")
    assert conformity.main([str(tmp_path / "broken.npz")]) == 2
    assert conformity.main([str(tmp_path / "absent.npz")]) == 2
    assert conformity.main([]) == 2
    assert conformity.main(write_case(tmp_path / "a.npz", c9_params=None)) == 2
    np.savez(tmp_path / "empty.npz", Xq=np.zeros((3, 2)))
    assert conformity.main([str(tmp_path / "empty.npz")]) == 2
    assert "lacks params" in capsys.readouterr().err


@pytest.mark.skipif(not VECTORS.is_file(), reason=f"recorded vectors are not at {VECTORS}")
def test_recorded_vectors_are_reproduced():
    assert conformity.main([str(VECTORS)]) == 0
