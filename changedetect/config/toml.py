"""TOML in and out, with messages that name the file."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from changedetect.errors import ConfigError, MissingInputError

__all__ = ["build_from_table", "describe_unknown_key", "format_toml_value", "read_toml"]

T = TypeVar("T")


def read_toml(path: Path) -> dict[str, Any]:
    """
    Read a TOML file.

    Raises
    ------
    MissingInputError
        There is no such file.
    ConfigError
        The text is no TOML; the message carries line and column.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        msg = f"There is no file '{path}'."
        raise MissingInputError(msg) from error
    except (OSError, UnicodeDecodeError) as error:
        msg = f"'{path}' cannot be read as UTF-8 text: {error}."
        raise ConfigError(msg) from error
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        msg = f"'{path}' is not valid TOML: {error}."
        raise ConfigError(msg) from error


def format_toml_value(value: Any) -> str:
    """
    Write a value as TOML.

    Examples
    --------
    >>> format_toml_value((0.5, 2)), format_toml_value(True), format_toml_value(None)
    ('[0.5, 2]', 'true', '"auto"')
    """
    if value is None:
        return '"auto"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, except that TOML wants DEL escaped too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return f"[{', '.join(format_toml_value(item) for item in value)}]"
    return repr(value)


def describe_unknown_key(name: str, allowed: Iterable[str]) -> str:
    """Return the sentences that follow "unknown key": the closest valid key, and all that are allowed."""
    allowed = list(allowed)
    close = difflib.get_close_matches(name, allowed, n=1)
    meant = f" Did you mean '{close[0]}'?" if close else ""
    return f"{meant} Allowed there: {', '.join(allowed)}."


def build_from_table(owner: type[T], table: Mapping[str, Any], place: str, **known: Any) -> T:
    """
    Construct a frozen value from a table of a TOML file.

    Parameters
    ----------
    owner : pydantic dataclass
    table : mapping
    place : str
        File, and table in it, for messages.
    **known
        Fields that the file may not state.

    Raises
    ------
    ConfigError
        A key is unknown or missing, or a value is not allowed.
    """
    allowed = [field.name for field in fields(owner) if field.name not in known]  # type: ignore[arg-type]
    for key in table:
        if key not in allowed:
            msg = f"{place}: unknown key '{key}'.{describe_unknown_key(key, allowed)}"
            raise ConfigError(msg)
    try:
        return owner(**table, **known)
    except ValidationError as error:
        item = error.errors()[0]
        key = ".".join(str(part) for part in item["loc"])
        given = f" = {item['input']!r}" if item["type"] != "missing" else ""
        msg = f"{place}: {key}{given} is not valid: {item['msg']}."
        raise ConfigError(msg) from error
