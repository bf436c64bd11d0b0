"""One writer at a time in a programme folder."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from changedetect.errors import OutputError, TemporaryError
from changedetect.storage import clear_leftovers

__all__ = ["programme_lock"]


@contextmanager
def programme_lock(directory: Path) -> Iterator[None]:
    """
    Hold the lock of a programme folder, and clear away what killed runs left there.

    Parameters
    ----------
    directory : Path
        Programme folder. The lock is on the file `.lock` in it, which stays; the kernel releases it when the
        process ends, however it ends.

    Raises
    ------
    TemporaryError
        Another process holds the lock; the message names it.
    OutputError
        The folder cannot be written.
    """
    path = directory / ".lock"
    try:
        stream = path.open("a+", encoding="utf-8")
    except OSError as error:
        msg = f"Cannot write into '{directory}': {error.strerror}. Make the programme folder writable."
        raise OutputError(msg) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            stream.seek(0)
            holder = stream.read().strip() or "another process"
            msg = f"'{directory}' is locked by {holder}. Wait for it to finish, then run again."
            raise TemporaryError(msg) from error
        stream.truncate(0)
        stream.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}\n")
        stream.flush()
        for folder in ("state", "products", "epochs", "runs", "sources"):
            if (directory / folder).is_dir():
                clear_leftovers(directory / folder)
        try:
            yield
        finally:
            stream.truncate(0)
