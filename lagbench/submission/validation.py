"""Validate a predictions.nc: make every check and report all issues together.

HDF5 is C code that parses whatever it is given: of 8000 files with one to eight bytes
changed at random four made HDF5 2.0 loop. A file is therefore read in a child process
with limits. A file that loops, crashes or asks for too much ends the child; the parent
reports that and goes on.

A scorer reads the positions once more, to measure them. It must not read before all of
them have passed in the child, and a child that handed them over would copy them. On
cavity mini the second reading takes 2 % of the scorer's processor time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import h5py

from lagbench.data.hdf5 import check_file, open_hdf5
from lagbench.data.layout import ClosedFolderError, expand_home
from lagbench.data.local import (
    load_rooted_registry,
    locate_split,
    resolve_root,
    suggest_split_of,
)
from lagbench.data.registry import Registry, Size
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
)
from lagbench.store.copy import update_working_copy
from lagbench.work.machine import ChildStopped, LimitedChild

from .checks import (
    check_domain,
    check_finite,
    check_frozen,
    check_jumps,
    scan_positions,
)
from .format import (
    MAX_NAME,
    WRITE,
    FileInfo,
    check_dims,
    check_diverged_at,
    check_dtype,
    check_format,
    inspect_file,
    refuse_other_kinds,
)
from .issues import (
    CHECKS,
    IssueCollector,
    Severity,
    ValidationIssue,
    ValidationResult,
    sort_issues,
)
from .other_files import refuse_other_files
from .predictions import attach
from .start import check_shift, check_start, read_starts
from .task_checks import (
    check_dataset,
    check_frames,
    check_particles,
    check_scenarios,
    check_split,
)
from .truth import Truth

CPU_SECONDS = 5.0
"""Computing time for a small file, the start of the child aside [s].

A sound file takes 2 on a busy core.
"""

WALL_SECONDS = 600.0
"""Time for a child and a small file [s]; only a child that waits gets that far.

What computes too long is stopped by the kernel, which counts computing time: on a
machine that is busy with other work a sound file may take minutes.
"""

BYTES_PER_SECOND = 20e6
"""Larger files get more time: a slow reader's speed [bytes/s]."""

BLOCK_BYTES = 512
"""Unit in which a system counts what a file occupies [bytes]."""

TRUTH_CHECKS = ("start", "discontinuous_start", "shifted", "max_displacement")
VALUE_CHECKS = ("finite", "in_domain", *TRUTH_CHECKS)
TASK_CHECKS = ("dataset", "scenarios", "frames", "particles")

Request = Mapping[str, Any]
"""Arguments of a function that a child calls, as JSON holds them."""

Answer = dict[str, Any]
"""What such a function returns."""


def seconds_for(path: Path) -> float:
    """Return the time beyond that of a small file that a file is given [s].

    A sparse file claims any length; what it occupies, where the system tells it, is
    what has to be read.
    """
    status = path.stat()
    byte_count = status.st_size
    block_count: int | None = getattr(status, "st_blocks", None)
    if block_count is not None:
        byte_count = min(byte_count, BLOCK_BYTES * block_count)
    return byte_count / BYTES_PER_SECOND


def validate(
    path: str | Path,
    *,
    split: str | Path | None = None,
    root: str | Path | None = None,
    require_truth: bool = False,
    isolated: bool = True,
    registry: Registry | None = None,
) -> ValidationResult:
    """Check a predictions.nc; what is wrong with it is returned, not raised.

    Args:
        path: the file.
        split: the split to which the predictions must belong, or the path of a local
            split's folder, which then stands for ``root``.
        root: folder of all data sets, else LAGBENCH_ROOT, else the user data folder;
            the checks ``start``, ``discontinuous_start`` and ``max_displacement`` need
            the test subset there.
        require_truth: whether a missing test subset is an error of the check
            ``dataset``, as it is for scoring; else those checks are skipped and say so.
        isolated: whether to read the file in a child process with limits on memory
            and time. Without it a malicious file can stop this process.
        registry: where splits are described; ours when None.

    Returns:
        All issues; ``result.check()`` raises unless the file is valid.
        ``lagbench.score`` takes it, so that nothing is read twice.

    Raises:
        UsageError: there is no such split, or the predictions are for another one.
        UnreadableFileError: the description of the local split is not right.
    """
    expected_split = None
    if split is not None:
        expected_split, root, _ = locate_split(split, root=root, registry=registry)
    result = _validate_file(
        path,
        root=root,
        require_truth=require_truth,
        isolated=isolated,
        registry=registry,
    )
    require_split(result, expected_split)
    return result


def _validate_file(
    path: str | Path,
    *,
    root: str | Path | None,
    require_truth: bool,
    isolated: bool,
    registry: Registry | None,
) -> ValidationResult:
    """Check a predictions.nc for whatever split; :func:`validate` has the arguments."""
    folder = resolve_root(root)
    file = expand_home(path, "path").absolute()
    splits = load_rooted_registry(folder, registry)
    try:
        check_file(file, fix=WRITE)
        with _open_caller(file, isolated=isolated) as caller:
            size, answer = _examine(
                caller, file, folder, splits, require_truth=require_truth
            )
    except UnreadableFileError as error:
        return _unreadable(file, _name_other_file(file, error))

    result = _parse_result(file, answer)
    if size is None or "discontinuous_start" in result.skipped:
        return result
    try:
        Truth(size, folder).check()
    except DataError as error:
        return _without_truth(result, error)
    return result


