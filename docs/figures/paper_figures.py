"""
Draw the figures of the paper again, on a real survey, with LWPR as published (reference mode) and the adaptive mode.

    .venv/bin/python -m pip install matplotlib scikit-learn
    CHANGEDETECT_DATA=FOLDER .venv/bin/python docs/figures/paper_figures.py

FOLDER holds ttp_lidar/ttp_2015_thinned.laz. The pictures go beside this file; the table goes to stdout. What they show:
docs/paper.md.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.patches import Ellipse
from PIL import Image

from changedetect.io.points import SourceOptions, open_points
from changedetect.models.base import SurfaceModel
from changedetect.models.comparators import comparators
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR, ReferenceSettings
from changedetect.pointcloud import PointCloud
from changedetect.typing import FloatArray
from changedetect.validation import Scores, hold_out_random, score

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("CHANGEDETECT_DATA", HERE.parents[2] / "shared" / "data"))
SURVEY = DATA / "ttp_lidar" / "ttp_2015_thinned.laz"
#: A road embankment and the marsh below it: west, east, south, north, m, EPSG:26917.
REGION = (634210.0, 634340.0, 4831350.0, 4831480.0)
SHOWN = (0.001, 0.1, 0.5)
THRESHOLDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
SEEDS = range(5)
KERNEL_M, PASSES = 5.0, 20
#: Kernel of new fields (m), learning rate relative to that of the library (0: fixed metric), passes over the data.
VARIANTS = {
    f"kernel {KERNEL_M:g} m, fixed": (KERNEL_M, 0.0, 1),
    f"kernel {KERNEL_M:g} m, learned in {PASSES} passes": (KERNEL_M, 1.0, PASSES),
    "kernel from the density (2.8 m), fixed": (None, 0.0, 1),
    f"the same, learned in {PASSES} passes": (2.8, 1.0, PASSES),
    "the same, ten times the rate": (2.8, 10.0, PASSES),
}


class Published:
    """LWPR as published with one threshold; the points are gone through several times where metrics are learned."""

    def __init__(self, threshold: float, kernel: float | None, rate: float, passes: int) -> None:
        # the library's rate, 50, belongs to a metric of 25
        learning_rate = 50.0 * rate / 25.0 / kernel**2 if kernel is not None and rate > 0.0 else None
        self.model = ReferenceLWPR(
            ReferenceSettings(
                activation_threshold=threshold,
                initial_kernel_m=kernel,
                learn_metric=rate > 0.0,
                diagonal_metric=False,
                learning_rate=learning_rate,
            )
        )
        self.passes = passes

    def fit(self, cloud: PointCloud) -> ReferenceLWPR:
        """Learn a survey."""
        for _ in range(self.passes):
            self.model.partial_fit(cloud.coordinates, cloud.elevation)
        return self.model


def read_survey() -> PointCloud:
    """Ground points of the region."""
    options = SourceOptions(crs=None, sigma=None, classes=(2,), columns=None, nodata=None)
    cloud = PointCloud.concatenate(list(open_points(SURVEY, options).iter_chunks()))
    west, east, south, north = REGION
    inside = (cloud.easting > west) & (cloud.easting < east) & (cloud.northing > south) & (cloud.northing < north)
    return cloud.select(inside)


def axes_of_metrics(model: ReferenceLWPR) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (n, 2), axes (n, 2) in ascending order, m, and direction of the longer one, degrees, of all fields."""
    fields = model.state_.fields[: model.state_.n_fields]
    centre = np.column_stack([fields["centre_x"] + model.origin_[0], fields["centre_y"] + model.origin_[1]])
    metric = np.array([[fields["D_xx"], fields["D_xy"]], [fields["D_xy"], fields["D_yy"]]]).transpose(2, 0, 1)
    value, vector = np.linalg.eigh(metric)  # ascending: the smallest eigenvalue belongs to the longest axis
    axes = 1.0 / np.sqrt(np.maximum(value[:, ::-1], 1e-12))
    return centre, axes, np.degrees(np.arctan2(vector[:, 1, 0], vector[:, 0, 0]))


def cell_centres() -> tuple[FloatArray, FloatArray]:
    """Places on a grid of 1 m, row by row from the north-west, m."""
    west, east, south, north = REGION
    easting, northing = np.meshgrid(np.arange(west + 0.5, east), np.arange(north - 0.5, south, -1.0))
    return easting.ravel(), northing.ravel()


