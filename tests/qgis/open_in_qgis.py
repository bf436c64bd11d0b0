"""
Open files in a real QGIS, say what it makes of them, and draw them.

Run by the Python that QGIS was built for: python3 open_in_qgis.py JOB.json, with QT_QPA_PLATFORM=offscreen. JOB.json
holds {"layers": [{"name", "uri", "kind"}], "pictures": {"FILE.png": [names, top first]}, "size": [columns, rows]}; the
answer goes to the file JOB.json names as "answer".
"""

import json
import sys
from pathlib import Path

from qgis.core import (
    QgsApplication,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsProject,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor

#: The paper maps are drawn on: no style has this colour, so cells that show it are transparent.
PAPER = QColor(255, 0, 255)


def crs_of(layer):
    crs = layer.crs()
    return {"authid": crs.authid(), "wkt": crs.toWkt(crs.WKT_PREFERRED), "valid": crs.isValid()}


def raster_of(layer):
    renderer, provider = layer.renderer(), layer.dataProvider()
    found = {
        "renderer": renderer.type(),
        "size": [layer.height(), layer.width()],
        "extent": [getattr(layer.extent(), f)() for f in ("xMinimum", "yMinimum", "xMaximum", "yMaximum")],
        "nodata": provider.sourceHasNoDataValue(1),
        "bands": layer.bandCount(),
        "band": layer.bandName(1),
    }
    if renderer.type() == "singlebandpseudocolor":
        function = renderer.shader().rasterShaderFunction()
        found["limits"] = [renderer.classificationMin(), renderer.classificationMax()]
        found["stops"] = [[i.value, i.color.name(), i.label] for i in function.colorRampItemList()]
    if renderer.type() == "paletted":
        found["classes"] = [[c.value, c.color.name(), c.label] for c in renderer.classes()]
    return found


def vector_of(layer):
    renderer = layer.renderer()
    found = {"renderer": renderer.type(), "features": layer.featureCount()}
    if renderer.type() == "RuleRenderer":
        found["rules"] = [[r.filterExpression(), r.label()] for r in renderer.rootRule().children()]
        found["expressions_valid"] = all(
            not r.filter().hasParserError() for r in renderer.rootRule().children() if r.filter() is not None
        )
        counts = {r.label(): 0 for r in renderer.rootRule().children()}
        for rule in renderer.rootRule().children():
            counts[rule.label()] = sum(1 for _ in layer.getFeatures(rule.filterExpression()))
        found["counts"] = counts
    found["labels"] = layer.labelsEnabled()
    found["label"] = layer.labeling().settings().fieldName if layer.labeling() is not None else ""
    return found


def draw(path, layers, size):
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setBackgroundColor(PAPER)
    settings.setOutputSize(QSize(*size))
    settings.setDestinationCrs(layers[-1].crs())
    extent = QgsRectangle(layers[-1].extent())
    settings.setExtent(extent)
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    errors = [f"{e.layerID}: {e.message}" for e in job.errors()]
    job.renderedImage().save(str(path))
    seen = settings.visibleExtent()
    return {"errors": errors, "extent": [seen.xMinimum(), seen.yMinimum(), seen.xMaximum(), seen.yMaximum()]}


def main(job):
    application = QgsApplication([], False)
    application.initQgis()
    layers, answer = {}, {"layers": {}, "pictures": {}}
    try:
        for wanted in job["layers"]:
            kind = QgsRasterLayer if wanted["kind"] == "raster" else QgsVectorLayer
            provider = "gdal" if wanted["kind"] == "raster" else "ogr"
            layer = kind(wanted["uri"], wanted["name"], provider)
            found = {"valid": layer.isValid(), "error": layer.error().message()}
            if layer.isValid():
                found |= {"crs": crs_of(layer)} | (raster_of(layer) if wanted["kind"] == "raster" else vector_of(layer))
            answer["layers"][wanted["name"]] = found
            layers[wanted["name"]] = layer
            QgsProject.instance().addMapLayer(layer, False)
        for path, names in job["pictures"].items():
            answer["pictures"][path] = draw(path, [layers[name] for name in names], job["size"])
    finally:
        Path(job["answer"]).write_text(json.dumps(answer))
        QgsProject.instance().clear()
        layers.clear()
        application.exitQgis()


main(json.loads(Path(sys.argv[1]).read_text()))
