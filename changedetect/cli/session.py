"""What all commands share: their common options, their one JSON document, logging to stderr, progress."""

from __future__ import annotations

import inspect
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_type_hints

import typer

import changedetect

if TYPE_CHECKING:
    from rich.console import RenderableType

    from changedetect.catalogue import Programme
    from changedetect.pipeline.update import Progress
    from changedetect.typing import JSONObject

__all__ = ["COMMON_OPTIONS", "JSON_FORMAT_VERSION", "Outcome", "Session", "command", "print_error", "wants_json"]

#: Version of the documents that --json prints.
JSON_FORMAT_VERSION = 1


class LogFormat(StrEnum):
    """Shape of the log on stderr; `auto` is `journal` under systemd and `text` elsewhere."""

    AUTO = "auto"
    TEXT = "text"
    JSON = "json"
    JOURNAL = "journal"


@dataclass(frozen=True)
class Session:
    """
    The options every command has.

    Attributes
    ----------
    command : str
        Name of the command, for documents and manifests.
    is_json, is_quiet, is_verbose : bool
    log_format : LogFormat
    config_files : tuple of Path
        Files of settings given with ``--config``, weakest first.
    """

    command: str
    is_json: bool = False
    is_quiet: bool = False
    is_verbose: bool = False
    log_format: LogFormat = LogFormat.AUTO
    config_files: tuple[Path, ...] = ()

    def open(self, directory: Path, **flags: Any) -> Programme:
        """Open a programme; `flags` are settings by key, with ``__`` for the dot, None where not given."""
        from changedetect.catalogue import Programme

        dotted = {key.replace("__", "."): value for key, value in flags.items()}
        return Programme.open(directory, config_files=self.config_files, flags=dotted)

    @contextmanager
    def progress(self) -> Iterator[Progress | None]:
        """Give a callback that draws a progress bar on stderr; None where nobody would see it."""
        from rich.console import Console

        console = Console(stderr=True)
        if self.is_json or self.is_quiet or not console.is_terminal:
            yield None
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("", total=None)

            def on_progress(done: int, total: int, label: str) -> None:
                bar.update(task, completed=done, total=total, description=label)

            yield on_progress


@dataclass(frozen=True)
class Outcome:
    """
    What a command found or did.

    Attributes
    ----------
    document : dict
        For ``--json``; format version, command and software version are added to it.
    text : list of str or rich renderable
        For people, on stdout; not printed with ``--json`` or ``--quiet``.
    exit_code : int
    """

    document: JSONObject
    text: list[RenderableType] = field(default_factory=list)
    exit_code: int = 0


COMMON_OPTIONS = {
    "json_output": Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")],
    "quiet": Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")],
    "verbose": Annotated[bool, typer.Option("--verbose", "-v", help="Log every step.")],
    "log_format": Annotated[LogFormat, typer.Option("--log-format", help="Shape of the log on stderr.")],
    "config": Annotated[
        list[Path] | None, typer.Option("--config", help="File of settings on top of programme.toml; may be repeated.")
    ],
}
_COMMON_DEFAULTS: dict[str, Any] = {
    "json_output": False,
    "quiet": False,
    "verbose": False,
    "log_format": LogFormat.AUTO,
    "config": None,
}


