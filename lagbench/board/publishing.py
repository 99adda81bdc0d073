"""Several files that appear together or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from lagbench.errors import LagbenchError, WorkFailedError

__all__ = ["Batch", "batch"]

STAGE = ".submit-"
"""First letters of the folder in which files are prepared; a killed process leaves it behind."""


class Batch:
    """Files that wait for their publication."""

    def __init__(self, folder: Path, stage: Path) -> None:
        self._folder, self._stage = folder, stage
        self._targets: list[Path] = []

    def prepare(self, target: Path) -> Path:
        """Return where to write a file that shall appear at a path relative to the folder."""
        self._targets.append(target)
        return self._staged(len(self._targets) - 1)

    def publish(self, *, remove: Collection[Path] = ()) -> None:
        """Move all prepared files to their places and remove others, in this order; undo on failure."""
        old = self._stage / "old"
        old.mkdir()
        undo: list[tuple[Path, Path | None]] = []
        gone = [path for path in remove if path not in self._targets]
        try:
            for number, path in enumerate([*self._targets, *gone]):
                target, kept = self._folder / path, old / str(number)
                target.parent.mkdir(parents=True, exist_ok=True)
                there = target.exists()
                undo.append((target, kept if there else None))
                if there:
                    target.rename(kept)
                if number < len(self._targets):
                    self._staged(number).rename(target)
        except BaseException:
            for target, before in reversed(undo):
                if before is None:
                    target.unlink(missing_ok=True)
                elif before.exists():
                    before.replace(target)
            raise

    def _staged(self, number: int) -> Path:
        return self._stage / f"{number}{self._targets[number].suffix}"


@contextmanager
def batch(folder: Path) -> Iterator[Batch]:
    """Yield a batch of files for a folder; what is not published leaves no trace."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=STAGE, dir=folder))
    except OSError as error:
        raise _refused(folder, error) from error
    try:
        yield Batch(folder, stage)
    except LagbenchError:
        raise
    except OSError as error:
        raise _refused(folder, error) from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _refused(folder: Path, error: OSError) -> WorkFailedError:
    return WorkFailedError(
        "cannot write there",
        where=str(folder),
        got=error.strerror or error,
        fix="free disk space, or name a folder that you may write to: --board",
    )