def _name_other_file(path: Path, error: UnreadableFileError) -> UnreadableFileError:
    """Return the error that names a model or a folder; for other files, the given one.

    Args:
        path: what a user gave in place of predictions.
        error: why it cannot be read.
    """
    try:
        refuse_other_files(path)
    except UnreadableFileError as refusal:
        return refusal
    return error


Caller = Callable[[Callable[[Request], Answer], Request], Answer]
"""Calls a function that reads a file of a stranger."""


@contextmanager
def _open_caller(path: Path, *, isolated: bool) -> Iterator[Caller]:
    """Yield what calls a reading function: here or, if isolated, in a limited child.

    Raises:
        UnreadableFileError: the child had to be stopped.
    """
    if not isolated:
        yield lambda function, request: function(request)
        return
    extra_seconds = seconds_for(path)
    child = LimitedChild(
        __name__,
        seconds=CPU_SECONDS + extra_seconds,
        wall=WALL_SECONDS + extra_seconds,
    )
    with child:
        try:
            yield lambda function, request: child.call(function.__name__, request)
        except ChildStopped as stopped:
            raise UnreadableFileError(
                "reading the file had to be stopped",
                where=str(path),
                expected="a file that HDF5 reads within the limits",
                got=str(stopped),
                fix="the file is damaged or made to do harm; write it again with "
                "lagbench.submission.write",
            ) from None


def _examine(
    caller: Caller,
    path: Path,
    root: Path,
    registry: Registry,
    *,
    require_truth: bool,
) -> tuple[Size | None, Answer]:
    """Return the size that a file names, None if there is none, and its checks.

    The file is opened twice: the test subset, which the checks need, may have to
    be fetched, and that is no work for a child that reads what a stranger wrote.
    """
    names = caller(read_names, {"path": str(path)})
    size, lookup_error = _find_size(names, registry)
    size_json = None
    if size is not None:
        update_working_copy(size, root, size.scored_scenarios)
        size_json = size.model_dump_json()
    request = {
        "path": str(path),
        "root": str(root),
        "size": size_json,
        "lookup_error": lookup_error,
        "require_truth": require_truth,
    }
    return size, caller(run_checks, request)


def read_names(request: Request) -> Answer:
    """Return the split, size and subset that a file names; called in a child.

    They are None where the file names none or cannot be read.
    """
    path = Path(request["path"])
    names: Answer = {"split": None, "size": None, "subset": None}
    try:
        with open_hdf5(path, fix=WRITE) as file:
            info = inspect_file(file, path)
    except UnreadableFileError:
        return names  # run_checks reports it
    for name in names:
        value = info.attributes[name]
        if isinstance(value, str):
            names[name] = value
    return names


def _find_size(
    names: Answer, registry: Registry
) -> tuple[Size | None, Mapping[str, str] | None]:
    """Return the size that a file names, or None and what is wrong with the names."""
    if names["split"] is None or names["size"] is None:
        return None, None
    try:
        size = registry.size(names["split"], names["size"])
    except (UsageError, UnreadableFileError) as error:
        parts = _parts_of(error, where="attributes 'split' and 'size'")
        parts["fix"] += (
            "; predictions for a split of your own are validated and scored with"
            " --split own/, and cannot be submitted"
        )
        return None, parts
    try:
        return size.scored_on(names["subset"] or "test"), None
    except UsageError as error:
        return None, _parts_of(error, where="attribute 'subset'")


def _parts_of(error: LagbenchError, *, where: str) -> dict[str, str]:
    """Return the parts of an error as JSON holds them, with another place.

    Texts with names of the file are cut where they are long.
    """
    fix = error.fix or "name one that there is"
    return {
        "what": error.what[:MAX_NAME],
        "where": where,
        "expected": str(error.expected),
        "got": str(error.got)[:MAX_NAME],
        "fix": fix.splitlines()[0],
    }


def run_checks(request: Request) -> Answer:
    """Make all checks and return the result as JSON holds it; called in a child."""
    path = Path(request["path"])
    root = Path(request["root"])
    size = None
    if request["size"] is not None:
        size = Size.model_validate_json(request["size"], strict=False)

    issues = IssueCollector()
    names: dict[str, str] = {}
    content_hash = None
    try:
        with open_hdf5(path, fix=WRITE) as file:
            info = inspect_file(file, path)
            refuse_other_kinds(info, path)
            for name in ("split", "size", "method"):
                value = info.attributes[name]
                if isinstance(value, str):
                    names[name] = value
            issues.complete("readable")
            size = check_split(
                info, size, lookup_error=request["lookup_error"], issues=issues
            )
            if _check_headers(info, size, root=root, issues=issues) and size:
                content_hash = _check_values(
                    file,
                    path,
                    info=info,
                    truth=Truth(size, root),
                    require_truth=request["require_truth"],
                    issues=issues,
                )
    except UnreadableFileError as error:
        issues.add_exception("readable", error)
        issues.skip("the file cannot be read", *CHECKS)

    result = issues.result(path, sha256=content_hash, **names)
    return dataclasses.asdict(result) | {"path": str(path)}


