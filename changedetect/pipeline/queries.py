"""Asking a learned model: at the places of a table, on a grid, between two epochs."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np

from changedetect.catalogue import ProductRecord, Programme, plan
from changedetect.errors import InputDataError, MissingInputError, OutputExistsError, UsageError
from changedetect.io.cog import write_cog
from changedetect.io.netcdf import SURFACE_LAYERS, SurfaceMetadata, write_surface
from changedetect.pipeline.learn import ModelShelf
from changedetect.pipeline.manifest import new_run_id, utc_now
from changedetect.pipeline.places import iter_coordinates
from changedetect.pipeline.products import make_pair_products, predict_layers, product_grid
from changedetect.pipeline.regions import describe_region
from changedetect.storage import atomic_path
from changedetect.typing import JSONObject, Region

__all__ = ["difference_epochs", "predict_table", "require_model", "write_epoch_surface"]

#: Endings that nobody gives a folder.
_FILE_SUFFIXES = (".tif", ".tiff", ".nc", ".csv", ".json", ".gpkg", ".geojson", ".shp", ".laz", ".las", ".png", ".txt")
#: Columns that `predict_table` writes after easting and northing.
PREDICTED_COLUMNS = ("elevation", "elevation_std", "noise_std", "n_effective")


def require_model(programme: Programme, epoch_id: str) -> str | None:
    """
    Check that the model of an epoch can be asked.

    Returns
    -------
    warning : str or None
        Why the model is not up to date.

    Raises
    ------
    MissingInputError
        There is no such epoch, or it has not been learned.
    """
    programme.epoch(epoch_id)
    if not programme.state_directory(epoch_id).is_dir():
        msg = f"Epoch '{epoch_id}' has not been learned. Run: changedetect update {programme.directory}"
        raise MissingInputError(msg)
    items = [item for item in plan(programme) if item.kind == "model" and item.item_id == epoch_id and item.is_due]
    return f"the model of {epoch_id} is not up to date: {'; '.join(items[0].reasons)}" if items else None


def predict_table(
    programme: Programme, epoch_id: str, points: Path, output: Path, *, overwrite: bool = False, dry_run: bool = False
) -> JSONObject:
    """
    Predict the surface of an epoch at the places of a table.

    Parameters
    ----------
    programme : Programme
    epoch_id : str
    points : Path
        CSV file with columns easting and northing (or x and y) in the programme's CRS, m; other columns are left
        out. Without a header the first two columns count.
    output : Path
        CSV file with easting, northing, elevation, elevation_std, noise_std (m) and n_effective; "nan" where no data
        supports an answer. Numbers are written so that they read back bit for bit.
    overwrite : bool
    dry_run : bool
        Read and predict, and write nothing.

    Returns
    -------
    details : dict
        Counts of the places, and of those without an answer.

    Raises
    ------
    UsageError
        The output does not end in ``.csv``.
    MissingInputError, InputDataError
        The table or the model is missing; the table holds something else than numbers: the message names the line.
    OutputExistsError
        The output exists.
    """
    require_suffix(output, (".csv",), "Predictions are written as a CSV table.")
    require_outside(programme, output)
    require_absent(output, overwrite=overwrite, source=points)
    model = ModelShelf(programme).get(epoch_id)
    header = ("easting", "northing", *PREDICTED_COLUMNS)
    n_points = n_unknown = 0
    with iter_coordinates(points) as blocks, _new_table(output, header, dry_run=dry_run) as write_rows:
        for easting, northing in blocks:
            prediction = model.predict((easting, northing))
            columns = [easting, northing, *(getattr(prediction, name) for name in PREDICTED_COLUMNS)]
            write_rows(zip(*(map(repr, column.tolist()) for column in columns), strict=True))
            n_points += easting.size
            n_unknown += int(np.count_nonzero(np.isnan(prediction.elevation)))
        if n_points == 0:
            msg = f"'{points}' holds no places: rows of easting and northing are expected."
            raise InputDataError(msg)
    return {"output": str(output), "n_points": n_points, "n_without_answer": n_unknown}


def write_epoch_surface(
    programme: Programme,
    epoch_id: str,
    output: Path,
    *,
    layer: str = "elevation",
    resolution: float | None = None,
    bounds: Region | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
) -> JSONObject:
    """
    Write the surface of an epoch as one raster.

    Parameters
    ----------
    programme : Programme
    epoch_id : str
    output : Path
        ``.tif`` for one layer as Cloud Optimized GeoTIFF, ``.nc`` for all layers as CF NetCDF.
    layer : str
        Of `SURFACE_LAYERS`; for a GeoTIFF.
    resolution : float, m, optional
    bounds : tuple (west, east, south, north), m, optional
        The programme's own by default.
    overwrite, dry_run : bool

    Returns
    -------
    details : dict

    Raises
    ------
    UsageError
        The file's suffix is not known.
    ConfigError
        Resolution or bounds enclose nothing, or the bounds no data.
    InputDataError
        The epoch observed nothing of the ground in the bounds.
    OutputExistsError
        The output exists.
    """
    require_suffix(output, (".tif", ".tiff", ".nc"), "GeoTIFF holds one layer, NetCDF all of them.")
    require_outside(programme, output)
    require_absent(output, overwrite=overwrite)
    config, epoch = programme.config, programme.epoch(epoch_id)
    model = ModelShelf(programme).get(epoch_id)
    grid = product_grid(config, model.region, resolution=resolution, bounds=bounds)
    details: JSONObject = {"output": str(output), "shape": list(grid.shape), "region": list(grid.region)}
    if dry_run:
        return details
    layers = predict_layers(model, grid)
    if not np.isfinite(layers["elevation"]).any():
        msg = (
            f"Epoch '{epoch_id}' observed nothing in {describe_region(grid.region)}, a gap in its data, which span "
            f"{describe_region(model.region)} in {config.crs}. Choose other bounds."
        )
        raise InputDataError(msg)
    meta = SurfaceMetadata(
        programme=config.name,
        run_id=new_run_id(),
        config_sha256=config.config_sha256,
        created=utc_now(),
        epoch=epoch_id,
        datetime=epoch.date.isoformat(),
    )
    if output.suffix.lower() == ".nc":
        write_surface(output, layers, grid, meta)
    else:
        described = SURFACE_LAYERS[layer]
        write_cog(
            output,
            layers[layer],
            grid,
            nodata=math.nan,
            description=described.long_name,
            unit=described.unit,
            tags={key: str(value) for key, value in asdict(meta).items() if value} | {"layer": layer},
        )
    return details | {"covered_share": float(np.mean(np.isfinite(layers["elevation"])))}


def difference_epochs(
    programme: Programme, earlier: str, later: str, directory: Path, *, overwrite: bool = False, dry_run: bool = False
) -> JSONObject:
    """
    Write the products of one pair of epochs into any folder.

    Parameters
    ----------
    programme : Programme
    earlier, later : str
        Epoch ids, in the order of time.
    directory : Path
        Replaced as a whole where it holds such products already and `overwrite` is set.
    overwrite, dry_run : bool

    Returns
    -------
    details : dict
        As `make_pair_products`.

    Raises
    ------
    UsageError
        The folder has the name of a file, or is one of those that the programme keeps.
    OutputExistsError
        The folder holds something else, or `overwrite` is not set.
    """
    require_suffix(directory, (), "A difference is written as a folder of maps.")
    require_outside(programme, directory)
    require_replaceable(directory, overwrite=overwrite)
    pair = programme.pair(earlier, later)
    if dry_run:
        return {"directory": str(directory)}
    return make_pair_products(programme, pair, ModelShelf(programme), new_run_id(), directory)


def require_suffix(output: Path, suffixes: Sequence[str], content: str) -> None:
    """
    Refuse a file whose name promises another format than is written.

    Parameters
    ----------
    output : Path
    suffixes : sequence of str
        Allowed endings, lower case with their dots; none where a folder is written.
    content : str
        What is written, to begin a sentence with.

    Raises
    ------
    UsageError
    """
    suffix = output.suffix.lower()
    if suffixes and suffix not in suffixes:
        msg = f"'{output}' does not end in {' or '.join(suffixes)}. {content}"
        raise UsageError(msg)
    if not suffixes and suffix in _FILE_SUFFIXES:
        msg = f"'{output}' looks like a file. {content} Name a folder."
        raise UsageError(msg)


def require_outside(programme: Programme, output: Path) -> None:
    """
    Refuse an output inside the folders that a programme keeps: it would replace a model or a product.

    Raises
    ------
    UsageError
    """
    kept = programme.keeps(output)
    if kept is not None:
        msg = f"'{output}' lies in '{kept}', which the programme keeps for itself. Name a place outside of it."
        raise UsageError(msg)


def require_absent(output: Path, *, overwrite: bool, source: Path | None = None) -> None:
    """
    Refuse to replace a file unless asked to, and to replace the one that is read at all.

    Raises
    ------
    OutputExistsError
    UsageError
        The output is the source.
    """
    if source is not None and output.exists() and source.exists() and output.samefile(source):
        msg = f"'{output}' is to be read and written at once. Choose another name for the output."
        raise UsageError(msg)
    if output.is_dir():
        msg = f"'{output}' is a folder; name a file."
        raise OutputExistsError(msg)
    if output.exists() and not overwrite:
        msg = f"'{output}' exists. Choose another name, or pass --overwrite to replace it."
        raise OutputExistsError(msg)


def require_replaceable(directory: Path, *, overwrite: bool) -> None:
    """
    Refuse to replace a folder unless it is empty, or holds products and replacing was asked for.

    Raises
    ------
    OutputExistsError
    """
    if not directory.exists() or (directory.is_dir() and not any(directory.iterdir())):
        return
    if not _holds_products(directory):
        msg = f"'{directory}' exists and holds something else than products. Choose another folder."
        raise OutputExistsError(msg)
    if not overwrite:
        msg = f"'{directory}' holds products already. Choose another folder, or pass --overwrite to replace them."
        raise OutputExistsError(msg)


def _holds_products(directory: Path) -> bool:
    try:
        return ProductRecord.read(directory) is not None
    except InputDataError:  # the manifest of something else
        return False


@contextmanager
def _new_table(
    output: Path, header: Sequence[str], *, dry_run: bool
) -> Iterator[Callable[[Iterable[Sequence[str]]], None]]:
    """Give what writes rows of a CSV file that is whole or absent; it takes them and writes nothing on a dry run."""
    if dry_run:
        yield _exhaust
        return
    with atomic_path(output) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        yield writer.writerows


def _exhaust(rows: Iterable[Sequence[str]]) -> None:
    deque(rows, maxlen=0)
