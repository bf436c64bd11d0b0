"""The marker of the tests that need QGIS, which few machines have."""

from __future__ import annotations


def pytest_configure(config):
    config.addinivalue_line("markers", "qgis: opens products in QGIS; needs Debian's python3-qgis")