def _check_headers(
    info: FileInfo, size: Size | None, *, root: Path, issues: IssueCollector
) -> bool:
    """Make the checks that need no positions; return whether positions can be read."""
    has_format = check_format(info, issues)
    dimension = None if size is None else size.dimension
    has_dims = check_dims(info, issues, dimension=dimension)
    has_dtype = check_dtype(info, issues)
    check_diverged_at(info, issues)
    if size is None:
        issues.skip("the split is not known", *TASK_CHECKS, *VALUE_CHECKS)
        return False

    check_dataset(info, size, root, issues)
    check_scenarios(info, size, issues)
    check_frames(info, size, issues)
    has_particles = check_particles(info, size, issues)
    # Far more frames than the task has would make the work as long as the file claims
    # to be.
    task_frames = size.task.input_frames + size.task.horizon
    is_bounded = len(info.integers.get("frame", ())) <= 2 * task_frames
    if has_format and has_dims and has_dtype and has_particles and is_bounded:
        return True
    failed = issues.first_failed("format", "dims", "dtype", "particles", "frames")
    issues.skip(f"{failed} failed", *VALUE_CHECKS)
    return False


def _check_values(
    file: h5py.File,
    path: Path,
    *,
    info: FileInfo,
    truth: Truth,
    require_truth: bool,
    issues: IssueCollector,
) -> str | None:
    """Make the checks that read positions.

    Returns the content hash where all positions were read.
    """
    with ExitStack() as stack:
        predictions = attach(file, path, info, stack)
        scans, content_hash = scan_positions(predictions, truth.size)
        check_finite(scans, issues)
        if not issues.first_failed("diverged_at") and (
            "diverged_at" not in issues.skipped
        ):
            check_frozen(predictions, scans, issues)
        check_domain(scans, truth.size, issues)

        if issues.first_failed("frames") or "frames" in issues.skipped:
            issues.skip("frames failed", *TRUTH_CHECKS)
            return content_hash
        try:
            truth.require()
        except ClosedFolderError as error:
            issues.add_exception("dataset", error)
            issues.skip(f"{error.what}: {error.where}", *TRUTH_CHECKS)
            return content_hash
        except DataError as error:
            if require_truth:
                issues.add_exception("dataset", error)
            issues.skip(f"{error.what} in {truth.root}: {error.fix}", *TRUTH_CHECKS)
            return content_hash
        try:
            starts = read_starts(predictions, truth)
            first_frame = predictions.header.frames[0]
            check_start(starts, first_frame=first_frame, truth=truth, issues=issues)
            check_shift(predictions, truth, issues)
            check_jumps(scans, starts, truth=truth, issues=issues)
        except DataError as error:
            issues.add_exception("dataset", error)
            issues.skip(f"{error.what}: {error.where}", *TRUTH_CHECKS)
        return content_hash


def _parse_result(path: Path, answer: Answer) -> ValidationResult:
    """Return the result that JSON holds."""
    issues = []
    for item in answer["findings"]:
        severity = Severity(item["severity"])
        issues.append(ValidationIssue(**(item | {"severity": severity})))
    fields = {
        **answer,
        "path": path,
        "findings": tuple(issues),
        "passed": tuple(answer["passed"]),
    }
    return ValidationResult(**fields)


def _unreadable(path: Path, error: UnreadableFileError) -> ValidationResult:
    """Return the result for a file that cannot be read."""
    issues = IssueCollector()
    issues.add_exception("readable", error)
    issues.skip("the file cannot be read", *CHECKS)
    return issues.result(path)


def _without_truth(result: ValidationResult, error: DataError) -> ValidationResult:
    """Return a result without the checks that used a damaged truth.

    ``error`` says what is wrong with the truth.
    """
    collector = IssueCollector()
    collector.add_exception("dataset", error)
    issues = []
    for issue in result.findings:
        if issue.check not in TRUTH_CHECKS:
            issues.append(issue)
    issues += collector.result(result.path).findings
    passed = []
    for check in result.passed:
        if check not in ("dataset", *TRUTH_CHECKS):
            passed.append(check)
    skipped = dict(result.skipped)
    for check in TRUTH_CHECKS:
        skipped[check] = f"{error.what}: {error.where}"
    return dataclasses.replace(
        result, findings=sort_issues(issues), passed=tuple(passed), skipped=skipped
    )


def require_split(result: ValidationResult, expected_split: str | None) -> None:
    """Refuse predictions for another split than the expected one.

    Predictions that name no split pass here; their validation rejects them.

    Raises:
        UsageError: the predictions are for another split.
    """
    if expected_split is None or result.split in (None, expected_split):
        return
    raise UsageError(
        "the predictions are for another split",
        where=str(result.path),
        expected=expected_split,
        got=ascii(result.split),
        fix=suggest_split_of(result.split),
    )
