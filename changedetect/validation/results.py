"""What a comparison is asked for, and what it found."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from changedetect.validation.scores import Scores
from changedetect.validation.splits import HOLD_OUT_KINDS, HoldOutKind

if TYPE_CHECKING:
    from changedetect.typing import JSONObject

__all__ = ["Comparison", "ComparisonOptions", "Evaluation", "HoldOut"]


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions:
    """
    How methods are compared.

    Attributes
    ----------
    hold_outs : tuple of {"random", "blocks"}
    share : float
        Of the observations that is held out.
    seed : int
        Of what is held out and thinned.
    block_side : float or None, m
        Of held-out blocks; None takes five mean distances of points.
    max_points : int or None
        The survey is thinned to so many observations first, for all methods alike.
    is_subsampled : bool
        A method that cannot cope with the number of observations learns as many of them as it can, chosen at random;
        otherwise it is skipped.
    is_isolated : bool
        Each method runs in a process of its own, which measures its memory.
    """

    hold_outs: tuple[HoldOutKind, ...] = HOLD_OUT_KINDS
    share: float = 0.1
    seed: int = 0
    block_side: float | None = None
    max_points: int | None = None
    is_subsampled: bool = False
    is_isolated: bool = True


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """
    One method in one hold-out.

    Attributes
    ----------
    name, title : str
    skipped : str or None
        Why the method has no result.
    n_learned : int
        Observations it learned.
    is_subsampled : bool
        Whether these were fewer than the other methods'.
    n_answered : int
        Held-out observations it predicts.
    common, own : Scores or None
        Over those all methods predict, and over those this one predicts.
    quiet, noisy : Scores or None
        Over the quarters of the common ones where the first method predicts the smallest and the largest noise.
    wall_seconds, cpu_seconds : float or None
        Learning and answering.
    peak_memory_bytes : int or None
        While it did.
    """

    name: str
    title: str
    skipped: str | None = None
    n_learned: int = 0
    is_subsampled: bool = False
    n_answered: int = 0
    common: Scores | None = None
    own: Scores | None = None
    quiet: Scores | None = None
    noisy: Scores | None = None
    wall_seconds: float | None = None
    cpu_seconds: float | None = None
    peak_memory_bytes: int | None = None


@dataclass(frozen=True, kw_only=True)
class HoldOut:
    """
    All methods in one hold-out.

    Attributes
    ----------
    kind : {"random", "blocks"}
    block_side : float or None, m
    n_learned, n_held_out, n_common : int
        Observations that were left to learn, that were held out, and that every method predicts; see `comparison`.
    quartered_by : str or None
        Method whose predicted noise makes the quarters.
    evaluations : tuple of Evaluation
    """

    kind: HoldOutKind
    block_side: float | None
    n_learned: int
    n_held_out: int
    n_common: int
    quartered_by: str | None
    evaluations: tuple[Evaluation, ...]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """
    Methods compared on one survey.

    Attributes
    ----------
    n_points : int
        Observations compared on, thinned if that was asked for.
    n_available : int
        Observations of the survey.
    options : ComparisonOptions
    hold_outs : tuple of HoldOut
    """

    n_points: int
    n_available: int
    options: ComparisonOptions
    hold_outs: tuple[HoldOut, ...]

    def to_dict(self) -> JSONObject:
        """Return everything as JSON knows it; None stands for what was not measured."""
        return asdict(self)
