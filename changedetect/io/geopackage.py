"""Change objects and budgets of zones as polygons: GeoPackages with their style inside, and the same beside them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyogrio
import shapely
from rasterio.features import shapes
from rasterio.transform import Affine

from changedetect.crs import horizontal_part, to_wkt
from changedetect.io.vector_style import LOWERED, RAISED, UNCERTAIN, Rule, polygon_style, store_style
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from changedetect.differencing import AreaBudget, ChangeObject, ChangeObjects, ObjectSize
    from changedetect.grid import Grid
    from changedetect.io.zones import Zone

__all__ = ["LAYER", "ZONE_LAYER", "object_polygons", "write_objects", "write_zone_budgets"]

#: Names of the layers.
LAYER = "objects"
ZONE_LAYER = "zones"
_FIELDS: dict[str, Any] = {
    "number": np.int32,
    "kind": object,
    "area_m2": np.float64,
    "volume_m3": np.float64,
    "volume_std_m3": np.float64,
    "volume_lower_m3": np.float64,
    "volume_upper_m3": np.float64,
    "mean_m": np.float64,
    "mean_std_m": np.float64,
    "extreme_m": np.float64,
    "q_value": np.float64,
    "width_m": np.float64,
    "resolution_m": np.float64,
    "is_resolved": np.bool_,
    "epoch_earlier": object,
    "epoch_later": object,
}
_ZONE_FIELDS: dict[str, Any] = {
    "name": object,
    "kind": object,
    "area_observed_m2": np.float64,
    "area_not_observed_m2": np.float64,
    **{
        f"{quantity}{part}_{unit}": np.float64
        for quantity, unit in (("volume_net", "m3"), ("volume_raised", "m3"), ("volume_lowered", "m3"), ("mean", "m"))
        for part in ("", "_std", "_lower", "_upper")
    },
    "epoch_earlier": object,
    "epoch_later": object,
}
#: Objects are the surer the more opaque: upper limits of the q-value, opacity of the fill and words for the legend.
_STRENGTHS = ((0.0, 0.001, 190, "q <= 0.001"), (0.001, 0.01, 120, "q <= 0.01"), (0.01, 1.0, 60, "q > 0.01"))
#: GDAL stamps the time into a GeoPackage; a fixed one makes the same objects the same file.
_STAMP = "2000-01-01T00:00:00.000Z"


def object_polygons(labels: NDArray[np.int32], grid: Grid) -> dict[int, shapely.MultiPolygon]:
    """
    Outlines of the objects of a raster, along cell borders.

    Parameters
    ----------
    labels : array, shape (n_rows, n_cols), int32
        Number of the object of each cell, 0 outside all.
    grid : Grid

    Returns
    -------
    polygons : dict of number to MultiPolygon
        In the CRS of the grid; valid.
    """
    parts: dict[int, list[shapely.Geometry]] = {}
    for outline, value in shapes(labels, mask=labels > 0, connectivity=4, transform=Affine(*grid.transform)):
        parts.setdefault(int(value), []).append(shapely.geometry.shape(outline))
    return {number: _multi(found) for number, found in sorted(parts.items())}


def _multi(parts: Sequence[shapely.Geometry]) -> shapely.MultiPolygon:
    joined = shapely.union_all(list(parts))
    if isinstance(joined, shapely.MultiPolygon):
        return joined
    return shapely.MultiPolygon([cast("shapely.Polygon", joined)])


def write_objects(
    path: Path, objects: ChangeObjects, grid: Grid, *, epochs: tuple[str, str], sizes: Mapping[int, ObjectSize]
) -> None:
    """
    Write change objects as a GeoPackage, and their style as ``NAME.qml`` beside it.

    Parameters
    ----------
    path : path
        With the suffix ``.gpkg``; replaced where it exists.
    objects : ChangeObjects
        None at all give an empty layer.
    grid : Grid
        Of the raster of objects.
    epochs : (earlier, later)
        Ids, stored with every object.
    sizes : mapping of number to ObjectSize
        Of every object.

    Raises
    ------
    OutputError
        The file cannot be written.

    Notes
    -----
    Lowered ground is red and raised ground blue, the more opaque the smaller its q-value; a dashed outline marks
    objects whose height and outline are not resolved. Labels give the volume and half its interval.
    """
    polygons = object_polygons(objects.labels, grid)
    rows = [_row(item, sizes[item.number], epochs) for item in objects.items]
    geometry = [polygons[item.number] for item in objects.items]
    _write(path, LAYER, geometry, rows, _FIELDS, grid.crs, _object_style(), "Change objects by sign and q-value")


def write_zone_budgets(
    path: Path, zones: Sequence[Zone], budgets: Sequence[AreaBudget], crs: str, *, epochs: tuple[str, str]
) -> None:
    """
    Write zones with what moved in them as a GeoPackage, and their style as ``NAME.qml`` beside it.

    Parameters
    ----------
    path : path
        With the suffix ``.gpkg``; replaced where it exists.
    zones : sequence of Zone
    budgets : sequence of AreaBudget
        One for each zone.
    crs : str
        Of the zones: the programme's.
    epochs : (earlier, later)
        Ids, stored with every zone.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    rows = [_zone_row(zone, budget, epochs) for zone, budget in zip(zones, budgets, strict=True)]
    geometry = [_multi([zone.polygon]) for zone in zones]
    _write(path, ZONE_LAYER, geometry, rows, _ZONE_FIELDS, crs, _zone_style(), "Zones by their net volume")


