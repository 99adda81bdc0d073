"""Check a leaderboard's folder: ``lagbench leaderboard check``, for every pull request.

All findings together, each with a name: what, where, expected, got, how to fix it; one
bad file hides nothing of the others. Nothing that strangers sent is run; their score
files are first read in a child process under limits. Whoever makes every hash and
number anew is found by scoring the predictions again, and by nothing else: that is what
verified.yaml says of an entry.
"""

from __future__ import annotations

import math
import stat
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from lagbench.data.checksums import file_sha256
from lagbench.data.local import resolve_root
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import LagbenchError, UnreadableFileError, UsageError
from lagbench.references.shipped import shipped_path
from lagbench.references.table import REFERENCES
from lagbench.scoring.references import remeasure
from lagbench.scoring.score import score
from lagbench.scoring.score_file_checks import (
    MAX_SCORE_BYTES,
    ScoreFile,
    find_unreadable,
    read_score_file,
)
from lagbench.submission.findings import Finding
from lagbench.work.progress import Progress

from .audit import TOLERANCE, Confirmation, Rescoring, check_base
from .build import build
from .entry import Entry, EntryBudget, Status, Summary, last_day
from .entry_file import examine, load_plain, read_verified, record, verification_of
from .findings import finding, finding_of, impossible, print_of, skeleton
from .folder import VERIFIED, Folder, Place, entry_path
from .ranking import combine, dataset_of, is_current, summarise
from .weights import check_weights


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """What the checks say of a leaderboard's folder."""

    folder: Path
    entries: int  # entries that were looked at
    findings: tuple[Finding, ...]
    # whether the page was compared; it is not while anything else is wrong
    page_checked: bool
    # predictions that gave the same when scored again
    confirmed: tuple[Confirmation, ...] = ()
    recorded: tuple[str, ...] = ()  # entries that were added to verified.yaml
    # entries of which some seeds were confirmed and others not looked at: they are not
    # added
    partly: tuple[str, ...] = ()
    # floors that were measured again, by data set, as in "cavity mini"
    floors: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """0 where nothing is wrong, else 1."""
        if self.findings:
            return 1
        return 0


