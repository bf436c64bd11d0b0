"""Surface models beside each other on observations of one epoch that were held out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from changedetect.catalogue import Programme
from changedetect.errors import ConfigError
from changedetect.pipeline.queries import require_absent, require_suffix
from changedetect.pipeline.reading import read_epoch_points
from changedetect.pipeline.update import Progress
from changedetect.typing import JSONObject
from changedetect.validation.comparison import compare_methods, plan_comparison
from changedetect.validation.methods import INSTALL_EXTRA, Method, known_methods
from changedetect.validation.plot import plot_comparison, require_plotting
from changedetect.validation.results import ComparisonOptions

__all__ = ["compare_epoch", "method_names"]

logger = logging.getLogger(__name__)


def method_names(programme: Programme) -> tuple[str, ...]:
    """Names of the methods that can be compared, the programme's own model first."""
    return tuple(known_methods(programme.config))


def compare_epoch(
    programme: Programme,
    epoch_id: str,
    names: Sequence[str] | None = None,
    options: ComparisonOptions | None = None,
    *,
    plot: Path | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
    on_progress: Progress | None = None,
) -> JSONObject:
    """
    Compare surface models on an epoch's own points; the epoch need not be learned, and nothing of it is changed.

    Parameters
    ----------
    programme : Programme
    epoch_id : str
    names : sequence of str, optional
        See `method_names`; all by default. A method that is named must be installed; others are skipped.
    options : ComparisonOptions, optional
    plot : Path, optional
        PNG file to draw.
    overwrite : bool
        Replace it.
    dry_run : bool
        Read the points and say what would be compared.
    on_progress : callable, optional

    Returns
    -------
    details : dict
        As `Comparison.to_dict`. On a dry run the hold-outs have no scores; the reasons for skipping stand already.

    Raises
    ------
    MissingInputError, InputDataError, CRSMismatchError, VerticalDatumError
        The epoch or its sources cannot be used, or there are too few points.
    ConfigError
        A name is unknown, an option is out of range, or a package that was asked for is missing.
    UsageError
        The plot does not end in ``.png``.
    OutputExistsError
        The plot exists and `overwrite` is not set.
    """
    options = options or ComparisonOptions()
    epoch = programme.epoch(epoch_id)
    chosen = _chosen(programme, names)
    if plot is not None:
        require_suffix(plot, (".png",), "The plot is a PNG picture.")
        require_plotting()
        require_absent(plot, overwrite=overwrite)
    cloud = read_epoch_points(programme, epoch).cloud
    if dry_run:
        return plan_comparison(cloud, chosen, options).to_dict()
    comparison = compare_methods(cloud, chosen, options, on_progress)
    if plot is not None:
        plot_comparison(comparison, plot, f"{programme.config.name}, {epoch_id}")
    return comparison.to_dict()


def _chosen(programme: Programme, names: Sequence[str] | None) -> tuple[Method, ...]:
    known = known_methods(programme.config)
    if names is None:
        return tuple(known.values())
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        msg = f"Unknown methods: {', '.join(unknown) or 'none given'}. Known are {', '.join(known)}."
        raise ConfigError(msg)
    chosen = tuple(known[name] for name in dict.fromkeys(names))
    for method in chosen:
        if method.missing_package:
            msg = f"{method.title} needs {method.missing_package}, which the extra 'compare' brings: {INSTALL_EXTRA}."
            raise ConfigError(msg)
    return chosen
