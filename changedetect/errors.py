"""
Exceptions of the project, each with the exit code the command line returns.

Codes follow sysexits.h as systemd names them: 65 bad data, 66 missing input, 73 cannot create output,
74 input/output, 75 temporary, 78 configuration; 1 is a bug and 2 wrong usage.
"""

from __future__ import annotations

__all__ = [
    "CRSMismatchError",
    "ChangeDetectError",
    "ConfigError",
    "InputDataError",
    "MissingInputError",
    "ModelStateError",
    "OutputError",
    "OutputExistsError",
    "TemporaryError",
    "UsageError",
    "VerticalDatumError",
]


class ChangeDetectError(Exception):
    """Base of every error a user can act on; `exit_code` is what the command line returns."""

    exit_code = 1


class UsageError(ChangeDetectError, ValueError):
    """An argument is none that the command or function takes."""

    exit_code = 2


class ConfigError(ChangeDetectError, ValueError):
    """A setting is unknown, out of range or contradicts another one."""

    exit_code = 78


class InputDataError(ChangeDetectError, ValueError):
    """A source can be opened but its content cannot be used."""

    exit_code = 65


class CRSMismatchError(InputDataError):
    """A horizontal coordinate reference system is missing, unsuitable or cannot be reached."""


class VerticalDatumError(InputDataError):
    """Heights refer to a vertical datum that differs from the programme's or cannot be transformed to it."""


class ModelStateError(InputDataError):
    """A stored model is damaged, incomplete, or of another format version."""


class MissingInputError(ChangeDetectError, FileNotFoundError):
    """A file, epoch or programme that was named does not exist."""

    exit_code = 66


class OutputError(ChangeDetectError, OSError):
    """An output cannot be written."""

    exit_code = 73


class OutputExistsError(OutputError):
    """An output exists and overwriting was not asked for."""


class TemporaryError(ChangeDetectError):
    """Trying again later may succeed: a lock is held, or storage or network is away."""

    exit_code = 75
