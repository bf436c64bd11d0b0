"""
The command-line reference, made from the commands themselves.

``python -m changedetect.cli.reference FILE`` writes it; with ``--check`` it says whether FILE is current.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

import typer
from typer.models import ArgumentInfo, OptionInfo

from changedetect.cli.app import app
from changedetect.cli.session import COMMON_OPTIONS

__all__ = ["main", "reference"]

_HEAD = """\
# Command-line reference

Made from the code by `make docs`; do not edit.

Every command prints one JSON document on stdout with `--json` (its `format_version` changes when keys go or change
their meaning), logs on stderr, and ends with one of these exit codes:

| code | meaning |
|---|---|
| 0 | done, or nothing due |
| 1 | unexpected failure: a bug |
| 2 | usage |
| 10 | only `update --exit-code`: significant change found |
| 65 | bad data: a source, a CRS, a vertical datum, a stored model |
| 66 | missing input |
| 73 | an output cannot be written, or exists |
| 74 | input or output failed |
| 75 | try again later: the programme is locked |
| 78 | configuration |
| 130 | interrupted |
"""


def reference() -> str:
    """Return the reference as Markdown."""
    lines = [_HEAD]
    commands = dict(_commands(app, ""))
    for name, function in commands.items():
        lines += _section(name, function)
    common = [item for item in _parameters(next(iter(commands.values()))) if item.name in COMMON_OPTIONS]
    lines += ["## Options of every command", "", *_table(common)]
    return "\n".join(lines).rstrip() + "\n"


def _commands(group: typer.Typer, prefix: str) -> Iterator[tuple[str, Callable[..., Any]]]:
    for command in group.registered_commands:
        if command.callback is not None:
            yield f"{prefix}{command.name}", command.callback
    for inner in group.registered_groups:
        if inner.typer_instance is not None:
            yield from _commands(inner.typer_instance, f"{prefix}{inner.name} ")


def _section(name: str, function: Callable[..., Any]) -> list[str]:
    parameters = [item for item in _parameters(function) if item.name not in COMMON_OPTIONS]
    arguments = [item for item in parameters if isinstance(_described(item), ArgumentInfo)]
    options = [item for item in parameters if isinstance(_described(item), OptionInfo)]
    usage = " ".join(
        ["changedetect", name, *(_described(item).metavar or item.name for item in arguments), "[OPTIONS]"]
    )
    lines = [f"## {name}", "", f"`{usage}`", "", *_description(inspect.getdoc(function) or ""), ""]
    lines += ["| argument | meaning |", "|---|---|"]
    lines += [f"| `{_described(item).metavar}` | {_cell(_described(item).help)} |" for item in arguments]
    return [*lines, "", *_table(options), ""]


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    return list(inspect.signature(function).parameters.values())


def _table(options: Sequence[inspect.Parameter]) -> list[str]:
    if not options:
        return []
    lines = ["| option | value | meaning | default |", "|---|---|---|---|"]
    for item in options:
        info = _described(item)
        names = ", ".join(f"`{text}`" for text in (info.default, *(info.param_decls or ())) if text)
        lines.append(f"| {names} | {_value(item)} | {_cell(info.help)} | {_default(item)} |")
    return lines


def _described(parameter: inspect.Parameter) -> Any:
    return get_args(parameter.annotation)[1]


def _description(text: str) -> list[str]:
    """Set the examples of a docstring as code."""
    about, _, examples = text.partition("For example:")
    commands = [line.strip() for line in examples.splitlines() if line.strip()]
    return [" ".join(about.split()), "", "```", *commands, "```"]


def _value(parameter: inspect.Parameter) -> str:
    kind = get_args(parameter.annotation)[0]
    kinds = [item for item in (get_args(kind) if isinstance(kind, UnionType) else (kind,)) if item is not NoneType]
    if kinds == [bool]:
        return ""
    if isinstance(kinds[0], type) and issubclass(kinds[0], StrEnum):
        return _cell(", ".join(f"`{choice.value}`" for choice in kinds[0]))
    names = {str: "text", int: "whole number", float: "number", Path: "path"}
    repeated = get_origin(kinds[0]) is list
    base = get_args(kinds[0])[0] if repeated else kinds[0]
    return _cell(_described(parameter).metavar or names.get(base, "value")) + (", repeated" if repeated else "")


def _default(parameter: inspect.Parameter) -> str:
    if parameter.default is inspect.Parameter.empty:
        return "required"
    return "" if parameter.default in (None, False, "") else f"`{parameter.default}`"


def _cell(text: str | None) -> str:
    return (text or "").replace("|", "\\|")


def main(arguments: Sequence[str]) -> int:
    """Write or check a file; return the exit code."""
    paths = [Path(argument) for argument in arguments if argument != "--check"]
    if len(paths) != 1:
        sys.stderr.write("usage: python -m changedetect.cli.reference [--check] FILE\n")
        return 2
    text = reference()
    if "--check" not in arguments:
        paths[0].parent.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(text, encoding="utf-8")
        return 0
    if paths[0].is_file() and paths[0].read_text(encoding="utf-8") == text:
        return 0
    sys.stderr.write(f"{paths[0]} is not current. Run: make docs\n")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