def draw_fields(cloud: PointCloud, ground: SurfaceModel, models: dict[float, ReferenceLWPR]) -> None:
    """Receptive fields as ellipses of one kernel size, on the surface of another model and the observations."""
    elevation = ground.predict(cell_centres()).elevation.reshape(_shape())
    figure, row = plt.subplots(1, 3, figsize=(12.0, 4.3), dpi=80, layout="constrained", sharey=True)
    for axes, (threshold, model) in zip(row, models.items(), strict=True):
        centre, half, angle = axes_of_metrics(model)
        image = axes.contourf(*_local_axes(), elevation, np.arange(74.0, 81.1, 0.5), cmap="terrain", alpha=0.7)
        axes.plot(*_local(cloud.coordinates), ",", color="0.3")
        patches = [
            Ellipse(place, 2.0 * axis[1], 2.0 * axis[0], angle=turn)
            for place, axis, turn in zip(_local(centre.T).T, half, angle, strict=True)
        ]
        axes.add_collection(PatchCollection(patches, facecolor="none", edgecolor="black", linewidth=0.7))
        axes.set_title(f"w_gen = {threshold:g}: {len(patches)} receptive fields", fontsize=10)
        _frame(axes)
    row[0].set_ylabel("m north")
    figure.colorbar(image, ax=row, label="elevation, m", shrink=0.8)
    _save(figure, "receptive_fields.png")


def draw_surfaces(models: dict[str, SurfaceModel]) -> None:
    """Mean and standard deviation of the surface by every model."""
    figure, grid = plt.subplots(
        2, len(models), figsize=(2.8 * len(models), 5.4), dpi=75, layout="constrained", sharex=True, sharey=True
    )
    for column, (name, model) in zip(grid.T, models.items(), strict=True):
        answer = model.predict(cell_centres())
        layers = (answer.elevation, answer.elevation_std)
        styles: tuple[dict[str, Any], ...] = (
            {"cmap": "terrain", "vmin": 74.0, "vmax": 81.0},
            {"cmap": "magma_r", "norm": mpl.colors.LogNorm(0.01, 1.0)},
        )
        images = [
            axes.imshow(layer.reshape(_shape()), extent=_extent(), interpolation="nearest", **style)
            for axes, layer, style in zip(column, layers, styles, strict=True)
        ]
        column[0].set_title(name, fontsize=10)
        column[1].set_xlabel("m east")
    for row, image, label in zip(grid, images, ("mean, m", "standard deviation of the surface, m"), strict=True):
        row[0].set_ylabel("m north")
        figure.colorbar(image, ax=row, label=label)
    _save(figure, "mean_and_std.png")


def measure(cloud: PointCloud) -> tuple[dict[str, list[list[Scores]]], dict[str, list[Scores]]]:
    """Scores on held-out points: of the variants by threshold and seed, and of the other models by seed."""
    published: dict[str, list[list[Scores]]] = {name: [[] for _ in THRESHOLDS] for name in VARIANTS}
    peers = {
        "GPR, RBF": comparators()["gpr_rbf"],
        "GPR, Matern 3/2": comparators()["gpr_matern32"],
        "LWPR, adaptive mode": LWPRSurface,
    }
    others: dict[str, list[Scores]] = {name: [] for name in peers}
    for seed in SEEDS:
        is_held_out = hold_out_random(cloud.coordinates, 0.1, seed)
        learned, asked = cloud.select(~is_held_out), cloud.select(is_held_out)
        for name, settings in VARIANTS.items():
            for place, threshold in enumerate(THRESHOLDS):
                model = Published(threshold, *settings).fit(learned)
                published[name][place].append(_scored(model, asked))
        for name, build in peers.items():
            others[name].append(_scored(build().fit(learned.coordinates, learned.elevation), asked))
    return published, others


