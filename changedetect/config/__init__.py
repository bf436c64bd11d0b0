"""
Settings of a monitoring programme: frozen, ranges declared once, unknown keys refused.

Layers, weakest first: the defaults of the fields below, `configs/default.toml`, the profile's file, the
programme's `programme.toml`, files given with ``--config``, environment variables ``CHANGEDETECT_KEY`` or
``CHANGEDETECT_SECTION__KEY``, command-line flags. `load_config` merges them and remembers where each value came
from. A key that may be left to the data takes the word ``"auto"`` (None in Python).
"""

from __future__ import annotations

from changedetect.config.layers import LoadedConfig, load_config, profile_names
from changedetect.config.schema import (
    FORMAT_VERSION,
    PROGRAMME_FILE,
    AdaptiveConfig,
    CoregistrationConfig,
    DifferencingConfig,
    LWPRConfig,
    MachineConfig,
    ProgrammeConfig,
)
from changedetect.config.toml import build_from_table, format_toml_value, read_toml

__all__ = [
    "FORMAT_VERSION",
    "PROGRAMME_FILE",
    "AdaptiveConfig",
    "CoregistrationConfig",
    "DifferencingConfig",
    "LWPRConfig",
    "LoadedConfig",
    "MachineConfig",
    "ProgrammeConfig",
    "build_from_table",
    "format_toml_value",
    "load_config",
    "profile_names",
    "read_toml",
]
