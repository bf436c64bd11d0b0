"""
The map of significant change: a GDAL virtual raster over the change and its classes.

It holds no data of its own. A cell's value is the change where it exceeds the cell's own level of detection and 0 where
it does not; ground that was not observed twice has no data. So one style shows neutral grey exactly where nothing can
be claimed, which no style of the change alone can.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from changedetect.crs import to_wkt
from changedetect.io.cog import storable_crs
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from changedetect.grid import Grid

__all__ = ["write_significant_change"]

#: Look-up table: class of change to 1 where it is significant, else 0.
_IS_SIGNIFICANT = "0:0,1:1,2:1,3:0"


def write_significant_change(path: Path, grid: Grid, *, description: str, dod: str, change_class: str) -> None:
    """
    Write a virtual raster: the change, and 0 where it lies below the level of detection.

    Parameters
    ----------
    path : path
        With the suffix ``.vrt``.
    grid : Grid
        Of both rasters.
    description : str
        Name of the band.
    dod, change_class : str
        Names of the rasters in the folder of `path`.

    Raises
    ------
    OutputError
        The file cannot be written.

    Notes
    -----
    GDAL's compiled pixel function ``mul`` multiplies the change with a look-up table of the classes; no Python runs
    where the file is opened. NaN stays NaN.
    """
    rows, columns = grid.shape
    a, b, west, d, e, north = grid.transform
    document = ET.Element("VRTDataset", rasterXSize=str(columns), rasterYSize=str(rows))
    ET.SubElement(document, "SRS", dataAxisToSRSAxisMapping="1,2").text = to_wkt(storable_crs(grid.crs))
    ET.SubElement(document, "GeoTransform").text = ", ".join(repr(v) for v in (west, a, b, north, d, e))
    metadata = ET.SubElement(document, "Metadata")
    ET.SubElement(metadata, "MDI", key="AREA_OR_POINT").text = "Area"
    band = ET.SubElement(document, "VRTRasterBand", dataType="Float32", band="1", subClass="VRTDerivedRasterBand")
    ET.SubElement(band, "Description").text = description
    ET.SubElement(band, "UnitType").text = "m"
    ET.SubElement(band, "NoDataValue").text = "nan"
    ET.SubElement(band, "PixelFunctionType").text = "mul"
    ET.SubElement(band, "SourceTransferType").text = "Float32"
    extent = {"xOff": "0", "yOff": "0", "xSize": str(columns), "ySize": str(rows)}
    for name, table in ((dod, None), (change_class, _IS_SIGNIFICANT)):
        source = ET.SubElement(band, "SimpleSource" if table is None else "ComplexSource")
        ET.SubElement(source, "SourceFilename", relativeToVRT="1").text = name
        ET.SubElement(source, "SourceBand").text = "1"
        ET.SubElement(source, "SrcRect", extent)
        ET.SubElement(source, "DstRect", extent)
        if table is not None:
            ET.SubElement(source, "LUT").text = table
    ET.indent(document)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(ET.tostring(document, encoding="unicode") + "\n", encoding="utf-8")