def _write(
    path: Path,
    layer: str,
    geometry: Sequence[shapely.MultiPolygon],
    rows: Sequence[tuple[Any, ...]],
    fields: Mapping[str, Any],
    crs: str,
    style: str,
    description: str,
) -> None:
    data = [np.array([row[k] for row in rows], dtype) for k, dtype in enumerate(fields.values())]
    with atomic_path(Path(path)) as temporary:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _STAMP})
        try:
            pyogrio.raw.write(
                temporary,
                np.array([shapely.to_wkb(shape) for shape in geometry], object),
                data,
                list(fields),
                layer=layer,
                driver="GPKG",
                geometry_type="MultiPolygon",
                crs=to_wkt(horizontal_part(crs)),
                dataset_options={"VERSION": "1.2"},  # newer ones make older programs warn, and offer nothing here
            )
        finally:
            pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
        store_style(temporary, layer, style, description)
    with atomic_path(Path(path).with_suffix(".qml")) as temporary:
        temporary.write_text(style, encoding="utf-8")


def _row(item: ChangeObject, size: ObjectSize, epochs: tuple[str, str]) -> tuple[Any, ...]:
    return (
        item.number,
        "raised" if item.is_raised else "lowered",
        item.area,
        item.volume.value,
        item.volume.std,
        item.volume.lower,
        item.volume.upper,
        item.mean.value,
        item.mean.std,
        item.extreme,
        item.q_value,
        size.width,
        size.resolution,
        size.is_resolved,
        *epochs,
    )


def _zone_row(zone: Zone, budget: AreaBudget, epochs: tuple[str, str]) -> tuple[Any, ...]:
    quantities = (budget.net, budget.raised, budget.lowered, budget.mean)
    known = budget.mean is not None
    numbers = [(q.value, q.std, q.lower, q.upper) if known and q is not None else (np.nan,) * 4 for q in quantities]
    is_changed = known and not budget.net.lower <= 0.0 <= budget.net.upper
    kind = "not observed" if not known else "no net change" if not is_changed else "lost"
    if is_changed and budget.net.value > 0.0:
        kind = "gained"
    areas = (budget.area_observed, budget.area_not_observed)
    return (zone.name, kind, *areas, *(number for four in numbers for number in four), *epochs)


def _object_style() -> str:
    rules = [
        Rule(
            f'"kind" = \'{kind}\' AND "q_value" {">=" if above == 0.0 else ">"} {above} AND "q_value" <= {limit}',
            f"{kind}, {words}",
            *colours,
            opacity,
        )
        for kind, colours in (("lowered", LOWERED), ("raised", RAISED))
        for above, limit, opacity, words in _STRENGTHS
    ]
    white, black = (255, 255, 255), (0, 0, 0)
    rules.append(Rule('NOT "is_resolved"', "height and outline not resolved", white, black, 0, 0.4, is_dashed=True))
    return polygon_style(
        rules,
        "format_number(volume_m3, 0) || ' ± ' || format_number((volume_upper_m3 - volume_lower_m3) / 2, 0) || ' m³'",
    )


def _zone_style() -> str:
    rules = [
        Rule("\"kind\" = 'lost'", "lost material", *LOWERED, 90, 0.5),
        Rule("\"kind\" = 'gained'", "gained material", *RAISED, 90, 0.5),
        Rule("\"kind\" = 'no net change'", "no significant net change", *UNCERTAIN, 60, 0.5),
        Rule("\"kind\" = 'not observed'", "not observed in both epochs", *UNCERTAIN, 0, 0.5, is_dashed=True),
    ]
    return polygon_style(
        rules,
        "\"name\" || coalesce('\n' || format_number(volume_net_m3, 0) || ' ± ' || "
        "format_number((volume_net_upper_m3 - volume_net_lower_m3) / 2, 0) || ' m³', '')",
    )
