"""Differences of two epochs: change, its standard deviation, significance and volumes."""

from changedetect.differencing.maps import ChangeMaps
from changedetect.differencing.pair import difference_models
from changedetect.differencing.summary import summarise, systematic_offset

__all__ = ["ChangeMaps", "difference_models", "summarise", "systematic_offset"]
