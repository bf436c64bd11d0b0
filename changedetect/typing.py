"""Aliases for arrays and small tuples used in signatures."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["BoolArray", "Coordinates", "FloatArray", "IntArray", "JSONObject", "Region"]

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
#: (easting, northing), each of shape (n,), metres in the programme's CRS.
Coordinates: TypeAlias = tuple[FloatArray, FloatArray]
#: (west, east, south, north), metres.
Region: TypeAlias = tuple[float, float, float, float]
JSONObject: TypeAlias = dict[str, Any]
