"""Small surveys for tests of whole programmes: a tilted, rippled square of 20 m with a block that may be raised."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import numpy as np
import pyogrio
import shapely

from changedetect.catalogue import Programme
from changedetect.cli import main
from changedetect.io.las import write_points
from changedetect.pointcloud import PointCloud

CRS = "EPSG:32632+5773"
WEST, SOUTH, SIDE = 500000.0, 5300000.0, 20.0
#: Ground (west, east, south, north) that `survey(step=...)` raises.
BLOCK = (WEST + 6.0, WEST + 14.0, SOUTH + 6.0, SOUTH + 14.0)


def survey(seed=0, *, step=0.0, offset=0.0, n_points=1800, noise=0.02, shift=0.0, sigma=None, classification=None):
    """Points on the square, its block raised by `step`, everything by `offset`, moved east by `shift` metres."""
    rng = np.random.default_rng(seed)
    easting = np.round(WEST + rng.uniform(0.0, SIDE, n_points), 3)
    northing = np.round(SOUTH + rng.uniform(0.0, SIDE, n_points), 3)
    elevation = 400.0 + 0.05 * (easting - WEST) + 0.2 * np.sin((northing - SOUTH) / 4.0)
    west, east, south, north = BLOCK
    elevation += step * ((easting > west) & (easting < east) & (northing > south) & (northing < north))
    elevation += offset + rng.normal(0.0, noise, n_points)
    sigmas = None if sigma is None else np.full(n_points, sigma)
    return PointCloud(easting + shift, northing, elevation, sigmas, classification)


def write_survey(path: Path, seed=0, crs=CRS, **arguments) -> Path:
    """Write `survey` as LAZ, with a fixed creation date."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_points(path, survey(seed, **arguments), crs, created=date(2024, 1, 1))
    return path


def make_programme(directory: Path, surveys, **settings) -> Programme:
    """
    Make a programme and write its epochs by hand, as a user may.

    `surveys` maps epoch ids, which are dates, to arguments of `survey`; the files get no checksums.
    """
    programme = Programme.create(directory, {"name": "site", "crs": CRS, "resolution": 0.5, **settings})
    for number, (epoch_id, arguments) in enumerate(surveys.items()):
        add_by_hand(directory, epoch_id, **{"seed": number, **arguments})
    return reopen(programme)


def add_by_hand(directory: Path, epoch_id: str, **arguments) -> None:
    """Write a survey and the epoch file that names it."""
    write_survey(directory / "inputs" / f"{epoch_id}.laz", **arguments)
    path = directory / "epochs" / f"{epoch_id}.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(f'date = {epoch_id}\n[[sources]]\nuri = "inputs/{epoch_id}.laz"\n')


def reopen(programme: Programme, **arguments) -> Programme:
    """Read a programme again, as the next command would."""
    return Programme.open(programme.directory, environment={}, **arguments)


def write_zones(path: Path, geometries, names=None, *, crs="EPSG:32632", layer="zones", column="name", append=False):
    """Write geometries, None among them for a feature without one, as a GeoPackage."""
    geometries = list(geometries)
    names = [f"zone {k}" for k in range(len(geometries))] if names is None else list(names)
    binary = np.array([None if g is None else shapely.to_wkb(g) for g in geometries], object)
    columns = [np.array(names, object)]
    pyogrio.raw.write(
        path, binary, columns, [column], layer=layer, driver="GPKG", geometry_type="Unknown", crs=crs, append=append
    )
    return path


def snapshot(directory: Path) -> dict[str, tuple[int, int]]:
    """Modification time and size of everything below a folder."""
    paths = [directory, *directory.rglob("*")]
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in paths}


def run(capsys, *arguments, expect=0):
    """Run the command line with --json, check the exit code, return the document."""
    code = main([*map(str, arguments), "--json"])
    captured = capsys.readouterr()
    assert code == expect, captured.err
    document = json.loads(captured.out)
    assert document["format_version"] == 1
    assert document["exit_code"] == expect
    return document
