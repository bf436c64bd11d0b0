"""What a run did: `runs/RUN_ID.json`, written when it starts, as it goes and when it ends, however it ends."""

from __future__ import annotations

import logging
import os
import platform
import secrets
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import changedetect
from changedetect.catalogue import Item, Programme
from changedetect.errors import ChangeDetectError, ModelStateError
from changedetect.storage import read_json, write_json
from changedetect.typing import JSONObject

__all__ = ["RUN_FORMAT_VERSION", "RunManifest", "exit_code_of", "log_context", "new_run_id", "utc_now"]

logger = logging.getLogger(__name__)

#: Version of the layout of `runs/RUN_ID.json`.
RUN_FORMAT_VERSION = 1

_LIBRARIES = ("numpy", "scipy", "numba", "rasterio", "pyproj", "xarray", "netCDF4", "laspy")


_log_context: ContextVar[Mapping[str, str]] = ContextVar("log_context")


def log_context() -> dict[str, str]:
    """Run, programme and step that a log record made here and now belongs to; empty outside a run."""
    return dict(_log_context.get({}))


def utc_now() -> str:
    """Present time, ISO 8601, UTC, whole seconds."""
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"


def new_run_id() -> str:
    """Time to the microsecond and a few random digits: ids of one machine sort by time, even of runs a moment apart."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}-{secrets.token_hex(3)}"


class RunManifest:
    """
    The record of one run, kept on disk while it goes.

    Parameters
    ----------
    programme : Programme
    command : str
        What was asked for, for people.

    Attributes
    ----------
    run_id : str
    exit_code : int
        That of the first error; 0 without one.
    """

    def __init__(self, programme: Programme, command: str) -> None:
        self.programme = programme
        self.run_id = new_run_id()
        self.exit_code = 0
        self._document: JSONObject = {
            "format_version": RUN_FORMAT_VERSION,
            "run_id": self.run_id,
            "command": command,
            "programme": programme.config.name,
            "status": "running",
            "exit_code": None,
            "started": utc_now(),
            "finished": None,
            "seconds": None,
            "process": os.getpid(),
            "host": socket.gethostname(),
            "software_version": changedetect.__version__,
            "python_version": platform.python_version(),
            "library_versions": {name: version(name) for name in _LIBRARIES},
            "config": asdict(programme.config),
            "config_sha256": programme.config.config_sha256,
            "steps": [],
            "warnings": [],
            "errors": [],
        }

    @property
    def path(self) -> Path:
        """Where the record lies."""
        return self.programme.runs_directory / f"{self.run_id}.json"

    @property
    def steps(self) -> list[JSONObject]:
        """What was done so far."""
        steps: list[JSONObject] = self._document["steps"]
        return steps

    @property
    def warnings(self) -> list[str]:
        """What people should know about the results."""
        warnings: list[str] = self._document["warnings"]
        return warnings

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Keep the record on disk during a block; an error that leaves the block is recorded and passes on."""
        _close_killed_run(self.programme)
        started = perf_counter()
        self._write()
        context = _log_context.set({"run": self.run_id, "programme": self.programme.config.name})
        try:
            yield
        except BaseException as error:
            self._fail(error)
            self._finish("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", started)
            raise
        finally:
            _log_context.reset(context)
        self._finish("failed" if self.exit_code else "succeeded", started)

    @contextmanager
    def step(self, item: Item) -> Iterator[dict[str, Any]]:
        """
        Record one step; an error is recorded and ends the step, not the run.

        Yields
        ------
        details : dict
            To be filled with what the step found.
        """
        details: dict[str, Any] = {}
        entry: JSONObject = {"kind": item.kind, "id": item.item_id, "title": item.title, "status": "made"}
        entry["reasons"] = list(item.reasons)
        started = perf_counter()
        context = _log_context.set({**log_context(), "epoch": item.item_id})
        try:
            yield details
        except Exception as error:  # one failed epoch must not lose the others' results
            entry["status"] = "failed"
            entry["error"] = self._fail(error)
            logger.error("%s: %s", item.title, error, exc_info=exit_code_of(error) == 1)
        finally:
            _log_context.reset(context)
        entry |= {"seconds": round(perf_counter() - started, 3), **details}
        self.steps.append(entry)
        self._write()

    def warn(self, message: str) -> None:
        """Record a warning and log it."""
        self.warnings.append(message)
        logger.warning("%s", message)

    def _fail(self, error: BaseException) -> JSONObject:
        exit_code = exit_code_of(error)
        self.exit_code = self.exit_code or exit_code
        described = {"class": type(error).__name__, "message": str(error), "exit_code": exit_code}
        self._document["errors"].append(described)
        return described

    def _finish(self, status: str, started: float) -> None:
        self._document |= {
            "status": status,
            "exit_code": self.exit_code,
            "finished": utc_now(),
            "seconds": round(perf_counter() - started, 3),
        }
        self._write()

    def _write(self) -> None:
        write_json(self.path, self._document)


def exit_code_of(error: BaseException) -> int:
    """Exit code that an error ends the command line with; 1 stands for a bug."""
    if isinstance(error, ChangeDetectError):
        return error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return 130
    return 74 if isinstance(error, OSError) else 1


def _close_killed_run(programme: Programme) -> None:
    """Say in the last run's record that it was killed, if it never said how it ended."""
    records = sorted(programme.runs_directory.glob("*.json"))
    if not records:
        return
    try:
        document = read_json(records[-1])
    except ModelStateError as error:
        logger.warning("%s", error)
        return
    if isinstance(document, dict) and document.get("status") == "running":
        logger.warning("Run %s was killed; continuing from what it finished", document.get("run_id"))
        write_json(records[-1], document | {"status": "killed"})
