"""
Several methods learn the same observations and are asked for the same ones that were held out.

Scores compare only if they are taken over the same observations, but methods decline to answer at different places.
They are therefore taken twice: where every method answers that answers more than half of what was held out (`common`),
and wherever the method itself answers (`own`), beside the share of the held-out observations that this is.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError
from changedetect.models.base import Prediction
from changedetect.validation.measuring import Measured, MethodFailedError, measure, measure_isolated
from changedetect.validation.methods import INSTALL_EXTRA, Method
from changedetect.validation.results import Comparison, ComparisonOptions, Evaluation, HoldOut
from changedetect.validation.scores import Scores, score
from changedetect.validation.splits import HoldOutKind, hold_out_blocks, hold_out_random, thin

if TYPE_CHECKING:
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Split", "compare_methods", "plan_comparison", "split"]

logger = logging.getLogger(__name__)

#: A method that answers no more than this share of the held-out observations has no say in where scores are taken.
_COMMON_SHARE = 0.5
#: Fewest observations that are learned and held out.
_MIN_LEARNED, _MIN_HELD_OUT = 100, 20


@dataclass(frozen=True)
class Split:
    """Observations to learn, and those held out."""

    kind: HoldOutKind
    learned: PointCloud
    held_out: PointCloud
    block_side: float | None


def compare_methods(
    cloud: PointCloud,
    methods: Sequence[Method],
    options: ComparisonOptions | None = None,
    on_progress: Callable[[int, int, str], None] | None = None,
) -> Comparison:
    """
    Let methods learn most of a survey and score what they say of the rest.

    Parameters
    ----------
    cloud : PointCloud
        Observations of one epoch, m.
    methods : sequence of Method
        The first one's predicted noise tells quiet ground from noisy.
    options : ComparisonOptions, optional
    on_progress : callable, optional
        Called as on_progress(done, total, label) before each method and once at the end.

    Returns
    -------
    comparison : Comparison
        A method that cannot cope or fails has a reason instead of scores.

    Raises
    ------
    ConfigError
        An option is out of range.
    InputDataError
        Too few observations would be learned or held out, or blocks are too large.
    ValueError
        Two methods have one name.
    """
    options = options or ComparisonOptions()
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        msg = f"Names of methods must differ; got {', '.join(names)}."
        raise ValueError(msg)
    thinned = _thinned(cloud, options.max_points, options.seed)
    splits = [split(thinned, kind, options) for kind in options.hold_outs]
    total, done = len(splits) * len(methods), 0
    hold_outs = []
    for part in splits:
        results: dict[str, Measured | str] = {}
        for method in methods:
            if on_progress:
                on_progress(done, total, f"{method.title}, {part.kind} hold-out")
            results[method.name] = _run(method, part, options)
            done += 1
        hold_outs.append(_judge(part, methods, results))
    if on_progress:
        on_progress(total, total, "done")
    return Comparison(n_points=len(thinned), n_available=len(cloud), options=options, hold_outs=tuple(hold_outs))


def plan_comparison(
    cloud: PointCloud, methods: Sequence[Method], options: ComparisonOptions | None = None
) -> Comparison:
    """
    Say what `compare_methods` would do, without learning; arguments and errors as there.

    Returns
    -------
    comparison : Comparison
        Without scores and costs; `skipped` is set where a method cannot cope.
    """
    options = options or ComparisonOptions()
    thinned = _thinned(cloud, options.max_points, options.seed)
    hold_outs = []
    for part in (split(thinned, kind, options) for kind in options.hold_outs):
        evaluations = tuple(
            Evaluation(
                name=method.name,
                title=method.title,
                skipped=_why_skipped(method, part, options),
                n_learned=_n_learned(method, part),
                is_subsampled=_n_learned(method, part) < len(part.learned),
            )
            for method in methods
        )
        hold_outs.append(
            HoldOut(
                kind=part.kind,
                block_side=part.block_side,
                n_learned=len(part.learned),
                n_held_out=len(part.held_out),
                n_common=0,
                quartered_by=None,
                evaluations=evaluations,
            )
        )
    return Comparison(n_points=len(thinned), n_available=len(cloud), options=options, hold_outs=tuple(hold_outs))


def split(cloud: PointCloud, kind: HoldOutKind, options: ComparisonOptions) -> Split:
    """
    Hold out a share of a survey.

    Raises
    ------
    ConfigError, InputDataError
        As `compare_methods`.
    """
    side: float | None = None
    if kind == "random":
        is_held_out = hold_out_random(cloud.coordinates, options.share, options.seed)
    else:
        is_held_out, side = hold_out_blocks(cloud.coordinates, options.share, options.seed, options.block_side)
    n_held_out = int(is_held_out.sum())
    if n_held_out < _MIN_HELD_OUT or len(cloud) - n_held_out < _MIN_LEARNED:
        msg = (
            f"Of {len(cloud)} points a share of {options.share:g} holds out {n_held_out}; at least {_MIN_HELD_OUT} "
            f"held out and {_MIN_LEARNED} learned are needed. Change the share or give more points."
        )
        raise InputDataError(msg)
    return Split(kind, cloud.select(~is_held_out), cloud.select(is_held_out), side)


def _why_skipped(method: Method, part: Split, options: ComparisonOptions) -> str | None:
    """Why a method cannot learn the observations, and what to do; None where it can."""
    n_points = len(part.learned)
    if method.missing_package:
        return f"needs {method.missing_package}: {INSTALL_EXTRA}"
    if method.max_points is not None and n_points > method.max_points and not options.is_subsampled:
        return f"copes with {method.max_points:,} points, not with {n_points:,}"
    return None


def _n_learned(method: Method, part: Split) -> int:
    """Observations the method learns of those that are left to learn."""
    n_points = len(part.learned)
    return n_points if method.max_points is None else min(n_points, method.max_points)


def _thinned(cloud: PointCloud, max_points: int | None, seed: int) -> PointCloud:
    if max_points is None or len(cloud) <= max_points:
        return cloud
    chosen = np.zeros(len(cloud), dtype=np.bool_)
    chosen[thin(cloud.coordinates, max_points, seed)] = True
    return cloud.select(chosen)


def _run(method: Method, part: Split, options: ComparisonOptions) -> Measured | str:
    """Return what the method answered, or why it did not."""
    reason = _why_skipped(method, part, options)
    if reason:
        return reason
    learned = _thinned(part.learned, method.max_points, options.seed)
    run = measure_isolated if options.is_isolated else measure
    try:
        measured = run(method.build, learned, part.held_out.coordinates)
    except MethodFailedError as error:
        logger.warning("%s, %s hold-out: %s", method.title, part.kind, error)
        return f"failed: {error}"
    logger.info("%s, %s hold-out: %.1f s", method.title, part.kind, measured.wall_seconds)
    return measured


def _judge(part: Split, methods: Sequence[Method], results: Mapping[str, Measured | str]) -> HoldOut:
    measured = {name: result for name, result in results.items() if isinstance(result, Measured)}
    answered = {name: np.isfinite(result.prediction.elevation) for name, result in measured.items()}
    common = _common(answered, len(part.held_out))
    first = next(iter(measured), None)
    quarters = None if first is None else _quarters(measured[first].prediction.noise_std, common & answered[first])
    evaluations = [_evaluation(method, part, results[method.name], common, quarters) for method in methods]
    return HoldOut(
        kind=part.kind,
        block_side=part.block_side,
        n_learned=len(part.learned),
        n_held_out=len(part.held_out),
        n_common=int(common.sum()),
        quartered_by=first if quarters is not None else None,
        evaluations=tuple(evaluations),
    )


def _evaluation(
    method: Method,
    part: Split,
    result: Measured | str,
    common: BoolArray,
    quarters: tuple[BoolArray, BoolArray] | None,
) -> Evaluation:
    """Score what a method answered; a text is the reason why it did not."""
    if isinstance(result, str):
        return Evaluation(name=method.name, title=method.title, skipped=result)
    answered = np.isfinite(result.prediction.elevation)
    n_learned = _n_learned(method, part)
    quiet, noisy = (None, None) if quarters is None else (_score_at(part, result.prediction, at) for at in quarters)
    return Evaluation(
        name=method.name,
        title=method.title,
        n_learned=n_learned,
        is_subsampled=n_learned < len(part.learned),
        n_answered=int(answered.sum()),
        common=_score_at(part, result.prediction, common),
        own=_score_at(part, result.prediction, answered),
        quiet=quiet,
        noisy=noisy,
        wall_seconds=result.wall_seconds,
        cpu_seconds=result.cpu_seconds,
        peak_memory_bytes=result.peak_memory_bytes,
    )


def _common(answered: Mapping[str, BoolArray], n: int) -> BoolArray:
    """Where every method answers that answers more than half."""
    common = np.ones(n, dtype=np.bool_)
    for known in answered.values():
        if known.mean() > _COMMON_SHARE:
            common &= known
    return common


def _quarters(noise_std: FloatArray, where: BoolArray) -> tuple[BoolArray, BoolArray] | None:
    """Places of the smallest and of the largest quarter of the noise; None where all of it is alike."""
    if not where.any():
        return None
    low, high = np.percentile(noise_std[where], (25.0, 75.0))
    if low == high:
        return None
    return where & (noise_std <= low), where & (noise_std >= high)


def _score_at(part: Split, prediction: Prediction, where: BoolArray) -> Scores | None:
    chosen = Prediction(**{item.name: getattr(prediction, item.name)[where] for item in fields(prediction)})
    return score(part.held_out.elevation[where], chosen)
