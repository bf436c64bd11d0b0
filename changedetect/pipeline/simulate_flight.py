"""Simulated flights as folders: logs, photos and truth, what `add`, `update` and `reconstruct` can be tried on."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from changedetect.errors import ConfigError, OutputExistsError
from changedetect.grid import Grid
from changedetect.io.cog import write_cog
from changedetect.io.flight_files import (
    write_camera_file,
    write_initial_state,
    write_logs,
    write_photos,
    write_pose_table,
    write_positions,
    write_site,
)
from changedetect.navigation.frame import LocalFrame
from changedetect.storage import write_json
from changedetect.synthetic.flight_photos import FlightDesign, FlownEpoch, fly_programme
from changedetect.synthetic.flight_scene import CELL, FlightScene
from changedetect.typing import FloatArray, JSONObject

__all__ = ["SimulatedFlights", "simulate_flights"]

#: Version of the layout of `truth/truth.json`.
TRUTH_FORMAT_VERSION = 1
#: When the first epoch is flown, and how long it is to the next.
_FIRST, _INTERVAL = datetime(2024, 5, 1, 2), timedelta(days=182)
_STD_DEG = (1.0, 1.0, 3.0)


@dataclass(frozen=True)
class SimulatedFlights:
    """
    What was written.

    Attributes
    ----------
    flights : tuple of str
        Folders of the epochs, relative to the output folder.
    dates : tuple of str
        ISO 8601.
    n_photos : int
        Of all epochs.
    files : tuple of str
        Relative to the output folder, without the photos.
    """

    flights: tuple[str, ...]
    dates: tuple[str, ...]
    n_photos: int
    files: tuple[str, ...]


def simulate_flights(
    directory: Path,
    design: FlightDesign | None = None,
    *,
    seed: int = 0,
    overwrite: bool = False,
    dry_run: bool = False,
    on_step: Callable[[int, int, str], None] | None = None,
) -> SimulatedFlights:
    """
    Write flights over one simulated site, with truth.

    Parameters
    ----------
    directory : path
    design : FlightDesign, optional
    seed : int
    overwrite : bool
        Replace flights written before.
    dry_run : bool
        Write nothing.
    on_step : callable, optional
        Called with how much is done, of how much, and of what.

    Returns
    -------
    written : SimulatedFlights

    Raises
    ------
    ConfigError
        Such flights cannot be made.
    OutputExistsError
        There are flights already.
    OutputError
        The folder cannot be written.

    Notes
    -----
    `epochN/` holds imu.csv, gps.csv, images.csv, images/, geo.txt and init.json; camera.yaml and site.json lie above.
    `truth/` holds `dem_epochN.tif`, `ground.tif` (without objects), `near_object.tif`, `views.tif` (photos that see a
    place in the flight that sees it least), `change_MtoN.tif`, `poses_epochN.csv` and truth.json, in a transverse
    Mercator grid at the origin, which is ENU to a millimetre.
    """
    if (directory / "epoch1").exists() and not overwrite:
        msg = f"'{directory}' holds flights already. Choose another folder, or pass --overwrite."
        raise OutputExistsError(msg)
    try:
        epochs = fly_programme(design, seed=seed)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    names = tuple(f"epoch{epoch.number + 1}" for epoch in epochs)
    dates = tuple(_FIRST + k * _INTERVAL for k in range(len(epochs)))
    n_photos = sum(len(epoch.time) for epoch in epochs)
    files = ["camera.yaml", "site.json"]
    parts = ("imu.csv", "gps.csv", "images.csv", "geo.txt", "init.json")
    files += [f"{name}/{part}" for name in names for part in parts]
    files += [*_raster_names(len(epochs)), *(f"truth/poses_{name}.csv" for name in names), "truth/truth.json"]
    written = SimulatedFlights(names, tuple(f"{date:%Y-%m-%dT%H:%M}" for date in dates), n_photos, tuple(files))
    if dry_run:
        return written
    done = 0
    for epoch, name, date in zip(epochs, names, dates, strict=True):

        def on_photo(count: int, before: int = done, name: str = name) -> None:
            if on_step is not None:
                on_step(before + count, n_photos, f"photos of {name}")

        _write_epoch(directory / name, epoch, date, on_photo)
        done += len(epoch.time)
    _write_shared(directory, epochs, seed)
    return written


def _write_epoch(folder: Path, epoch: FlownEpoch, date: datetime, on_photo: Callable[[int], None]) -> None:
    flight = epoch.simulated.flight
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if flight.photos is not None:
        named = replace(flight.photos, names=epoch.names, paths=tuple(Path(name) for name in epoch.names))
        flight = replace(flight, photos=named)
    write_logs(folder, flight)
    write_initial_state(folder / "init.json", epoch.initial, _STD_DEG, date)
    write_positions(folder / "geo.txt", epoch.names, epoch.stated_positions(), epoch.design.origin)
    write_photos(folder / "images", epoch.names, epoch.photos(), on_photo)


def _write_shared(directory: Path, epochs: tuple[FlownEpoch, ...], seed: int) -> None:
    """Files above the flights, and the truth."""
    first = epochs[0]
    write_camera_file(directory / "camera.yaml", first.design.camera, first.simulated.flight.mount)
    write_site(directory / "site.json", first.simulated.flight)
    scene = first.scene
    grid = _grid(scene, first.design.origin)
    tags = {"random_seed": str(seed)}
    for name, (raster, description) in _rasters(scene, len(epochs)).items():
        write_cog(directory / name, raster[::-1], grid, nodata=math.nan, description=description, unit="m", tags=tags)
    for epoch in epochs:
        position, rotation = epoch.true_poses()
        path = directory / f"truth/poses_epoch{epoch.number + 1}.csv"
        write_pose_table(path, epoch.names, epoch.time, position, rotation)
    write_json(directory / "truth/truth.json", _truth_document(epochs, seed))


def _raster_names(n_epochs: int) -> list[str]:
    names = [f"truth/dem_epoch{k + 1}.tif" for k in range(n_epochs)]
    names += [f"truth/change_{a + 1}to{b + 1}.tif" for a in range(n_epochs) for b in range(a + 1, n_epochs)]
    return [*names, "truth/ground.tif", "truth/near_object.tif", "truth/views.tif"]


def _rasters(scene: FlightScene, n_epochs: int) -> dict[str, tuple[FloatArray, str]]:
    """Rasters of the truth, row 0 in the south, with their descriptions."""
    rasters = {f"truth/dem_epoch{k + 1}.tif": (scene.surface(k), "true elevation") for k in range(n_epochs)}
    for a in range(n_epochs):
        for b in range(a + 1, n_epochs):
            rasters[f"truth/change_{a + 1}to{b + 1}.tif"] = (scene.change(b) - scene.change(a), "true change")
    rasters["truth/ground.tif"] = (scene.ground, "true elevation without objects")
    rasters["truth/near_object.tif"] = (scene.near_object.astype(np.float64), "1 within 0.75 m of an object")
    rasters["truth/views.tif"] = (scene.views.astype(np.float64), "photos of the flight that sees it least")
    return rasters


def _grid(scene: FlightScene, origin: LocalFrame) -> Grid:
    crs = (
        f"+proj=tmerc +lat_0={origin.latitude} +lon_0={origin.longitude} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m "
        "+no_defs"
    )
    n_rows, n_cols = scene.ground.shape
    return Grid(n_rows, n_cols, -scene.half_east - CELL / 2, scene.half_north + CELL / 2, CELL, crs)


def _truth_document(epochs: tuple[FlownEpoch, ...], seed: int) -> JSONObject:
    scene, design = epochs[0].scene, epochs[0].design
    return {
        "format_version": TRUTH_FORMAT_VERSION,
        "random_seed": seed,
        "changes": [
            {"kind": c.kind, "x": c.east, "y": c.north, "radius": c.radius, "height": abs(c.height)}
            for c in scene.changes
        ],
        "growth": [scene.growth(epoch.number) for epoch in epochs],
        "gps_offset_enu_m": [epoch.simulated.gps_offset.tolist() for epoch in epochs],
        "gps": asdict(design.gps),
    }
