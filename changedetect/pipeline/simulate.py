"""A programme with known truth, written as files: what `update` can be tried and judged on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, time
from pathlib import Path

import changedetect
from changedetect.catalogue import Epoch, Programme, Source
from changedetect.config import PROGRAMME_FILE
from changedetect.errors import OutputExistsError
from changedetect.io.cog import write_cog
from changedetect.io.las import write_points
from changedetect.storage import sha256_of_file, write_json
from changedetect.synthetic import SimulatedProgramme, demo_programme
from changedetect.typing import FloatArray

__all__ = ["SimulatedFiles", "simulate"]

#: Version of the layout of `truth/truth.json`.
TRUTH_FORMAT_VERSION = 1


@dataclass(frozen=True)
class SimulatedFiles:
    """
    What `simulate` wrote.

    Attributes
    ----------
    programme : Programme
        Ready for `update`.
    n_points : int
        Of all epochs.
    """

    programme: Programme
    n_points: int


def simulate(
    directory: Path, random_seed: int, *, density: float, resolution: float = 0.5, overwrite: bool = False
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
    settings = {
        "name": "demo",
        "crs": simulated.scene.crs,
        "resolution": resolution,
        "bounds": simulated.scene.region,
    }
    programme = Programme.create(directory, settings, overwrite=overwrite)
    for simulated_epoch in simulated.epochs:
        path = directory / "inputs" / f"{simulated_epoch.epoch_id}.laz"
        cloud = simulated_epoch.survey.cloud
        write_points(path, cloud, simulated.scene.crs, created=simulated_epoch.date)
        source = Source(
            uri=path.relative_to(directory).as_posix(),
            sha256=sha256_of_file(path),
            size=path.stat().st_size,
            n_points=len(cloud),
        )
        moment = datetime.combine(simulated_epoch.date, time())
        epoch = Epoch(
            epoch_id=simulated_epoch.epoch_id, date=moment, sources=(source,), label="simulated", region=cloud.region
        )
        programme = programme.write_epoch(epoch)
    _write_truth(directory / "truth", simulated, resolution, random_seed)
    return SimulatedFiles(programme, sum(len(epoch.survey.cloud) for epoch in simulated.epochs))


def _write_truth(directory: Path, simulated: SimulatedProgramme, resolution: float, random_seed: int) -> None:
    grid = simulated.grid(resolution)
    ids = [epoch.epoch_id for epoch in simulated.epochs]
    tags = {"random_seed": str(random_seed), "changedetect_version": changedetect.__version__}

    def write(name: str, array: FloatArray, description: str) -> None:
        path = directory / f"{name}.tif"
        write_cog(path, array, grid, nodata=math.nan, description=description, unit="m", tags=tags)

    volumes = {}
    for k, epoch_id in enumerate(ids):
        write(f"elevation_{epoch_id}", simulated.true_elevation(grid, k), "true elevation of the surface")
    for earlier in range(len(ids)):
        for later in range(earlier + 1, len(ids)):
            pair = f"{ids[earlier]}_{ids[later]}"
            write(f"dod_{pair}", simulated.true_change(grid, earlier, later), "true change, later minus earlier")
            volume = simulated.true_volume(earlier, later)
            volumes[pair] = {
                "volume_raised_m3": volume.fill,
                "volume_lowered_m3": -volume.cut,
                "volume_net_m3": volume.net,
            }
    truth = {"format_version": TRUTH_FORMAT_VERSION, "random_seed": random_seed, "volumes": volumes}
    write_json(directory / "truth.json", truth)
