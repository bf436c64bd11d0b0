"""Single epochs and pairs of a stack as the statistics of differences take them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from changedetect.differencing.coherent import CoherentTerm
from changedetect.differencing.maps import CellErrors, Evidence, judge_change
from changedetect.timeseries.errors import combined_model

if TYPE_CHECKING:
    from changedetect.config import DifferencingConfig
    from changedetect.differencing.error_model import ErrorModel
    from changedetect.differencing.maps import ChangeMaps
    from changedetect.timeseries.stack import Stack

__all__ = ["TermsOfEpochs", "epoch_maps", "pair_maps"]

#: Gives the coherent terms of one epoch, apart from those of the others, or of the difference of two, by their numbers.
TermsOfEpochs: TypeAlias = Callable[[tuple[int, ...]], Sequence[CoherentTerm]]


def epoch_maps(
    stack: Stack, models: Sequence[ErrorModel], terms: TermsOfEpochs, epoch: int, settings: DifferencingConfig
) -> ChangeMaps:
    """
    Deviation of one epoch from the shared surface with that epoch's errors alone.

    Parameters
    ----------
    stack : Stack
    models : sequence of ErrorModel
    terms : callable
        Gives errors that whole epochs share.
    epoch : int
        Its number.
    settings : DifferencingConfig

    Returns
    -------
    maps : ChangeMaps
        For the errors of means and sums; the deviation itself means nothing.
    """
    own = stack.layers(epoch)
    evidence = Evidence(
        difference=own.value,
        variance=own.variance,
        freedom=own.freedom,
        counts=(own.count, own.count),
        observed=(own.observed, own.observed),
        terrain=stack.terrain,
        correlation_length=stack.correlation_length,
    )
    return judge_change(evidence, _errors(stack, [models[epoch]], terms, (epoch,)), settings)


def pair_maps(
    stack: Stack,
    models: Sequence[ErrorModel],
    terms: TermsOfEpochs,
    pair: tuple[int, int],
    settings: DifferencingConfig,
) -> ChangeMaps:
    """
    Difference of two epochs of the stack, later minus earlier, with the errors of both.

    Parameters
    ----------
    stack, models, terms, settings
        As for `epoch_maps`.
    pair : (earlier, later)
        Numbers of the epochs.

    Returns
    -------
    maps : ChangeMaps
    """
    first, second = (stack.layers(k) for k in pair)
    variance = first.variance + second.variance
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = variance**2 / (first.variance**2 / first.freedom + second.variance**2 / second.freedom)
    evidence = Evidence(
        difference=second.value - first.value,
        variance=variance,
        freedom=freedom,
        counts=(first.count, second.count),
        observed=(first.observed, second.observed),
        terrain=stack.terrain,
        correlation_length=stack.correlation_length,
    )
    return judge_change(evidence, _errors(stack, [models[k] for k in pair], terms, pair), settings)


def _errors(stack: Stack, models: Sequence[ErrorModel], terms: TermsOfEpochs, epochs: tuple[int, ...]) -> CellErrors:
    correlated = np.sum([np.asarray(stack.correlated[k], np.float64) for k in epochs], axis=0)
    joined = tuple(terms(epochs))
    coherent = np.zeros(stack.shape)
    for term in joined:
        coherent += term.variance(stack.shape)
    model = combined_model(models, [float(np.mean(stack.correlated[k])) for k in epochs])
    return CellErrors(model, correlated, coherent, joined, np.zeros(stack.shape, bool))
