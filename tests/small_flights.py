"""Small simulated flights for tests of whole programmes, and their truth."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import map_coordinates

from changedetect.crs import make_transform
from changedetect.io.cog import read_cog
from changedetect.pipeline.flight_store import load_finished
from changedetect.pipeline.simulate_flight import simulate_flights
from changedetect.synthetic.flight_photos import FlightDesign

CRS = "EPSG:32756+4979"
#: Two strips of five photos; small, and enough to be adjusted to a decimetre and a half.
DESIGN = FlightDesign(n_strips=2, n_photos=5, size=(400, 300))
FIRST, SECOND, THIRD = "2024-05-01", "2024-10-30", "2025-04-30"


def fly(folder: Path, *, seed: int = 1, design: FlightDesign = DESIGN) -> Path:
    """Simulate flights; each epoch gets camera and site of its own, so that it can be copied alone."""
    simulate_flights(folder, design, seed=seed)
    for epoch in folder.glob("epoch*"):
        for name in ("camera.yaml", "site.json"):
            (epoch / name).write_bytes((folder / name).read_bytes())
    return folder


def nmad(values: np.ndarray) -> float:
    """Robust standard deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


class TrueChange:
    """Truth on the cells of a difference, where the earlier flight really lies."""

    def __init__(
        self, programme: Path, truth: Path, epochs: tuple[str, str], numbers: tuple[int, int] = (1, 2)
    ) -> None:
        self.document = json.loads((truth / "truth.json").read_text())
        products = programme / "products" / "_".join(epochs)
        self.dod, grid, _ = read_cog(products / "dod.tif")
        self.lod, self.change_class = (
            read_cog(products / f"{n}.tif")[0] for n in ("level_of_detection", "change_class")
        )
        finished = load_finished(programme / "flights" / epochs[0] / "points" / "orientation.npz")
        block = finished.adjustment.block
        with (truth / f"poses_epoch{numbers[0]}.csv").open() as stream:
            rows = {row["image"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(stream)}
        place = (block.position - np.array([rows[name] for name in block.names])).mean(axis=0)
        easting, northing = grid.coordinates()
        longitude, latitude, height = make_transform(CRS, "EPSG:4979")(easting, northing, np.full(easting.size, 40.0))
        enu = finished.origin.to_enu(latitude, longitude, height) - place
        self.east, self.north = enu[:, 0].reshape(grid.shape), enu[:, 1].reshape(grid.shape)
        self.change = self._sample(truth / f"change_{numbers[0]}to{numbers[1]}.tif", 1)
        near = self._sample(truth / "near_object.tif", 0)
        inside = self._sample(truth / "views.tif", 0) >= 4
        self.is_open = np.isfinite(self.dod) & inside & (near < 0.5)
        self.is_stable = self.is_open & (self.distance("mound", "pit", "plateau", "paint") > 2.0)

    def _sample(self, path: Path, order: int) -> np.ndarray:
        with rasterio.open(path) as source:
            values, t = source.read(1), source.transform
        at = [(self.north - t.f) / t.e - 0.5, (self.east - t.c) / t.a - 0.5]
        return map_coordinates(values.astype(float), at, order=order, mode="nearest")

    def distance(self, *kinds: str) -> np.ndarray:
        """Distance of every cell from the rim of the nearest change of these kinds, m; negative inside."""
        chosen = [c for c in self.document["changes"] if c["kind"] in kinds]
        return np.min([np.hypot(self.east - c["x"], self.north - c["y"]) - c["radius"] for c in chosen], axis=0)

    def means(self, kind: str) -> tuple[float, float]:
        """Mean change in a patch, as found and as it is, m."""
        inside = np.isfinite(self.dod) & (self.distance(kind) < 0)
        return float(self.dod[inside].mean()), float(self.change[inside].mean())
