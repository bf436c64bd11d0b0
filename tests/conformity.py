"""
Compare the receptive fields and predictions of reference mode with recorded ones.

    python tests/conformity.py reference_cases.npz

The file holds any number of cases: arrays `PREFIX_X`, `PREFIX_y`, `PREFIX_params`, `PREFIX_init_D` and what the
reference gave for them. Prints one line a case with the largest deviations; exits 1 when a mark is missed, 2 when the
file cannot be used, 0 otherwise.

Marks: numbers of receptive fields, of pruned ones, and after every sample: exact. Predictions (cutoff 0.001 and 0),
intercepts and online predictions: 1e-8 absolute. Metrics: 1e-8 of the largest element. Confidence bounds: 1e-6
absolute, or 1e-5 where the reference itself does not know them better: it takes the difference of two large sums, and
where no field holds residuals yet that noise is all there is. Such a case is told by `PREFIX_tol`, the spread between
builds of the reference: more than 1e-7 for the bound. Without `tol` it is a case with fixed metric whose first
forgetting factor is 0.999 or more (residuals count after some 107 updates), or one called c1.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from changedetect.kernels.lwpr import learn
from changedetect.kernels.lwpr_predict import NO_ANSWER, predict
from changedetect.kernels.lwpr_search import LWPRState
from changedetect.kernels.lwpr_state import Parameters

PARAMETER_NAMES = (
    *("diag_only", "update_D", "meta", "meta_rate", "penalty", "w_gen", "w_prune", "init_lambda", "final_lambda"),
    *("tau_lambda", "init_S2", "add_threshold", "kernel", "init_alpha"),
)
REQUIRED = ("X", "y", "params", "init_D")
MARKS = {"online_yp": 1e-8, "beta0": 1e-8, "D": 1e-8, "pred": 1e-8, "conf": 1e-6, "pred_cut0": 1e-8}


class Case:
    """One case of a file: its arrays, without their prefix."""

    def __init__(self, data, prefix):
        self.prefix = prefix
        self.arrays = {key[len(prefix) + 1 :]: data[key] for key in data.files if key.startswith(prefix + "_")}
        missing = [name for name in REQUIRED if name not in self.arrays]
        if missing:
            raise ValueError(f"case {prefix} lacks {', '.join(missing)}")
        self.queries = self.arrays.get("Xq", data["Xq"] if "Xq" in data.files else None)
        names = [str(name) for name in data["param_names"]] if "param_names" in data.files else PARAMETER_NAMES
        self.settings = dict(zip(names, (float(value) for value in self["params"]), strict=True))
        self.norm_in = np.broadcast_to(self.arrays.get("norm_in", 1.0), 2).astype(float)
        self.norm_out = float(np.ravel(self.arrays.get("norm_out", 1.0))[0])

    def __getitem__(self, name):
        return self.arrays[name]

    def __contains__(self, name):
        return name in self.arrays

    def parameters(self):
        """Settings as the kernels take them; add_threshold has no effect with two inputs."""
        values = {name.lower(): value for name, value in self.settings.items() if name != "add_threshold"}
        for name in ("diag_only", "update_d", "meta"):
            values[name] = bool(values[name])
        values["kernel"] = int(values["kernel"])
        factor = np.linalg.cholesky(np.asarray(self["init_D"], dtype=float)).T
        return Parameters(**values, init_m_xx=factor[0, 0], init_m_xy=factor[0, 1], init_m_yy=factor[1, 1])

    def conf_mark(self):
        """Mark for the confidence bound; see the head of this file."""
        if "tol" in self:
            is_noise = self["tol"][3] > 1e-7
        else:
            is_noise = not self.settings["update_D"] and self.settings["init_lambda"] >= 0.999
        return 1e-5 if is_noise or self.prefix.split("_")[0] == "c1" else MARKS["conf"]


def columns(points, scale):
    """Contiguous normalised columns of (n, 2) points."""
    return tuple(np.ascontiguousarray(np.asarray(points, dtype=float)[:, i] / scale[i]) for i in range(2))


def largest(difference):
    """Largest absolute deviation; NaN counts as infinite."""
    difference = np.abs(np.asarray(difference, dtype=float))
    return float(np.where(np.isnan(difference), np.inf, difference).max(initial=0.0))


def compare(case, use_index=True):
    """Learn a case; return exact comparisons (name: bool), deviations (name: float) and the state."""
    parameters, state = case.parameters(), LWPRState()
    x, y = columns(case["X"], case.norm_in)
    trace = learn(
        state, x, y, np.asarray(case["y"], dtype=float).ravel() / case.norm_out, parameters, use_index=use_index
    )
    exact, deviation = {}, {}
    if "K" in case:
        exact["K"] = state.n_fields == int(case["K"])
    if "n_pruned" in case:
        exact["n_pruned"] = state.n_pruned == int(case["n_pruned"])
    if "K_history" in case:
        exact["K_history"] = bool(np.array_equal(trace.n_fields, case["K_history"]))
    if "online_yp" in case:
        deviation["online_yp"] = largest(trace.online_prediction * case.norm_out - case["online_yp"])
    fields = state.fields[: state.n_fields]
    if "rf_beta0" in case:
        same = len(case["rf_beta0"]) == len(fields)
        deviation["beta0"] = largest(fields["beta0"] - case["rf_beta0"]) if same else np.inf
    if "rf_D" in case:
        metric = np.stack([fields["D_xx"], fields["D_xy"], fields["D_xy"], fields["D_yy"]], axis=1).reshape(-1, 2, 2)
        same = metric.shape == case["rf_D"].shape
        size = np.abs(case["rf_D"]).max(axis=(1, 2), keepdims=True)
        deviation["D"] = largest((metric - case["rf_D"]) / size) if same else np.inf
    if case.queries is not None:
        compare_predictions(case, state, parameters.kernel, use_index, deviation)
    return exact, deviation, state


def compare_predictions(case, state, kernel, use_index, deviation):
    """Add the deviations at the query points, for both cutoffs."""
    for suffix, cutoff in (("", 0.001), ("_cut0", 0.0)):
        if "pred" + suffix not in case:
            continue
        answer = predict(state, *columns(case.queries, case.norm_in), kernel, cutoff, use_index=use_index)
        deviation["pred" + suffix] = largest(answer.value * case.norm_out - case["pred" + suffix])
        if "conf" + suffix not in case:
            continue
        # where nothing answers both must say so; there the bound is a sign, not a number
        is_silent = case["conf" + suffix] >= 0.1 * NO_ANSWER * case.norm_out
        if not np.array_equal(is_silent, answer.bound >= 0.1 * NO_ANSWER):
            deviation["pred" + suffix] = np.inf
        if not suffix:  # with cutoff 0 the reference's bound is rounding noise over tiny sums of weights: no mark
            difference = np.where(is_silent, 0.0, answer.bound * case.norm_out - case["conf"])
            deviation["conf"] = largest(difference)


def report(case):
    """Print the line of one case; return whether it meets all marks."""
    exact, deviation, state = compare(case)
    marks = {**MARKS, "conf": case.conf_mark()}
    missed = [name for name, is_equal in exact.items() if not is_equal]
    missed += [name for name, value in deviation.items() if not value <= marks[name]]
    if not exact and not deviation:
        missed.append("nothing to compare with")
    absent = [name for name in ("K", "n_pruned", "K_history") if name not in exact]
    absent += [name for name in MARKS if name not in deviation]
    figures = [f"K {state.n_fields}", f"pruned {state.n_pruned}"]
    figures += [f"{name} {value:.1e}" for name, value in deviation.items()]
    note = f"  (not in the file: {', '.join(absent)})" if absent else ""
    verdict = f"MISSED {', '.join(missed)}" if missed else "ok"
    print(f"{case.prefix}: {'  '.join(figures)}  [conf mark {marks['conf']:.0e}]  {verdict}{note}")
    return not missed


def main(arguments):
    """Run all cases of a file; return the exit code."""
    if len(arguments) != 1:
        print("usage: python tests/conformity.py FILE.npz", file=sys.stderr)
        return 2
    try:
        with np.load(arguments[0]) as data:
            prefixes = sorted(key[:-2] for key in data.files if key.endswith("_X") and key[:-2] + "_y" in data.files)
            cases = [Case(data, prefix) for prefix in prefixes]
            names = [str(name) for name in data["case_names"]] if "case_names" in data.files else []
    except (OSError, ValueError, KeyError) as error:
        print(f"{arguments[0]} cannot be used: {error}", file=sys.stderr)
        return 2
    if not cases:
        print(f"{arguments[0]} holds no case: no arrays NAME_X and NAME_y.", file=sys.stderr)
        return 2
    absent = [name for name in names if not any(name == p or name.startswith(p + "_") for p in prefixes)]
    if absent:
        print(f"named, but without arrays in this file: {', '.join(absent)}")
    verdicts = [report(case) for case in cases]
    return 0 if all(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
