"""Checks on score files and the score block: every aggregate formed again and compared."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from lagbench.checksums import file_sha256
from lagbench.errors import UnreadableFileError
from lagbench.registry import Size
from lagbench.submission import Finding

from .entry import Entry, Summary
from .entry_checks import finding
from .folder import Folder
from .seal import digest_of
from .seeds import combine, summarise
from .standing import is_current
from .stored import MAX_SCORE_BYTES, Stored, read_stored

__all__ = ["RESCORE", "TOLERANCE", "check_scores"]

TOLERANCE = 1e-6
"""Relative difference up to which two aggregates are equal; NumPy versions may differ in the last bits."""

RESCORE = "submit the predictions again: lagbench submit; the score block is not for editing"


def check_scores(folder: Folder, entry: Entry, size: Size, broken: Mapping[Path, str]) -> Iterator[Finding]:
    """Yield what is wrong with the scores of an entry.

    Args:
        folder: the leaderboard's folder.
        entry: the entry.
        size: its split and size.
        broken: score files that cannot be read, and why, as a child process found.
    """
    task = size if is_current(entry.dataset, size) else None
    stored: list[Stored] = []
    for path, said, made in zip(entry.score_paths, entry.score.files, entry.predictions, strict=True):
        wrong = _file_mistake(folder, path, said.sha256, broken)
        if wrong is not None:
            yield wrong
            continue
        try:
            held = read_stored(folder.path / path, task)
        except UnreadableFileError as error:
            yield _odd(path, f"{error.what}: {error.got}")
            continue
        yield from _check_identity(path, entry, made.sha256, held)
        stored.append(held)
    yield from _check_block(entry)
    if len(stored) == len(entry.predictions):
        yield from _check_numbers(entry, stored)


def _file_mistake(folder: Folder, path: Path, sha256: str, broken: Mapping[Path, str]) -> Finding | None:
    """Return what is wrong with the bytes of a score file, None if nothing is."""
    file = folder.path / path
    if not file.is_file() or folder.link_in(path) is not None:
        return finding(
            "missing",
            "a score file is not there",
            where=path,
            expected="the file that `lagbench submit` wrote beside the entry",
            got="no such file",
            fix="add it to the pull request, or submit again",
        )
    length = file.stat().st_size
    if length > MAX_SCORE_BYTES:
        return finding(
            "oversize",
            "a score file is too long",
            where=path,
            expected=f"at most {MAX_SCORE_BYTES} bytes",
            got=f"{length} bytes",
            fix=RESCORE,
        )
    if (found := file_sha256(file)) != sha256:
        return _odd(path, f"SHA-256 {found[:16]}, not {sha256[:16]} as the entry says")
    return _odd(path, broken[file]) if file in broken else None


def _odd(path: Path, got: str) -> Finding:
    return finding(
        "score_file",
        "a score file is not the one that the scorer wrote",
        where=path,
        expected="the file of the entry, unchanged",
        got=got,
        fix=RESCORE,
    )


def _check_identity(path: Path, entry: Entry, predictions_sha256: str, held: Stored) -> Iterator[Finding]:
    identity = held.scores.identity
    expected = {
        "split": entry.split,
        "size": entry.size,
        "dataset_version": entry.dataset.version,
        "dataset_sha256": entry.dataset.sha256,
        "predictions_sha256": predictions_sha256,
    }
    found = {**identity, "predictions_sha256": held.scores.predictions_sha256}
    for name, wanted in expected.items():
        if found[name] != wanted:
            yield _odd(path, f"{name} {ascii(found[name])[:80]}, not {wanted!a}")


def _check_block(entry: Entry) -> Iterator[Finding]:
    block = entry.score
    if block.digest != digest_of(entry.place, entry.dataset, entry.predictions, block):
        yield _edited(entry, "a score block and data set as `lagbench submit` wrote them", "another digest")
    if block.dataset_sha256 != entry.dataset.sha256:
        yield _edited(entry, entry.dataset.sha256, block.dataset_sha256)


def _check_numbers(entry: Entry, stored: Sequence[Stored]) -> Iterator[Finding]:
    ranking = stored[0].scores.ranking
    if entry.score.ranking_metric != ranking:
        yield _edited(entry, f"ranking_metric {ranking}", entry.score.ranking_metric)
    formed, said = summarise(combine([held.scores for held in stored])), entry.score.metrics
    differing = [name for name in {**formed, **said} if not _same(formed.get(name), said.get(name))]
    if differing:
        name, more = differing[0], len(differing) - 1
        yield _edited(
            entry,
            f"{name}: {_spelt(formed.get(name))}",
            f"{_spelt(said.get(name))}" + (f", and {more} more metrics differ" if more else ""),
        )


def _edited(entry: Entry, expected: str, got: str) -> Finding:
    return finding(
        "score",
        "the score block is not what the score files give",
        where=f"{entry.yaml_path}, score",
        expected=expected,
        got=got,
        fix=RESCORE,
    )


def _same(first: Summary | None, second: Summary | None) -> bool:
    if first is None or second is None:
        return False
    pairs = zip(first.model_dump().values(), second.model_dump().values(), strict=True)
    return all(_close(one, two) for one, two in pairs)


def _close(first: float | None, second: float | None) -> bool:
    if first is None or second is None:
        return first is second
    return math.isclose(first, second, rel_tol=TOLERANCE, abs_tol=1e-300)


def _spelt(summary: Summary | None) -> str:
    if summary is None:
        return "no such metric"
    return ", ".join(f"{key} {value}" for key, value in summary.model_dump().items())
