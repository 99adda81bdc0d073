"""Checks on score files and the score block: every aggregate formed again and compared."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError
from lagbench.submission import Finding

from .coverage import gaps
from .entry import Entry, Summary
from .entry_checks import finding
from .folder import Folder
from .likeness import TOLERANCE, untrue
from .seal import digest_of
from .seeds import combine, summarise
from .standing import is_current
from .stored import MAX_SCORE_BYTES, Stored, read_stored

__all__ = ["RESCORE", "ScoreChecks"]

RESCORE = "submit the predictions again: lagbench submit; the score block is not for editing"


class ScoreChecks:
    """Checks on the scores of entries, one after the other."""

    def __init__(self, folder: Folder, broken: Mapping[Path, str]) -> None:
        self.sound: set[Path] = set()  # score files that were read
        self._folder, self._broken = folder, broken
        self._witnesses: dict[tuple[str, str, str], tuple[Path, Stored]] = {}

    def of(self, entry: Entry, size: Size) -> Iterator[Finding]:
        """Yield what is wrong with the scores of an entry."""
        task = size if is_current(entry.dataset, size) else None
        stored: list[Stored] = []
        for path, said, made in zip(entry.score_paths, entry.score.files, entry.predictions, strict=True):
            held = yield from self._read(path, said.sha256, task)
            if held is not None:
                yield from _check_identity(path, entry, made.sha256, held)
                yield from self._check_truth(path, held)
                stored.append(held)
        yield from _check_block(entry)
        if len(stored) == len(entry.predictions) and (yield from _check_alike(entry, stored)):
            yield from _check_numbers(entry, stored)

    def _read(self, path: Path, sha256: str, task: Size | None) -> Generator[Finding, None, Stored | None]:
        """Return a score file; None, and findings, where it cannot be one."""
        wrong = _file_mistake(self._folder, path, sha256, self._broken)
        if wrong is not None:
            yield wrong
            return None
        try:
            held = read_stored(self._folder.path / path, task)
        except UnreadableFileError as error:
            yield _odd(path, f"{error.what}: {error.got}")
            return None
        self.sound.add(path)
        if task is not None:
            for expected, got in gaps(held.scores, task):
                yield finding(
                    "statistics",
                    "a score file has gaps that the scorer does not leave",
                    where=path,
                    expected=expected,
                    got=got,
                    fix=RESCORE,
                )
        return held

    def _check_truth(self, path: Path, held: Stored) -> Iterator[Finding]:
        """Compare what the truth alone decides with the first score file of the same data set."""
        identity = held.scores.identity
        key = (identity["split"], identity["size"], identity["dataset_sha256"])
        witness, first = self._witnesses.setdefault(key, (path, held))
        differing = list(untrue(first, held)) if first is not held else []
        if differing:
            yield finding(
                "truth",
                "two score files of one data set disagree about the truth",
                where=path,
                expected=f"that of {witness}",
                got=f"other {', '.join(differing[:5])}",
                fix=f"submit again whichever was edited: {path.stem} or {witness.stem}",
            )


def _check_alike(entry: Entry, stored: Sequence[Stored]) -> Generator[Finding, None, bool]:
    """Tell whether seeds are of the same scenarios and frames, so that they have a mean."""
    first = _extent(stored[0])
    for path, held in zip(entry.score_paths, stored, strict=True):
        if _extent(held) != first:
            yield _odd(
                path, f"other scenarios, frames or ranking metric than {entry.score_paths[0].name} has"
            )
            return False
    return True


def _extent(held: Stored) -> tuple[object, ...]:
    tallies = held.scores.tallies
    return sorted(tallies), next(iter(tallies.values())).frames, held.scores.ranking


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
    if block.digest != digest_of(entry.place, entry.dataset, entry.predictions, entry, block):
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
