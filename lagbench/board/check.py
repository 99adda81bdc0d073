"""Check a leaderboard's folder: ``lagbench leaderboard check``, for every pull request.

All issues are reported together; one bad file hides nothing of the others. Nothing that
strangers sent is run; their score files are first read in a child process under limits.
Whoever makes every hash and number anew is found by scoring the predictions again, and
by nothing else: verified.yaml names the entries for which that was done.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from lagbench.data.local import resolve_root
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import LagbenchError, WorkFailedError
from lagbench.references.shipped import shipped_path
from lagbench.scoring.references import remeasure
from lagbench.scoring.score import score
from lagbench.scoring.score_file_checks import find_unreadable
from lagbench.submission.issues import ValidationIssue
from lagbench.work.run import Progress

from .base import check_base
from .build import build
from .entry import Entry, Verification
from .folder import Folder
from .folder_checks import FolderChecks
from .issues import issue_from_error, make_issue
from .rescoring import Confirmation, Rescoring
from .verified import record_verified

MOST_METRICS = 3  # metrics that an issue names


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """The result of all checks of a leaderboard's folder."""

    folder: Path
    entries: int  # entries that were checked
    findings: tuple[ValidationIssue, ...]
    # whether the page was compared; it is not while anything else is wrong
    page_checked: bool
    # predictions that gave the same when scored again
    confirmed: tuple[Confirmation, ...] = ()
    recorded: tuple[str, ...] = ()  # entries that were added to verified.yaml
    # entries of which some seeds were confirmed and others not scored: they are not
    # added
    partly: tuple[str, ...] = ()
    # active entries whose models were run again and gave the same scores
    reproduced_wholly: int = 0  # on all test scenarios
    reproduced_partly: int = 0  # on a part of them
    # reference predictors that were measured again, by data set, as in "cavity mini"
    references: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

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
    measured_sizes: Collection[Size] = (),
    root: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> CheckResult:
    """Check entries, score files and aggregates of a leaderboard's folder.

    Args:
        board: the leaderboard's folder.
        registry: where splits are described; ours when None.
        page: whether to compare the page, too, where all else is right.
        base: git revision; entries there that the folder alters are issues.
        own: methods whose entries the change may alter.
        isolated: whether a child process reads score files first.
        predictions: files of predictions of entries, which are scored again.
        recording: whether to note confirmed entries in verified.yaml.
        measured_sizes: sizes whose shipped scores of reference predictors are measured
            again.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        progress: called as the work advances.

    Raises:
        UsageError: no leaderboard, or ``base`` is no revision of its repository.
        WorkFailedError: a worker that forms the page was lost.
    """
    folder = Folder(board)
    full_registry = registry or load()
    folder.require()

    checks = FolderChecks(
        folder=folder,
        registry=full_registry,
        unreadable=_find_unreadable(folder) if isolated else {},
    )
    checks.run()
    issues = [*checks.issues]
    if base is not None:
        issues += check_base(folder, base, own)

    score_predictions = partial(
        score,
        root=root,
        packages=False,
        registry=full_registry,
        progress=progress,
        write=False,
    )
    rescoring = Rescoring(
        folder=folder,
        entries=checks.entries,
        readable_score_files=checks.readable_score_files,
        score=score_predictions,
    )
    for path in predictions:
        issues += rescoring.rescore(path)
    references, issues_of_references = _measure_references(
        measured_sizes, root, progress
    )
    issues += issues_of_references

    confirmed, partly = _group_confirmed(checks.entries, rescoring.confirmations)
    recorded: list[Entry] = []
    if recording and not issues:
        recorded = confirmed
    record_verified(folder, recorded)

    is_page_checked = page and not issues
    if is_page_checked:
        issues += _check_page(folder, full_registry)
    reproduced_wholly, reproduced_partly = _count_reproduced(checks.verifications)
    return CheckResult(
        folder=folder.path,
        entries=len(folder.entries()),
        findings=tuple(issues),
        page_checked=is_page_checked,
        confirmed=tuple(rescoring.confirmations),
        recorded=tuple(entry.yaml_path.as_posix() for entry in recorded),
        partly=partly,
        reproduced_wholly=reproduced_wholly,
        reproduced_partly=reproduced_partly,
        references=references,
    )


def _find_unreadable(folder: Folder) -> Mapping[Path, str]:
    """Return the score files that a child process cannot read, and why."""
    paths = (*folder.score_files(), *folder.reference_files())
    whole_paths = []
    for path in paths:
        whole_paths.append(folder.path / path)
    return find_unreadable(whole_paths)


def _measure_references(
    sizes: Collection[Size],
    root: str | Path | None,
    progress: Callable[[Progress], None] | None,
) -> tuple[dict[str, tuple[str, ...]], list[ValidationIssue]]:
    """Measure reference predictors again.

    Returns:
        Names of the measured ones by data set, and those with other shipped scores.
    """
    measured = {}
    issues = []
    for size in sizes:
        names, differing = remeasure(size, resolve_root(root), progress=progress)
        measured[f"{size.split} {size.name}"] = names
        issues += _issues_of_measured(size, differing)
    return measured, issues


def _check_page(folder: Folder, registry: Registry) -> list[ValidationIssue]:
    """Return the issue of a page that is not what the entries give, if it is one."""
    try:
        build(folder.path, check=True, registry=registry)
    except WorkFailedError:  # this machine failed, so nothing is known of the page
        raise
    except LagbenchError as error:
        return [issue_from_error("page", error, error.where)]
    return []


def _count_reproduced(verifications: Iterable[Verification]) -> tuple[int, int]:
    """Return how many entries were reproduced on all scenarios, and on some."""
    wholly = 0
    partly = 0
    for verification in verifications:
        if verification.is_reproduced_wholly:
            wholly += 1
        elif verification.is_reproduced:
            partly += 1
    return wholly, partly


def _issues_of_measured(
    size: Size, differing: Mapping[str, Sequence[str]]
) -> list[ValidationIssue]:
    """Return the reference predictors whose shipped scores are not those measured."""
    issues = []
    for name, metrics in differing.items():
        got = f"other {', '.join(metrics[:MOST_METRICS])}"
        if len(metrics) > MOST_METRICS:
            got += f" and {len(metrics) - MOST_METRICS} more metrics"
        where = f"{shipped_path(size).name}, {name}"
        issues.append(make_issue("measured", where, got))
    return issues


def _group_confirmed(
    entries: Sequence[Entry], confirmations: Sequence[Confirmation]
) -> tuple[list[Entry], tuple[str, ...]]:
    """Return the entries with all seeds confirmed, and paths of those with some."""
    confirmed_files = {confirmation.score_file for confirmation in confirmations}
    whole = []
    for entry in entries:
        if confirmed_files.issuperset(entry.score_paths):
            whole.append(entry)
    whole_paths = {entry.yaml_path for entry in whole}
    touched_paths = {confirmation.entry for confirmation in confirmations}
    partly = sorted(path.as_posix() for path in touched_paths - whole_paths)
    return whole, tuple(partly)
