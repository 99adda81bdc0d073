"""Checks on the YAML file of an entry: readable, of the schema, in its place, up to date."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path

from lagbench.data.registry import Registry, Size
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.submission import Finding, Severity

from .entry import Entry, PredictionEntry, Status
from .entry_file import examine, load_plain
from .folder import Folder
from .standing import is_current

__all__ = ["check_entry", "finding", "parsed", "size_of"]


def finding(check: str, what: str, *, where: object, expected: object, got: object, fix: str) -> Finding:
    """Return something that rejects a pull request."""
    return Finding(
        check=check,
        severity=Severity.ERROR,
        what=what,
        where=str(where),
        expected=str(expected),
        got=str(got),
        fix=fix,
    )


def parsed(folder: Folder, path: Path, found: list[Finding]) -> Entry | None:
    """Return the entry of a YAML file; None, and findings, where it cannot be one."""
    try:
        entry, mistakes = examine(Entry, load_plain(folder.path / path))
    except UnreadableFileError as error:
        found.append(
            finding(
                "readable",
                error.what,
                where=path,
                expected=error.expected or "plain YAML",
                got=error.got,
                fix=error.fix or "write it with `lagbench submit`",
            )
        )
        return None
    found += [
        finding(
            "schema",
            mistake.what,
            where=f"{path}, {mistake.where}",
            expected="what leaderboard/schema.json says",
            got=mistake.got,
            fix=mistake.fix or "docs/submitting.md describes the keys",
        )
        for mistake in mistakes
    ]
    return entry


def size_of(entry: Entry, registry: Registry, found: list[Finding]) -> Size | None:
    """Return the split and size of an entry; None, and a finding, where there is none."""
    try:
        return registry.size(entry.split, entry.size)
    except UsageError as error:
        found.append(
            finding(
                "split",
                "no such split and size",
                where=entry.yaml_path,
                expected="a split and size that `lagbench list` shows",
                got=f"{entry.split} {entry.size}",
                fix=error.fix or "name another",
            )
        )
        return None


def check_entry(folder: Folder, path: Path, entry: Entry, size: Size) -> Iterator[Finding]:
    """Yield what is wrong with the place, data set and predictions of an entry."""
    if entry.yaml_path != path:
        yield finding(
            "place",
            "the entry lies in another place than it says",
            where=path,
            expected=entry.yaml_path,
            got=path,
            fix="let split, size and method be those of the path",
        )
    if entry.status is Status.ACTIVE and not is_current(entry.dataset, size):
        recorded = size.measured.dataset_sha256[:16] if size.measured else "no recorded hash"
        yield finding(
            "version",
            "the data set is no longer the current one",
            where=path,
            expected=f"version {size.version}, {recorded}",
            got=f"version {entry.dataset.version}, {entry.dataset.sha256[:16]}",
            fix="predict from the new data and submit again, or set status: withdrawn",
        )
    for number, made in enumerate(entry.predictions):
        if made.path is not None:
            yield from _check_prediction(folder, f"{path}, predictions.{number}", made.path, made)


def _check_prediction(folder: Folder, where: str, inner: str, made: PredictionEntry) -> Iterator[Finding]:
    """Yield what is wrong with predictions in the folder; they are not opened."""
    path = Path(inner)
    link = folder.link_in(path)
    got: object
    try:
        status = (folder.path / path).lstat()
        got = status.st_size if stat.S_ISREG(status.st_mode) else "something that is no regular file"
    except OSError:
        got = "no such file"
    if link is not None:
        got = "a symbolic link"
    if got != made.bytes:
        yield finding(
            "predictions",
            "the predictions do not lie where the entry says",
            where=where,
            expected=f"{inner}, a file of {made.bytes} bytes",
            got=got,
            fix="correct path and bytes, or remove path",
        )
