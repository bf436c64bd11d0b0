"""
SpatioTemporal Asset Catalogs: items beside products, one collection and one catalogue for a programme.

Version 1.1 of the specification [1]_, with the extensions named in `_EXTENSIONS`. The catalogue is static, links are
relative and nothing lies outside it, so a folder of products can be copied or served as it is. Documents are plain
JSON objects: the library pystac still writes version 1 of the raster extension.

References
----------
.. [1] SpatioTemporal Asset Catalog Specification 1.1.0 (2024), https://github.com/radiantearth/stac-spec.
.. [2] Multiformats: Multihash, 0x12 (sha2-256), length 0x20.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rasterio

from changedetect.crs import crs_name, horizontal_epsg, horizontal_part, to_wkt, vertical_part
from changedetect.io.extent import data_extent, join_boxes
from changedetect.io.netcdf import CLASS_LAYERS
from changedetect.storage import sha256_of_file

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.typing import JSONObject

__all__ = [
    "CATALOGUE_FILE",
    "COLLECTION_FILE",
    "ITEM_FILE",
    "ItemMetadata",
    "build_catalogue",
    "build_collection",
    "build_item",
    "identifier",
    "utc_time",
]

ITEM_FILE = "item.json"
COLLECTION_FILE = "collection.json"
CATALOGUE_FILE = "catalog.json"
#: Lists the other files, so its own checksum cannot be among them.
_MANIFEST_FILE = "manifest.json"

_VERSION = "1.1.0"
_EXTENSIONS = {
    name: f"https://stac-extensions.github.io/{name}/v{version}/schema.json"
    for name, version in (
        ("projection", "2.0.0"),
        ("raster", "2.0.0"),
        ("file", "2.1.0"),
        ("processing", "1.2.0"),
        ("classification", "2.0.0"),
    )
}
_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_GEOJSON = "application/geo+json"
_JSON = "application/json"
#: Media type and roles of an asset by the suffix of its file.
_KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    ".tif": (_COG, ("data",)),
    ".vrt": ("application/xml", ("data", "visual")),
    ".nc": ("application/netcdf", ("data",)),
    ".gpkg": ("application/geopackage+sqlite3", ("data",)),
    ".qml": ("application/xml", ("metadata", "style")),
    ".json": (_JSON, ("metadata",)),
    ".csv": ("text/csv", ("metadata",)),
    ".html": ("text/html", ("metadata", "overview")),
    ".png": ("image/png", ("overview",)),
}
_TITLES = {
    "change": "all layers of the change",
    "surface": "all layers of the surface",
    "dod_significant": "change of elevation, 0 where below the level of detection",
    "objects": "objects of change",
    "summary": "areas, volumes and statistics",
    "manifest": "checksums and lineage",
    "report": "report",
}
_STATISTICS = {
    "minimum": "STATISTICS_MINIMUM",
    "maximum": "STATISTICS_MAXIMUM",
    "mean": "STATISTICS_MEAN",
    "stddev": "STATISTICS_STDDEV",
    "valid_percent": "STATISTICS_VALID_PERCENT",
}


@dataclass(frozen=True, kw_only=True)
class ItemMetadata:
    """
    What an item says beyond its files.

    Attributes
    ----------
    programme : str
    epochs : tuple of str
        One epoch, or the earlier and the later.
    datetimes : tuple of str
        Of these epochs, ISO 8601; UTC where no offset is given.
    created : str
        Time of writing, ISO 8601.
    run_id, config_sha256, software_version : str
    lineage : str
        How the product was made, in words.
    derived_from : tuple of str
        Epochs of the programme whose items this one derives from.
    is_listed : bool
        Whether the folder belongs to the programme's catalogue, and so links to it.
    """

    programme: str
    epochs: tuple[str, ...]
    datetimes: tuple[str, ...]
    created: str
    run_id: str
    config_sha256: str
    software_version: str
    lineage: str
    derived_from: tuple[str, ...] = ()
    is_listed: bool = True

    @property
    def title(self) -> str:
        """For people."""
        if len(self.epochs) == 1:
            return f"Surface of {self.epochs[0]}"
        return f"Change of elevation from {self.epochs[0]} to {self.epochs[1]}"


def identifier(programme: str, epochs: Sequence[str] = ()) -> str:
    """
    Id of a programme's collection, or of the item of one epoch or of two.

    Examples
    --------
    >>> identifier("North slope", ["2023-05-01", "2024-05-01"])
    'North-slope-2023-05-01-2024-05-01-dod'
    """
    parts = [programme, *epochs, *(["dod"] if len(epochs) == 2 else [])]
    return re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts)).strip("-") or "programme"


def utc_time(text: str) -> str:
    """
    Time as RFC 3339 wants it.

    Examples
    --------
    >>> utc_time("2024-05-01"), utc_time("2024-05-01T14:30+02:00")
    ('2024-05-01T00:00:00Z', '2024-05-01T12:30:00Z')
    """
    time = datetime.fromisoformat(text)
    time = time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    return time.isoformat().replace("+00:00", "Z")


def build_item(folder: Path, grid: Grid, layer: str, meta: ItemMetadata) -> JSONObject:
    """
    Describe a folder of products.

    Parameters
    ----------
    folder : path
        All files but the item and the manifest are there.
    grid : Grid
        Of its rasters.
    layer : str
        Raster whose valid cells are the footprint.
    meta : ItemMetadata

    Returns
    -------
    item : dict
        STAC Item: a GeoJSON Feature in WGS 84.

    Notes
    -----
    ``proj:code`` is the horizontal CRS, which ``proj:bbox``, ``proj:shape`` and ``proj:transform`` are in; the vertical
    one stands in ``changedetect:vertical_crs``, since compound CRSs have no code.
    """
    with rasterio.open(folder / f"{layer}.tif") as raster:
        extent = data_extent(np.isfinite(raster.read(1)), grid)
    assets = dict(_assets(folder, grid))
    used = ["projection", "raster", "file", "processing"]
    used += ["classification"] if any("classification:classes" in asset for asset in assets.values()) else []
    item: JSONObject = {
        "type": "Feature",
        "stac_version": _VERSION,
        "stac_extensions": [_EXTENSIONS[name] for name in used],
        "id": identifier(meta.programme, meta.epochs),
        "geometry": extent.geometry,
        "bbox": None if extent.bbox is None else list(extent.bbox),
        "properties": _properties(grid, meta),
        "links": _item_links(meta),
        "assets": assets,
    }
    if extent.bbox is None:
        del item["bbox"]  # not allowed where the geometry is null
    if meta.is_listed:
        item["collection"] = identifier(meta.programme)
    return item


def _properties(grid: Grid, meta: ItemMetadata) -> JSONObject:
    times = [utc_time(text) for text in meta.datetimes]
    created = utc_time(meta.created)
    when: JSONObject = {"datetime": times[0]}
    if len(times) == 2:
        when = {"datetime": None, "start_datetime": times[0], "end_datetime": times[1]}
    epochs = {"changedetect:epoch": meta.epochs[0]}
    if len(meta.epochs) == 2:
        epochs = {"changedetect:epoch_earlier": meta.epochs[0], "changedetect:epoch_later": meta.epochs[1]}
    return {
        "title": meta.title,
        "description": f"{meta.title} of the monitoring programme {meta.programme}",
        **when,
        "created": created,
        "updated": created,
        "gsd": grid.resolution,
        **_projection(grid),
        "changedetect:vertical_crs": vertical_part(grid.crs),
        "processing:software": {"changedetect": meta.software_version},
        "processing:datetime": created,
        "processing:lineage": meta.lineage,
        "changedetect:programme": meta.programme,
        **epochs,
        "changedetect:run_id": meta.run_id,
        "changedetect:config_sha256": meta.config_sha256,
    }


def _projection(grid: Grid) -> JSONObject:
    """Place of the rasters; a horizontal CRS without a code stands as WKT2."""
    epsg = horizontal_epsg(grid.crs) if horizontal_part(grid.crs).startswith("EPSG:") else None
    west, east, south, north = grid.region
    place: JSONObject = {"proj:code": None if epsg is None else f"EPSG:{epsg}"}
    if epsg is None:
        place["proj:wkt2"] = to_wkt(horizontal_part(grid.crs))
    return place | {
        "proj:bbox": [west, south, east, north],
        "proj:shape": list(grid.shape),
        "proj:transform": list(grid.transform),
    }


def _item_links(meta: ItemMetadata) -> list[JSONObject]:
    links = []
    if meta.is_listed:
        links += [
            {"rel": "root", "href": f"../{CATALOGUE_FILE}", "type": _JSON, "title": meta.programme},
            {"rel": "parent", "href": f"../{COLLECTION_FILE}", "type": _JSON, "title": meta.programme},
            {"rel": "collection", "href": f"../{COLLECTION_FILE}", "type": _JSON, "title": meta.programme},
        ]
        links += [
            {
                "rel": "derived_from",
                "href": f"../{epoch}/{ITEM_FILE}",
                "type": _GEOJSON,
                "title": f"Surface of {epoch}",
            }
            for epoch in meta.derived_from
        ]
    return links


def _assets(folder: Path, grid: Grid) -> Iterator[tuple[str, JSONObject]]:
    """Every file of the folder by a key of its own."""
    paths = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name not in {ITEM_FILE, _MANIFEST_FILE}]
    for path in paths:
        name = path.relative_to(folder).as_posix()
        media, roles = _KINDS.get(path.suffix.lower(), ("application/octet-stream", ("metadata",)))
        title = _TITLES.get(path.stem, path.stem.replace("_", " "))
        asset: JSONObject = {"href": f"./{name}", "type": media, "title": title, "roles": list(roles)}
        if path.suffix == ".tif":
            asset |= _raster(path, grid)
        elif path.suffix == ".qml":
            asset["title"] = f"QGIS style of {path.stem}"
        size = path.stat().st_size
        asset |= {"file:size": size, "file:checksum": f"1220{sha256_of_file(path)}"}
        yield _key(path, folder), asset
    yield (
        "manifest",
        {
            "href": f"./{_MANIFEST_FILE}",
            "type": _JSON,
            "title": _TITLES["manifest"],
            "roles": ["metadata"],
        },
    )


def _key(path: Path, folder: Path) -> str:
    """Name of the layer; styles and files of the same name with another suffix say what they are."""
    stem = path.relative_to(folder).with_suffix("").as_posix().replace("/", "_")
    if path.suffix == ".qml":
        return f"{stem}_style"
    return stem if path.suffix in {".tif", ".vrt", ".nc", ".gpkg"} or stem == "summary" else path.name


def _raster(path: Path, grid: Grid) -> JSONObject:
    """Band of a raster in the form of STAC 1.1, and its classes."""
    with rasterio.open(path) as raster:
        description, unit, kind = raster.descriptions[0], raster.units[0], raster.dtypes[0]
        nodata, tags = raster.nodata, raster.tags(1)
    band: JSONObject = {"name": path.stem, "description": description, "data_type": kind}
    if nodata is not None:
        band["nodata"] = "nan" if math.isnan(nodata) else int(nodata)
    if unit and unit != "1":
        band["unit"] = unit
    found = {name: float(tags[key]) for name, key in _STATISTICS.items() if key in tags}
    if path.stem not in CLASS_LAYERS and found:
        band["statistics"] = found
    band |= {"raster:sampling": "area", "raster:spatial_resolution": grid.resolution}
    asset: JSONObject = {"title": description, "bands": [band]}
    if path.stem in CLASS_LAYERS:
        asset["classification:classes"] = [
            {
                "value": c.value,
                "name": c.meaning,
                "description": c.label,
                "color_hint": "".join(f"{channel:02X}" for channel in c.colour[:3]),
            }
            for c in CLASS_LAYERS[path.stem]
        ]
    return asset


def build_collection(programme: str, crs: str, items: Mapping[str, JSONObject], *, description: str = "") -> JSONObject:
    """
    Describe all products of a programme.

    Parameters
    ----------
    programme : str
    crs : str
        Of the programme.
    items : mapping of folder name to item
        In the order in which they are to be listed; at least one.
    description : str

    Returns
    -------
    collection : dict
        STAC Collection. Its times follow from the items, so the same items give the same document.
    """
    boxes: list[tuple[float, float, float, float]] = [tuple(i["bbox"]) for i in items.values() if "bbox" in i]
    properties = [item["properties"] for item in items.values()]
    starts = [p["datetime"] or p["start_datetime"] for p in properties]
    ends = [p["datetime"] or p["end_datetime"] for p in properties]
    links = [
        {"rel": "root", "href": f"./{CATALOGUE_FILE}", "type": _JSON, "title": programme},
        {"rel": "parent", "href": f"./{CATALOGUE_FILE}", "type": _JSON, "title": programme},
    ]
    links += [
        {"rel": "item", "href": f"./{folder}/{ITEM_FILE}", "type": _GEOJSON, "title": item["properties"]["title"]}
        for folder, item in items.items()
    ]
    text = description or (
        f"Surfaces and changes of elevation of the monitoring programme {programme}, in {crs_name(crs)}, each with its "
        "standard deviation."
    )
    return {
        "type": "Collection",
        "stac_version": _VERSION,
        "stac_extensions": [],
        "id": identifier(programme),
        "title": programme,
        "description": text,
        "keywords": ["terrain", "elevation", "change detection", "DEM of difference"],
        "license": "other",
        "extent": {
            "spatial": {"bbox": [list(join_boxes(boxes) or (-180.0, -90.0, 180.0, 90.0))]},
            "temporal": {"interval": [[min(starts), max(ends)]]},
        },
        "created": min(p["created"] for p in properties),
        "updated": max(p["updated"] for p in properties),
        "summaries": {
            "proj:code": sorted({p["proj:code"] for p in properties if p["proj:code"]}),
            "gsd": sorted({p["gsd"] for p in properties}),
            "changedetect:vertical_crs": sorted({str(p["changedetect:vertical_crs"]) for p in properties}),
        },
        "item_assets": _item_assets(items),
        "links": links,
    }


def _item_assets(items: Mapping[str, JSONObject]) -> JSONObject:
    """What assets items have, without what differs from item to item."""
    found: dict[str, Any] = {}
    for item in items.values():
        for key, asset in item["assets"].items():
            found.setdefault(key, {name: asset[name] for name in ("title", "type", "roles")})
    return dict(sorted(found.items()))


def build_catalogue(programme: str) -> JSONObject:
    """
    Root of a programme's catalogue: one collection.

    Returns
    -------
    catalogue : dict
        STAC Catalog.
    """
    return {
        "type": "Catalog",
        "stac_version": _VERSION,
        "id": f"{identifier(programme)}-catalogue",
        "title": programme,
        "description": f"Products of the monitoring programme {programme}.",
        "links": [
            {"rel": "root", "href": f"./{CATALOGUE_FILE}", "type": _JSON, "title": programme},
            {"rel": "child", "href": f"./{COLLECTION_FILE}", "type": _JSON, "title": programme},
        ],
    }
