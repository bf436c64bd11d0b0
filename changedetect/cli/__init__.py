"""
The command line: parse, call, print.

`main` turns every outcome into an exit code: 0 done or nothing due, 2 usage, 10 significant change with
``--exit-code``, 65 bad data, 66 missing input, 73 cannot create output, 74 input or output failed, 75 try again later,
78 configuration, 130 interrupted, 1 a bug.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Any

import typer

from changedetect.cli.app import app
from changedetect.cli.session import print_error, wants_json

__all__ = ["main"]

logger = logging.getLogger(__name__)


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Those of the process by default.

    Returns
    -------
    exit_code : int
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    is_json = wants_json(arguments)
    try:
        result: Any = app(args=list(arguments), prog_name="changedetect", standalone_mode=False)
    except typer.TyperException as error:
        if is_json or not hasattr(error, "show"):
            return print_error(error, error.exit_code, is_json=is_json)
        error.show()
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        return _report(KeyboardInterrupt("Interrupted."), is_json=is_json)
    except Exception as error:
        return _report(error, is_json=is_json)
    return result if isinstance(result, int) else 0


def _report(error: BaseException, *, is_json: bool) -> int:
    from changedetect.pipeline.manifest import exit_code_of

    exit_code = exit_code_of(error)
    if exit_code == 1:
        logger.critical("Unexpected failure, a bug in changedetect:", exc_info=error)
    return print_error(error, exit_code, is_json=is_json)
