"""A comparison as one picture: error, proper scores, coverage and cost of every method, a row for each hold-out."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.errors import ConfigError
from changedetect.storage import atomic_path
from changedetect.validation.methods import INSTALL_EXTRA
from changedetect.validation.scores import COVERAGE_LEVELS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from changedetect.validation.results import Comparison, Evaluation, HoldOut

__all__ = ["plot_comparison", "require_plotting"]

_OWN, _OTHER = "#b2182b", "#4d4d4d"
_LEVEL_COLOURS = ("#9ecae1", "#4292c6", "#08519c")
#: A value this many times as far from the best as the median one is drawn at the rim, with its number.
_RIM = 4.0


def require_plotting() -> None:
    """
    Check that matplotlib is installed.

    Raises
    ------
    ConfigError
        It is not.
    """
    if find_spec("matplotlib") is None:
        msg = f"Drawing a comparison needs matplotlib, which the extra 'compare' brings: {INSTALL_EXTRA}."
        raise ConfigError(msg)


def plot_comparison(comparison: Comparison, path: Path, title: str = "") -> None:
    """
    Draw a comparison into a PNG file, whole or not at all.

    Parameters
    ----------
    comparison : Comparison
    path : Path
    title : str

    Raises
    ------
    ConfigError
        matplotlib is not installed.
    OutputError
        The file cannot be written.
    """
    require_plotting()
    figures: Any = import_module("matplotlib.figure")
    n_methods = max(len(hold_out.evaluations) for hold_out in comparison.hold_outs)
    n_rows = len(comparison.hold_outs)
    figure = figures.Figure(figsize=(15.0, n_rows * (1.4 + 0.26 * n_methods)), dpi=100, layout="constrained")
    for row, hold_out in zip(figure.subplots(n_rows, 6, squeeze=False), comparison.hold_outs, strict=True):
        _draw_row(row, hold_out)
    figure.suptitle(title, fontsize=11)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _draw_row(row: Sequence[Any], hold_out: HoldOut) -> None:
    shown = hold_out.evaluations
    for axes, name, label in zip(row[:3], ("rmse", "crps", "nlpd"), ("RMSE, m", "CRPS, m", "NLPD, nats"), strict=True):
        _draw_values(axes, [None if item.common is None else float(getattr(item.common, name)) for item in shown])
        axes.set_title(label, fontsize=9)
    _draw_coverage(row[3], shown)
    _draw_cost(row[4], [item.cpu_seconds for item in shown], "CPU time, s")
    memory = [None if item.peak_memory_bytes is None else item.peak_memory_bytes / 1e6 for item in shown]
    _draw_cost(row[5], memory, "peak memory, MB")
    for column, axes in enumerate(row):
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_yticks(range(len(shown)), [_label(item, hold_out) for item in shown] if column == 0 else [])
        axes.tick_params(labelsize=8)
        axes.grid(axis="x", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    place = "at random" if hold_out.block_side is None else f"in blocks of {hold_out.block_side:g} m"
    text = f"held out {place}: {hold_out.n_held_out:,} of {hold_out.n_learned + hold_out.n_held_out:,} points"
    row[0].set_ylabel(text.replace(": ", ":\n") + "\n(share answered)", fontsize=9)


def _label(item: Evaluation, hold_out: HoldOut) -> str:
    if item.skipped:
        return f"{item.title} (skipped)"
    thinned = ", thinned" if item.is_subsampled else ""
    return f"{item.title} ({item.n_answered / hold_out.n_held_out:.0%}{thinned})"


def _draw_values(axes: Any, values: Sequence[float | None]) -> None:
    """Draw a dot each; what lies far beyond the others stands at the rim with its number."""
    known = np.array([value for value in values if value is not None])
    if known.size == 0:
        return
    low = float(known.min())
    rim = min(low + max(_RIM * float(np.median(known) - low), 1e-9), float(known.max()))
    for place, value in enumerate(values):
        if value is None:
            continue
        colour = _OWN if place == 0 else _OTHER
        axes.plot(min(value, rim), place, "o" if value <= rim else ">", color=colour, markersize=6)
        shift = -6 if value > 0.5 * (low + rim) else 6
        axes.annotate(
            f"{value:.3g}",
            (min(value, rim), place),
            xytext=(shift, 0),
            textcoords="offset points",
            ha="right" if shift < 0 else "left",
            va="center",
            fontsize=8,
            color=colour,
        )
    if rim > low:
        margin = 0.06 * (rim - low)
        axes.set_xlim(low - margin, rim + margin)


def _draw_coverage(axes: Any, shown: Sequence[Evaluation]) -> None:
    for level, colour in zip(COVERAGE_LEVELS, _LEVEL_COLOURS, strict=True):
        axes.axvline(level, color=colour, linewidth=1.2, linestyle="--")
        name = f"coverage_{100 * level:.0f}"
        for place, item in enumerate(shown):
            if item.common is not None:
                axes.plot(getattr(item.common, name), place, "o", color=colour, markersize=6)
    axes.set_xlim(0.2, 1.03)
    axes.set_title("coverage at 50, 90, 95 %", fontsize=9)


def _draw_cost(axes: Any, values: Sequence[float | None], label: str) -> None:
    ticker: Any = import_module("matplotlib.ticker")
    axes.set_xscale("log")
    axes.xaxis.set_minor_formatter(ticker.NullFormatter())
    if all(value is None for value in values):
        axes.set_xticks([])
        label = f"{label.split(',', maxsplit=1)[0]}: not measured"
    for place, value in enumerate(values):
        if value is not None:
            axes.plot(max(value, 0.01), place, "o", color=_OWN if place == 0 else _OTHER, markersize=6)
    axes.set_title(label, fontsize=9)
