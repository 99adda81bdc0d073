"""A folder that several machines write to: see that they do, and wait for each other's files.

A cluster writes a data set to one folder on storage that all its machines share. A mark with
a random word shows that a worker's folder of that path is the client's. Network file systems
remember for a while that a file was missing; listing its folder makes them look again.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .atomic import check_writable, temporary_name, write_atomically
from .errors import WorkFailedError

__all__ = ["Mark", "await_file", "marked"]

PATIENCE = 30.0
"""How long a file of another machine may take to appear [s]."""

PAUSE = 0.1
"""Pause between two looks [s]."""


@dataclass(frozen=True)
class Mark:
    """A file by which a worker knows the client's folder.

    Attributes:
        path: where it stands.
        word: what it holds.
        patience: how long it may take to appear [s].
    """

    path: Path
    word: str
    patience: float

    def check(self, worker: str) -> None:
        """See that the folder is here and can be written to.

        Args:
            worker: name of this machine for the message.

        Raises:
            WorkFailedError: the client's folder is another one, or write-protected.
        """
        folder = self.path.parent
        if not _appears(self.path, self.patience) or self.path.read_text(encoding="utf-8") != self.word:
            raise WorkFailedError(
                "a worker does not see the folder of the data set",
                where=f"{folder}, worker {worker}",
                expected="one folder under the same path on every worker and here",
                got="another folder" if folder.is_dir() else "no such folder",
                fix="name a folder on storage that all of them share: --root",
            )
        check_writable(folder)
        for place in folder.iterdir():
            if place.is_dir():
                _look_again(place)


@contextmanager
def marked(folder: Path) -> Iterator[Mark]:
    """Keep a mark in a folder.

    Raises:
        WorkFailedError: the operating system refused.
    """
    mark = Mark(temporary_name(folder / "mark"), secrets.token_hex(16), PATIENCE)
    write_atomically(mark.path, mark.word.encode())
    try:
        yield mark
    finally:
        mark.path.unlink(missing_ok=True)


def await_file(path: Path) -> None:
    """Wait until a file that another machine has written is seen here.

    Raises:
        WorkFailedError: it does not appear.
    """
    if not _appears(path, PATIENCE):
        raise WorkFailedError(
            "a worker's file does not appear",
            where=str(path),
            expected=f"a file within {PATIENCE:.0f} s",
            fix="name a folder on storage that all machines share, then run the same command again",
        )


def _appears(path: Path, patience: float) -> bool:
    end = time.monotonic() + patience
    while True:
        _look_again(path.parent)
        if path.is_file():
            return True
        if time.monotonic() > end:
            return False
        time.sleep(PAUSE)


def _look_again(folder: Path) -> None:
    with contextlib.suppress(OSError):
        os.listdir(folder)