def draw_accuracy(published: dict[str, list[list[Scores]]], others: dict[str, list[Scores]]) -> None:
    """Scores as the threshold rises: lines are medians over the seeds, bands reach from the least to the largest."""
    labels = {"rmse": "RMSE of held-out points, m", "nlpd": "NLPD, nats", "coverage_95": "share in the 95 % interval"}
    figure, row = plt.subplots(1, 3, figsize=(13.0, 4.6), dpi=90, layout="constrained")
    for axes, (key, label) in zip(row, labels.items(), strict=True):
        for number, (name, by_threshold) in enumerate(published.items()):
            values = np.array([[getattr(item, key) for item in scores] for scores in by_threshold])
            axes.plot(THRESHOLDS, np.median(values, axis=1), "o-", color=f"C{number}", label=name, markersize=3)
            axes.fill_between(THRESHOLDS, values.min(axis=1), values.max(axis=1), color=f"C{number}", alpha=0.15)
        for (name, scores), style in zip(others.items(), ("k:", "k--", "r-"), strict=True):
            axes.axhline(np.median([getattr(item, key) for item in scores]), label=name, **_line(style))
        axes.set_xscale("log")
        axes.set_xlabel("activation threshold w_gen")
        axes.set_title(label, fontsize=10)
    row[0].set_yscale("log")
    ticks = (0.06, 0.08, 0.1, 0.15, 0.2, 0.3)
    row[0].set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    row[0].set_yticks([], minor=True)
    row[2].axhline(0.95, color="0.8", zorder=0)
    figure.legend(*row[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    _save(figure, "accuracy_by_threshold.png")


def table(published: dict[str, list[list[Scores]]], others: dict[str, list[Scores]]) -> str:
    """RMSE as Markdown: median over the seeds and its range."""
    lines = ["| RMSE, m | " + " | ".join(f"{value:g}" for value in THRESHOLDS) + " |", "|---" * 11 + "|"]
    for name, by_threshold in published.items():
        cells = [f"{np.median([item.rmse for item in scores]):.3f}" for scores in by_threshold]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for name, scores in others.items():
        of = {key: np.median([getattr(item, key) for item in scores]) for key in ("rmse", "nlpd", "coverage_95")}
        rmse = [item.rmse for item in scores]
        lines.append(
            f"\n{name}: RMSE {of['rmse']:.4f} m ({min(rmse):.4f} to {max(rmse):.4f}), NLPD {of['nlpd']:.2f}, "
            f"{of['coverage_95']:.3f} in the 95 % interval"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Draw all figures and print the table."""
    if not SURVEY.is_file():
        sys.exit(f"'{SURVEY}' is not there. Set CHANGEDETECT_DATA to the folder that holds ttp_lidar.")
    cloud = read_survey()
    models = {value: Published(value, KERNEL_M, 1.0, PASSES).fit(cloud) for value in SHOWN}
    for threshold, model in models.items():
        _, axes, _ = axes_of_metrics(model)
        ratio = np.percentile(axes[:, 1] / axes[:, 0], (50.0, 95.0, 100.0))
        sizes = np.percentile(np.sqrt(axes.prod(axis=1)), (5.0, 50.0, 95.0))
        sys.stdout.write(f"w_gen {threshold:g}: {len(axes)} fields, sizes {sizes} m, axis ratio {ratio}\n")
    for threshold in SHOWN:
        _, axes, _ = axes_of_metrics(Published(threshold, 2.8, 10.0, PASSES).fit(cloud))
        needles = int(np.sum(~(axes[:, 1] < 20.0 * axes[:, 0])))
        sys.stdout.write(f"w_gen {threshold:g}, ten times the rate: {len(axes)} fields, {needles} of them needles\n")
    adaptive = LWPRSurface().fit(cloud.coordinates, cloud.elevation)
    draw_fields(cloud, adaptive, models)
    shown: dict[str, SurfaceModel] = {f"w_gen = {value:g}": model for value, model in models.items()}
    shown["GPR, Matern 3/2"] = comparators()["gpr_matern32"]().fit(cloud.coordinates, cloud.elevation)
    shown["adaptive mode"] = adaptive
    draw_surfaces(shown)
    published, others = measure(cloud)
    draw_accuracy(published, others)
    sys.stdout.write(f"{len(cloud)} points\n" + table(published, others))


def _scored(model: SurfaceModel, asked: PointCloud) -> Scores:
    scores = score(asked.elevation, model.predict(asked.coordinates))
    if scores is None:
        message = f"{model!r} answers nowhere"
        raise RuntimeError(message)
    return scores


def _save(figure: Any, name: str) -> None:
    """Save as a small file: without an opacity channel, with the strongest compression."""
    figure.canvas.draw()
    Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[:, :, :3]).save(HERE / name, optimize=True)


def _shape() -> tuple[int, int]:
    return round(REGION[3] - REGION[2]), round(REGION[1] - REGION[0])


def _extent() -> tuple[float, float, float, float]:
    return 0.0, REGION[1] - REGION[0], 0.0, REGION[3] - REGION[2]


def _local_axes() -> tuple[FloatArray, FloatArray]:
    n_rows, n_cols = _shape()
    return np.arange(0.5, n_cols), np.arange(n_rows - 0.5, 0.0, -1.0)


def _local(coordinates: Any) -> FloatArray:
    return np.asarray(coordinates) - np.array([[REGION[0]], [REGION[2]]])


def _line(style: str) -> dict[str, str]:
    return {"color": style[0], "linestyle": style[1:], "linewidth": "1.3"}


def _frame(axes: Any) -> None:
    axes.set(xlim=(0.0, REGION[1] - REGION[0]), ylim=(0.0, REGION[3] - REGION[2]), aspect="equal", xlabel="m east")


if __name__ == "__main__":
    main()
