"""A programme with known truth, written as files: what `update` can be tried and judged on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, time
from itertools import combinations
from pathlib import Path
from typing import Any

from changedetect.catalogue import Epoch, Programme, Source
from changedetect.config import PROGRAMME_FILE
from changedetect.errors import OutputExistsError
from changedetect.grid import Grid
from changedetect.io.cog import write_cog
from changedetect.io.las import write_points
from changedetect.storage import sha256_of_file, write_json
from changedetect.synthetic import SimulatedEpoch, SimulatedProgramme, demo_programme
from changedetect.typing import FloatArray

__all__ = ["SimulatedFiles", "simulate"]

#: Version of the layout of `truth/truth.json`.
TRUTH_FORMAT_VERSION = 1
_TRUTH_FILE = "truth/truth.json"


@dataclass(frozen=True)
class SimulatedFiles:
    """
    What `simulate` wrote.

    Attributes
    ----------
    epoch_ids : tuple of str
    n_points : int
        Of all epochs.
    files : tuple of str
        Relative to the programme's folder.
    """

    epoch_ids: tuple[str, ...]
    n_points: int
    files: tuple[str, ...]


def simulate(
    directory: Path,
    random_seed: int,
    *,
    density: float,
    resolution: float = 0.5,
    overwrite: bool = False,
    dry_run: bool = False,
) -> SimulatedFiles:
    """
    Write the demonstration programme: three simulated epochs, and the truth they were drawn from.

    Parameters
    ----------
    directory : Path
    random_seed : int
        The same seed gives the same files, byte for byte.
    density : float, points per m2
    resolution : float, m
        Of the programme's rasters and of the true ones.
    overwrite : bool
        Replace the files of an earlier simulation; learned models and products become stale.
    dry_run : bool
        Write nothing.

    Returns
    -------
    SimulatedFiles

    Raises
    ------
    OutputExistsError
        There is a programme already.
    OutputError
        The folder cannot be written.

    Notes
    -----
    Surveys go to `inputs/EPOCH_ID.laz`, the truth to `truth/elevation_EPOCH_ID.tif`, `truth/dod_EARLIER_LATER.tif`
    and `truth/truth.json` (volumes).
    """
    if (directory / PROGRAMME_FILE).exists() and not overwrite:
        msg = f"'{directory}' holds a programme already. Choose another folder, or pass --overwrite."
        raise OutputExistsError(msg)
    simulated = demo_programme(random_seed, density=density)
    ids = tuple(epoch.epoch_id for epoch in simulated.epochs)
    surveys = {f"inputs/{epoch.epoch_id}.laz": epoch for epoch in simulated.epochs}
    truth = _true_rasters(simulated, simulated.grid(resolution))
    if not dry_run:
        programme = Programme.create(directory, _settings(simulated, resolution), overwrite=overwrite)
        for uri, epoch in surveys.items():
            programme = programme.write_epoch(_write_survey(directory, uri, epoch, simulated.scene.crs))
        _write_truth(directory, truth, simulated, resolution, random_seed)
    described = tuple(f"epochs/{epoch_id}.toml" for epoch_id in ids)
    files = (PROGRAMME_FILE, *described, *surveys, *truth, _TRUTH_FILE)
    return SimulatedFiles(ids, sum(len(epoch.survey.cloud) for epoch in simulated.epochs), files)


def _settings(simulated: SimulatedProgramme, resolution: float) -> dict[str, Any]:
    scene = simulated.scene
    return {"name": "demo", "crs": scene.crs, "resolution": resolution, "bounds": scene.region}


def _write_survey(directory: Path, uri: str, simulated: SimulatedEpoch, crs: str) -> Epoch:
    """Write one epoch's points, and describe them as `add` would."""
    path, cloud = directory / uri, simulated.survey.cloud
    write_points(path, cloud, crs, created=simulated.date)
    source = Source(uri=uri, sha256=sha256_of_file(path), size=path.stat().st_size, n_points=len(cloud))
    return Epoch(
        epoch_id=simulated.epoch_id,
        date=datetime.combine(simulated.date, time()),
        sources=(source,),
        label="simulated",
        region=cloud.region,
    )


def _true_rasters(simulated: SimulatedProgramme, grid: Grid) -> dict[str, FloatArray]:
    """Elevation of each epoch and change of each pair, by the name of the file."""
    ids = [epoch.epoch_id for epoch in simulated.epochs]
    rasters = {f"truth/elevation_{name}.tif": simulated.true_elevation(grid, k) for k, name in enumerate(ids)}
    for earlier, later in combinations(range(len(ids)), 2):
        name = f"truth/dod_{ids[earlier]}_{ids[later]}.tif"
        rasters[name] = simulated.true_change(grid, earlier, later)
    return rasters


def _write_truth(
    directory: Path,
    rasters: Mapping[str, FloatArray],
    simulated: SimulatedProgramme,
    resolution: float,
    random_seed: int,
) -> None:
    grid = simulated.grid(resolution)
    for name, raster in rasters.items():
        description = "true elevation of the surface" if "elevation_" in name else "true change, later minus earlier"
        tags = {"random_seed": str(random_seed)}
        write_cog(directory / name, raster, grid, nodata=math.nan, description=description, unit="m", tags=tags)
    volumes = {}
    for earlier, later in combinations(range(len(simulated.epochs)), 2):
        volume = simulated.true_volume(earlier, later)
        volumes[f"{simulated.epochs[earlier].epoch_id}_{simulated.epochs[later].epoch_id}"] = {
            "volume_raised_m3": volume.fill,
            "volume_lowered_m3": abs(volume.cut),
            "volume_net_m3": volume.net,
        }
    document = {"format_version": TRUTH_FORMAT_VERSION, "random_seed": random_seed, "volumes": volumes}
    write_json(directory / _TRUTH_FILE, document)
