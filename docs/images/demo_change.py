"""
Draw demo_change.png from the products of surveys/demo.

    make demo
    .venv/bin/python -m pip install matplotlib
    .venv/bin/python docs/images/demo_change.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import rasterio
from matplotlib.patches import Patch

HERE = Path(__file__).resolve().parent
PAIR = HERE.parents[1] / "surveys" / "demo" / "products" / "2024-09-10_2025-03-20"
CLASSES = {
    0: ("below the level of detection", "#ebebeb"),
    1: ("lowered", "#b2182b"),
    2: ("raised", "#2166ac"),
    3: ("not observed in both epochs", "#bdae6c"),
}


def read(name: str) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """One raster of the pair and its extent (west, east, south, north), m from its corner."""
    with rasterio.open(PAIR / name) as raster:
        west, south, east, north = raster.bounds
        return raster.read(1), (0.0, east - west, 0.0, north - south)


dod, extent = read("dod.tif")
classes, _ = read("change_class.tif")
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.6), dpi=100, layout="constrained")

image = left.imshow(dod, cmap="RdBu", vmin=-0.3, vmax=0.3, extent=extent, interpolation="nearest")
left.set_facecolor("#bdae6c")
figure.colorbar(image, ax=left, shrink=0.75, label="2025-03-20 minus 2024-09-10, m", extend="both")
left.set_title("dod.tif")

colours = np.array([mpl.colors.to_rgb(colour) for _, colour in CLASSES.values()])
right.imshow(colours[np.minimum(classes, 3)], extent=extent, interpolation="nearest")
right.set_title("change_class.tif")
right.legend(
    handles=[Patch(facecolor=colour, edgecolor="#666666", label=label) for label, colour in CLASSES.values()],
    loc="upper center",
    bbox_to_anchor=(0.5, -0.12),
    ncols=2,
    frameon=False,
    fontsize=8,
)
for axes in (left, right):
    axes.set_xlabel("m east")
    axes.set_ylabel("m north")
figure.savefig(HERE / "demo_change.png")
