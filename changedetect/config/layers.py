"""Merging the layers of settings, remembering where each value came from."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, cast

from pydantic import ValidationError
from pydantic_core import ErrorDetails

import changedetect
from changedetect.config.schema import KEYS, PROGRAMME_FILE, SECTIONS, Key, ProgrammeConfig
from changedetect.config.toml import describe_unknown_key, read_toml
from changedetect.errors import ConfigError

__all__ = ["LoadedConfig", "load_config", "profile_names"]

ENVIRONMENT_PREFIX = "CHANGEDETECT_"


def _config_directory() -> Path:
    """Return the folder of default.toml: inside an installed wheel, or `configs/` of a checkout."""
    package = Path(changedetect.__file__).parent
    installed = package / "_configs"
    return installed if installed.is_dir() else package.parent / "configs"


def profile_names() -> list[str]:
    """Names of the profiles that come with the software."""
    return sorted(path.stem for path in _config_directory().glob("*.toml") if path.stem != "default")


def _line_of(path: Path | None, section: str, key: str) -> str:
    """Return `` (line n)`` where `key` stands in the file, or nothing where it cannot be told."""
    if path is None:
        return ""
    here = ""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if header := re.match(r"\s*\[\s*([\w.\-]+)\s*\]", line):
            here = header.group(1)
            if section == "" and here == key:
                return f" (line {number})"
        elif here == section and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", line):
            return f" (line {number})"
    return ""


@dataclass(frozen=True)
class _Layer:
    """One source of settings: nested values as read, a name for people, the file if it is one."""

    source: str
    values: Mapping[str, Any]
    path: Path | None = None

    def leaves(self) -> dict[str, Any]:
        """Return dotted key -> value; unknown keys and tables in the wrong place are refused."""
        found: dict[str, Any] = {}
        for key, value in self.values.items():
            if key not in SECTIONS:
                found[self._known("", key).dotted] = value
            elif isinstance(value, Mapping):
                found |= {self._known(key, name).dotted: leaf for name, leaf in value.items()}
            else:
                msg = f"{self.source}{_line_of(self.path, '', key)}: '{key}' is a section, write [{key}]."
                raise ConfigError(msg)
        return found

    def _known(self, section: str, name: str) -> Key:
        key = KEYS.get(f"{section}.{name}" if section else name)
        if key is not None and key.section == section:
            return key
        allowed = [key.name for key in KEYS.values() if key.section == section] + ([] if section else [*SECTIONS])
        elsewhere = [key for key in KEYS.values() if key.name == name]
        place = f"section [{section}]" if section else "the top level"
        msg = f"{self.source}{_line_of(self.path, section, name)}: unknown key '{name}' in {place}."
        if elsewhere:
            home = elsewhere[0].section
            msg += f" It belongs in {f'section [{home}]' if home else 'the top level, above the first section'}."
            raise ConfigError(msg)
        raise ConfigError(msg + describe_unknown_key(name, allowed))


def _file_layer(path: Path, source: str | None = None) -> _Layer:
    return _Layer(source=source or str(path), values=read_toml(path), path=path)


def _environment_layers(environment: Mapping[str, str]) -> list[_Layer]:
    """
    Return one layer per variable that names a setting, so that messages name the variable.

    Other variables with the prefix are ignored: they may belong to other software or to other parts of this one.
    """
    variables = {key: ENVIRONMENT_PREFIX + dotted.replace(".", "__").upper() for dotted, key in KEYS.items()}
    return [
        _single_value_layer(f"environment {variable}", key, _parse_text(key, environment[variable]))
        for key, variable in variables.items()
        if variable in environment
    ]


def _flag_layers(flags: Mapping[str, Any]) -> list[_Layer]:
    return [
        _single_value_layer(f"flag --{KEYS[dotted].name.replace('_', '-')}", KEYS[dotted], value)
        for dotted, value in flags.items()
        if value is not None
    ]


def _single_value_layer(source: str, key: Key, value: Any) -> _Layer:
    values = {key.name: value}
    return _Layer(source, {key.section: values} if key.section else values)


def _parse_text(key: Key, text: str) -> Any:
    """Read the text of an environment variable as a TOML value; text settings and bare words stay text."""
    if key.is_text:
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


@dataclass(frozen=True)
class LoadedConfig:
    """
    Settings and, for each dotted key, where its value came from.

    Attributes
    ----------
    config : ProgrammeConfig
    sources : mapping of dotted key ("resolution", "lwpr.activation_threshold") to a file, variable or flag
    """

    config: ProgrammeConfig
    sources: Mapping[str, str]

    def items(self) -> Iterator[tuple[str, Any, str]]:
        """Yield (dotted key, value, source) in the order of the file."""
        for dotted, key in KEYS.items():
            owner = getattr(self.config, key.section) if key.section else self.config
            yield dotted, getattr(owner, key.name), self.sources[dotted]


def load_config(
    directory: Path,
    *,
    config_files: Sequence[Path] = (),
    environment: Mapping[str, str] | None = None,
    flags: Mapping[str, Any] | None = None,
    programme: Mapping[str, Any] | None = None,
) -> LoadedConfig:
    """
    Merge all layers of settings of the programme in `directory`.

    Parameters
    ----------
    directory : Path
        Programme folder with a `programme.toml`.
    config_files : sequence of Path
        Files given with ``--config``, weakest first.
    environment : mapping, optional
        Environment variables; those of the process by default.
    flags : mapping of dotted key to value, optional
        Command-line flags; None values are left out.
    programme : mapping, optional
        What `programme.toml` is going to say, before there is one.

    Returns
    -------
    LoadedConfig

    Raises
    ------
    ConfigError
        A key is unknown, a value is of the wrong kind or out of range; the message names source, key and fix.
    MissingInputError
        A file does not exist.
    """
    path = directory / PROGRAMME_FILE
    strong = [_file_layer(path) if programme is None else _Layer(PROGRAMME_FILE, programme)]
    strong += [_file_layer(path) for path in config_files]
    strong += _environment_layers(os.environ if environment is None else environment)
    strong += _flag_layers(flags or {})
    defaults = _file_layer(_config_directory() / "default.toml", "default.toml")

    values = {dotted: key.default for dotted, key in KEYS.items() if key.default is not MISSING}
    origin = dict.fromkeys(values, _Layer("built-in", {}))
    for layer in [defaults, *_profile_layers(strong), *strong]:
        for dotted, value in layer.leaves().items():
            values[dotted] = _plain(KEYS[dotted], value)
            origin[dotted] = layer
    if not values["name"]:
        values["name"] = directory.resolve().name
        origin["name"] = _Layer("folder name", {})
    if "crs" not in values:
        msg = (
            f"'{path}' names no crs. Add a line such as crs = \"EPSG:32632+5773\" "
            "(a projected CRS in metres, and the vertical one after the plus)."
        )
        raise ConfigError(msg)
    return LoadedConfig(_build(values, origin), {dotted: layer.source for dotted, layer in origin.items()})


def _profile_layers(strong: Sequence[_Layer]) -> list[_Layer]:
    """Return the layer of the profile that the strongest of the given layers names, if any does."""
    named = [(layer, layer.values["profile"]) for layer in strong if "profile" in layer.values]
    if not named or named[-1][1] == "auto":
        return []
    layer, profile = named[-1]
    if profile not in profile_names():
        msg = f"{layer.source}: unknown profile {profile!r}. Choose one of {', '.join(profile_names())}."
        raise ConfigError(msg)
    return [_file_layer(_config_directory() / f"{profile}.toml", f"profile {profile}")]


def _plain(key: Key, value: Any) -> Any:
    if value == "auto" and key.takes_auto:
        return None
    return tuple(value) if isinstance(value, list) else value


def _build(values: Mapping[str, Any], origin: Mapping[str, _Layer]) -> ProgrammeConfig:
    """Construct the frozen settings section by section, turning each violation into a message for people."""
    arguments: dict[str, dict[str, Any]] = {section: {} for section in ("", *SECTIONS)}
    for dotted, value in values.items():
        arguments[KEYS[dotted].section][KEYS[dotted].name] = value
    sections = {section: _construct(owner, section, arguments[section], origin) for section, owner in SECTIONS.items()}
    return cast("ProgrammeConfig", _construct(ProgrammeConfig, "", arguments[""] | sections, origin))


def _construct(owner: type[Any], section: str, arguments: dict[str, Any], origin: Mapping[str, _Layer]) -> Any:
    try:
        return owner(**arguments)
    except ValidationError as error:
        # a union such as float | None reports each branch; the first is the one people mean
        violations = {item["loc"][:1]: _violation(item, section, origin) for item in reversed(error.errors())}
        raise ConfigError("\n".join(reversed(violations.values()))) from error


def _violation(item: ErrorDetails, section: str, origin: Mapping[str, _Layer]) -> str:
    """Say in one line which source set which key to what, and what is allowed."""
    name = str(item["loc"][0]) if item["loc"] else ""
    dotted = f"{section}.{name}" if section else name
    complaint = item["msg"].removeprefix("Value error, ")
    if name == "bounds":
        complaint = "expected four numbers in metres, [west, east, south, north],"
    if dotted not in origin:  # a rule over several keys of one section
        return f"{f'section [{section}]' if section else PROGRAMME_FILE}: {complaint}."
    layer = origin[dotted]
    auto = ' or "auto"' if KEYS[dotted].takes_auto else ""
    place = f"{layer.source}{_line_of(layer.path, section, name)}"
    return f"{place}: {dotted} = {item['input']!r} is not valid: {complaint}{auto}."