def check_board(
    board: str | Path,
    *,
    registry: Registry | None = None,
    page: bool = False,
    base: str | None = None,
    own: Collection[str] = (),
    isolated: bool = True,
    predictions: Sequence[str | Path] = (),
    recording: bool = False,
    floors: Collection[Size] = (),
    root: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> CheckResult:
    """Check entries, score files and aggregates of a leaderboard's folder; the page
    once all else is well.

    Entries of the git revision ``base`` that the folder alters are findings, unless of
    methods in ``own``. With ``isolated`` a child process reads score files first.
    Scored again are ``predictions`` of entries, noted in verified.yaml with
    ``recording``, and the shipped floors of the sizes ``floors``.
    """
    folder = Folder(board)
    described = registry or load()
    folder.require()
    files = [
        folder.path / path
        for path in (*folder.score_files(), *folder.reference_files())
    ]
    if isolated:
        broken = find_unreadable(files)
    else:
        broken = {}
    look = _Look(folder=folder, registry=described, broken=broken)
    for path in folder.entries():
        look.guarded(path, look.entry)
    for path in folder.reference_files():
        look.guarded(path, look.floor)
    look.together()
    if base is not None:
        look.found += check_base(folder, base, own)
    card = partial(score, root=root, registry=described, progress=progress, write=False)
    again = Rescoring(folder=folder, entries=look.known, sound=look.sound, card=card)
    for one in predictions:
        look.found += again.of_file(one)
    measured = {}
    for size in floors:
        names, unlike = remeasure(size, resolve_root(root), progress=progress)
        measured[f"{size.split} {size.name}"] = names
        for name, metrics in unlike.items():
            if len(metrics) > 3:
                more = f" and {len(metrics) - 3} more metrics"
            else:
                more = ""
            where = f"{shipped_path(size).name}, {name}"
            look.add("measured", where, f"other {', '.join(metrics[:3])}{more}")
    confirmed = {one.score_file for one in again.confirmed}
    whole = {
        entry.yaml_path: entry
        for entry in look.known
        if confirmed.issuperset(entry.score_paths)
    }
    if recording and not look.found:
        recorded = [*whole.values()]
    else:
        recorded = []
    record(folder, recorded)
    looked = page and not look.found
    if looked:
        try:
            build(folder.path, check=True, registry=described)
        except LagbenchError as error:
            look.found.append(finding_of("page", error, error.where))
    return CheckResult(
        folder=folder.path,
        entries=len(folder.entries()),
        findings=tuple(look.found),
        page_checked=looked,
        confirmed=tuple(again.confirmed),
        recorded=tuple(entry.yaml_path.as_posix() for entry in recorded),
        partly=tuple(
            sorted(
                {
                    one.entry.as_posix()
                    for one in again.confirmed
                    if one.entry not in whole
                }
            )
        ),
        floors=measured,
    )


@dataclass(kw_only=True)
class _Look:
    """One look at a folder: what is known of it, and what was found."""

    folder: Folder
    registry: Registry
    # files that cannot be read, and why, as a child process found
    broken: Mapping[Path, str]
    found: list[Finding] = field(default_factory=list)
    known: list[Entry] = field(default_factory=list)
    sound: set[Path] = field(default_factory=set)  # score files that were read
    # by what was predicted
    prints: dict[str, list[tuple[Entry, Path]]] = field(default_factory=dict)

    def add(self, check: str, where: object, got: object, **said: Any) -> None:  # noqa: ANN401
        """Add a finding."""
        self.found.append(finding(check, where, got, **said))

    def guarded(self, path: Path, check: Callable[[Path], None]) -> None:
        """Look at one file; whatever goes wrong with it must not hide what is wrong
        with others.
        """
        try:
            check(path)
        except Exception as error:
            self.add(
                "readable",
                path,
                f"{type(error).__name__}: {ascii(str(error)[:200])[1:-1]}",
            )

    def entry(self, path: Path) -> None:
        """Check the YAML file of an entry and its score files."""
        try:
            entry, mistakes = examine(Entry, load_plain(self.folder.path / path))
        except UnreadableFileError as error:
            self.found.append(finding_of("readable", error, path))
            return
        for told in mistakes:
            self.add(
                "schema",
                f"{path}, {told.where}",
                told.got,
                what=told.what,
                fix=told.fix,
            )
        if entry is None:
            return
        try:
            size = self.registry.size(entry.split, entry.size)
        except UsageError as error:
            self.add("split", path, f"{entry.split} {entry.size}", fix=error.fix)
            return
        self.known.append(entry)
        if entry.yaml_path != path:
            self.add("place", path, path, expected=entry.yaml_path)
        if entry.status is Status.ACTIVE and not is_current(entry.dataset, size):
            if size.measured:
                recorded = size.measured.dataset_sha256[:16]
            else:
                recorded = "no recorded hash"
            other = f"version {entry.dataset.version}, {entry.dataset.sha256[:16]}"
            self.add(
                "version", path, other, expected=f"version {size.version}, {recorded}"
            )
        if entry.date > (last := last_day()):
            self.add("date", path, entry.date, expected=f"at most {last}")
        for number, made in enumerate(entry.predictions):
            if (
                made.path is not None
                and (got := self._length(Path(made.path))) != made.bytes
            ):
                expected = f"{made.path}, a file of {made.bytes} bytes"
                self.add(
                    "predictions",
                    f"{path}, predictions.{number}",
                    got,
                    expected=expected,
                )
        formed = EntryBudget.of(entry.size, [made.budget for made in entry.predictions])
        if formed is not None and entry.budget != formed:
            self.add("budget", f"{path}, budget", entry.budget, expected=formed)
        elif (
            formed is None
            and entry.budget is not None
            and entry.budget.track is not None
        ):
            self.add("budget", f"{path}, budget.track", entry.budget.track)
        self._scores(path, entry, size)

    def _length(self, path: Path) -> str | int:
        """Return the length of a file in the folder [bytes], or what is there
        instead.
        """
        if self.folder.link_in(path) is not None:
            return "a symbolic link"
        try:
            status = (self.folder.path / path).lstat()
        except OSError:
            return "no such file"
        if stat.S_ISREG(status.st_mode):
            return status.st_size
        return "something that is no regular file"

    def _scores(self, path: Path, entry: Entry, size: Size) -> None:
        """Check the score files of an entry, and its score block against them."""
        if is_current(entry.dataset, size):
            task = size
        else:
            task = None
        stored = []
        for inner, said, made in zip(
            entry.score_paths, entry.score.files, entry.predictions, strict=True
        ):
            if (one := self._read(inner, said.sha256, task)) is None:
                continue
            expected = {
                "split": entry.split,
                "size": entry.size,
                "dataset_version": entry.dataset.version,
            }
            expected |= {
                "dataset_sha256": entry.dataset.sha256,
                "predictions_sha256": made.sha256,
            }
            found = {
                **one.scores.identity,
                "predictions_sha256": one.scores.predictions_sha256,
            }
            for name, wanted in expected.items():
                if found[name] != wanted:
                    self.add(
                        "score_file",
                        inner,
                        f"{name} {ascii(found[name])[:80]}, not {wanted!a}",
                    )
            if wrong := list(impossible(one)):
                self.add(
                    "values",
                    inner,
                    wrong[0] + f" and {len(wrong) - 1} more" * (len(wrong) > 1),
                )
            else:
                stored.append(one)
            for print_ in (made.sha256, print_of(one.scores.tallies)):
                self.prints.setdefault(print_, []).append((entry, inner))
        if entry.score.dataset_sha256 != entry.dataset.sha256:
            self.add(
                "score",
                f"{path}, score",
                entry.score.dataset_sha256,
                expected=entry.dataset.sha256,
            )
        if len(stored) < len(entry.predictions):
            return
        # only seeds of the same scenarios and frames have a mean
        held = [one.scores for one in stored]
        extents = [
            (sorted(h.tallies), next(iter(h.tallies.values())).frames, h.ranking)
            for h in held
        ]
        odd = [
            p
            for p, extent in zip(entry.score_paths, extents, strict=True)
            if extent != extents[0]
        ]
        for inner in odd:
            self.add(
                "score_file",
                inner,
                "other scenarios, frames or ranking metric than the first seed has",
            )
        if odd:
            return
        where = f"{path}, score"
        ranking = held[0].ranking
        if entry.score.ranking_metric != ranking:
            self.add(
                "score",
                where,
                entry.score.ranking_metric,
                expected=f"ranking_metric {ranking}",
            )
        formed = summarise(combine(held))
        told = entry.score.metrics
        differing = [
            name
            for name in {**formed, **told}
            if not _same(formed.get(name), told.get(name))
        ]
        if differing:
            name = differing[0]
            more = len(differing) - 1
            got = _spelt(told.get(name)) + f", and {more} more metrics differ" * (
                more > 0
            )
            self.add(
                "score", where, got, expected=f"{name}: {_spelt(formed.get(name))}"
            )

    def _read(self, path: Path, sha256: str, task: Size | None) -> ScoreFile | None:
        """Return a score file; None, and a finding, where it cannot be one."""
        file = self.folder.path / path
        if not file.is_file() or self.folder.link_in(path) is not None:
            self.add("missing", path, "no such file")
        elif (length := file.stat().st_size) > MAX_SCORE_BYTES:
            self.add("oversize", path, f"{length} bytes")
        elif (found := file_sha256(file)) != sha256:
            self.add(
                "score_file",
                path,
                f"SHA-256 {found[:16]}, not {sha256[:16]} as the entry says",
            )
        elif file in self.broken:
            self.add("score_file", path, self.broken[file])
        else:
            try:
                held = read_score_file(file, task)
            except UnreadableFileError as error:
                self.add("score_file", path, f"{error.what}: {error.got}")
            else:
                self.sound.add(path)
                return held
        return None

    def floor(self, path: Path) -> None:
        """Check the scores of a floor."""
        try:
            size = self.registry.size(*path.parts[1:3])
            if path.stem not in REFERENCES or self.folder.path / path in self.broken:
                got = self.broken.get(self.folder.path / path, "an unknown name")
                self.add("floor", path, got, expected=", ".join(REFERENCES))
                return
            identity = read_score_file(self.folder.path / path, size).scores.identity
            if not is_current(dataset_of(identity), size):
                self.add(
                    "floor",
                    path,
                    identity["dataset_sha256"],
                    what="scores on another data set",
                )
        except LagbenchError as error:
            self.found.append(finding_of("floor", error, path))

    def together(self) -> None:
        """Check what entries are to each other, and what else lies in the folder."""
        entries = self.known
        named = [
            Path(made.path)
            for entry in entries
            for made in entry.predictions
            if made.path
        ]
        for path, reason in self.folder.odd(named):
            self.add("folder", ascii(path.as_posix())[1:-1], reason)
        self.found += check_weights(self.folder, entries)
        # a successor has to be there, and a line of them to end
        after: dict[Place, Place] = {
            e.place: (e.split, e.size, e.superseded_by)
            for e in entries
            if e.superseded_by is not None
        }
        for place, successor in after.items():
            line = [successor]
            while line[-1] in after and after[line[-1]] not in line:
                line.append(after[line[-1]])
            if not (self.folder.path / entry_path(successor)).is_file():
                self.add(
                    "lifecycle",
                    entry_path(place),
                    f"{successor[2]}, which is not there",
                )
            elif place in line:
                self.add(
                    "lifecycle",
                    entry_path(place),
                    " -> ".join(name for *_, name in line),
                )
        told = set()
        for held in self.prints.values():  # predictions under two names or seeds
            files = list(
                dict.fromkeys(
                    path for entry, path in held if entry.status is Status.ACTIVE
                )
            )
            for path in files[1:]:
                if path not in told and path.parts[1:3] == files[0].parts[1:3]:
                    told.add(path)
                    self.add("twin", path, f"those of {files[0]}")
        floors = {skeleton(floor): f"that of the floor {floor}" for floor in REFERENCES}
        seen: dict[tuple[str, str, str], str] = {}
        for entry in (entry for entry in entries if entry.status is Status.ACTIVE):
            own = f"that of {entry.method}, {entry.name!a}"
            name = skeleton(entry.name)
            other = floors.get(name) or seen.setdefault(
                (entry.split, entry.size, name), own
            )
            if other != own:
                self.add("name", entry.yaml_path, other)
        scored = {path for entry in entries for path in entry.score_paths}
        # those of entries that cannot be read are no strays
        unread = self.folder.claims() - {entry.place for entry in entries}
        for path in self.folder.score_files():
            if (
                path not in scored
                and (*path.parts[1:3], path.stem.partition("_")[0]) not in unread
            ):
                self.add("stray", path, "none")
        try:
            lines = read_verified(self.folder)
        except LagbenchError as error:
            self.found.append(finding_of("verified", error, VERIFIED))
        else:
            sound = {
                entry.yaml_path.as_posix()
                for entry in entries
                if verification_of(entry, lines)
            }
            for named_path in sorted(lines.keys() - sound):
                self.add("verified", VERIFIED, ascii(named_path)[:120])


def _same(first: Summary | None, second: Summary | None) -> bool:
    if first is None or second is None:
        return False
    return all(
        one is two
        if None in (one, two)
        else math.isclose(one, two, rel_tol=TOLERANCE, abs_tol=1e-300)
        for (_, one), (_, two) in zip(first, second, strict=True)
    )


def _spelt(summary: Summary | None) -> str:
    if summary is None:
        return "no such metric"
    return ", ".join(f"{key} {value}" for key, value in summary)