def command(app: typer.Typer, name: str, prefix: str = "") -> Callable[[Callable[..., Outcome]], Callable[..., int]]:
    """
    Make a function a command: its first parameter receives the `Session`, its `Outcome` is printed.

    Parameters
    ----------
    app : typer.Typer
    name : str
    prefix : str
        Name of the group the command belongs to, followed by a space.
    """

    def decorate(function: Callable[..., Outcome]) -> Callable[..., int]:
        hints = get_type_hints(function, include_extras=True)
        own = list(inspect.signature(function).parameters.values())[1:]

        def run(**values: Any) -> int:
            common = {key: values.pop(key) for key in COMMON_OPTIONS}
            session = Session(
                command=prefix + name,
                is_json=common["json_output"],
                is_quiet=common["quiet"],
                is_verbose=common["verbose"],
                log_format=common["log_format"],
                config_files=tuple(common["config"] or ()),
            )
            with _logging(session):
                try:
                    outcome = function(session, **values)
                except KeyboardInterrupt as error:  # Typer would end with 130 and no word
                    raise typer.Abort from error
            _print_outcome(session, outcome)
            return outcome.exit_code

        parameters = [parameter.replace(annotation=hints[parameter.name]) for parameter in own]
        parameters += [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=_COMMON_DEFAULTS[key], annotation=annotation)
            for key, annotation in COMMON_OPTIONS.items()
        ]
        parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
        run.__signature__ = inspect.Signature(parameters, return_annotation=int)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        run.__doc__ = function.__doc__
        run.__name__ = function.__name__
        app.command(name)(run)
        return run

    return decorate


def wants_json(arguments: Sequence[str]) -> bool:
    """Whether a command line asks for JSON, even one that cannot be parsed."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return "--json" in options


def print_error(error: BaseException, exit_code: int, *, is_json: bool) -> int:
    """Print an error on stderr, as a JSON document on stdout too if asked, and return the exit code."""
    message = str(error) or type(error).__name__
    sys.stderr.write(f"Error: {message}\n")
    if is_json:
        described = {"class": type(error).__name__, "message": message, "exit_code": exit_code}
        _print_json({"error": described, "exit_code": exit_code})
    return exit_code


def _print_outcome(session: Session, outcome: Outcome) -> None:
    if session.is_json:
        _print_json({"command": session.command, **outcome.document, "exit_code": outcome.exit_code})
    elif not session.is_quiet:
        from rich.console import Console

        console = Console(soft_wrap=True, highlight=False)
        if not console.is_terminal:
            console.width = 200  # a file or pipe has no width; do not cut paths
        for part in outcome.text:
            console.print(part, markup=False)


def _print_json(document: JSONObject) -> None:
    head = {"format_version": JSON_FORMAT_VERSION, "software_version": changedetect.__version__}
    text = json.dumps(head | document, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write(text + "\n")


@contextmanager
def _logging(session: Session) -> Iterator[None]:
    """Log to stderr while a command runs: the steps where no progress bar shows them, else warnings alone."""
    log_format = session.log_format
    if log_format is LogFormat.AUTO:
        log_format = LogFormat.JOURNAL if "JOURNAL_STREAM" in os.environ else LogFormat.TEXT
    level = logging.WARNING if session.is_quiet or sys.stderr.isatty() else logging.INFO
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Formatter(log_format))
    root, own = logging.getLogger(), logging.getLogger("changedetect")
    before = own.level
    own.setLevel(logging.DEBUG if session.is_verbose else level)
    root.addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        root.removeHandler(handler)
        own.setLevel(before)


class _Formatter(logging.Formatter):
    """One line a record, with the run, programme and step it belongs to."""

    _PRIORITY: ClassVar = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}

    def __init__(self, log_format: LogFormat) -> None:
        super().__init__()
        self._log_format = log_format

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        from changedetect.pipeline.manifest import log_context

        message = record.getMessage()
        if record.exc_info:
            message += "\n" + self.formatException(record.exc_info)
        moment = datetime.fromtimestamp(record.created, UTC)
        if self._log_format is LogFormat.JSON:
            entry = {"time": moment.isoformat(), "level": record.levelname, "logger": record.name, "message": message}
            return json.dumps(entry | log_context(), ensure_ascii=False)
        context = "".join(f" {key}={value}" for key, value in log_context().items() if key != "programme")
        if self._log_format is LogFormat.JOURNAL:
            prefix = f"<{self._PRIORITY.get(record.levelno, 6)}>"
            return "\n".join(prefix + line for line in f"{message}{context}".splitlines())
        return f"{moment:%H:%M:%S} {record.levelname.lower():8s}{message}"
