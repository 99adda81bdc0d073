"""Validate a predictions.nc: make every check and report all issues together.

Sizes, types and storage are checked before a value is read. HDF5 itself trusts its
input: files of strangers are read in a container or under ``prlimit``
(docs/threats.md).
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import h5py

from lagbench.data.hdf5 import check_file, open_hdf5
from lagbench.data.layout import expand_home
from lagbench.data.local import (
    load_rooted_registry,
    locate_split,
    resolve_root,
    suggest_split_of,
)
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.store.copy import update_working_copy

from .checks import (
    check_domain,
    check_finite,
    check_frozen,
    check_jumps,
    scan_positions,
)
from .format import (
    WRITE,
    FileInfo,
    check_dims,
    check_diverged_at,
    check_dtype,
    check_format,
    inspect_file,
    refuse_other_kinds,
)
from .issues import CHECKS, IssueCollector, ValidationResult
from .predictions import attach
from .start import check_shift, check_start, read_starts
from .task_checks import (
    check_dataset,
    check_frames,
    check_particles,
    check_scenarios,
    find_size,
)
from .truth import Truth

TRUTH_CHECKS = ("start", "discontinuous_start", "shifted", "max_displacement")
VALUE_CHECKS = ("finite", "in_domain", *TRUTH_CHECKS)
TASK_CHECKS = ("dataset", "scenarios", "frames", "particles")


def validate(
    path: str | Path,
    *,
    split: str | Path | None = None,
    root: str | Path | None = None,
    require_truth: bool = False,
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
    folder = resolve_root(root)
    file = expand_home(path, "path").absolute()
    splits = load_rooted_registry(folder, registry)

    issues = IssueCollector()
    names: dict[str, str] = {}
    content_hash = None
    try:
        check_file(file, fix=WRITE)
        with open_hdf5(file, fix=WRITE) as opened:
            info = inspect_file(opened, file)
            refuse_other_kinds(info, file)
            for name in ("split", "size", "method"):
                value = info.attributes[name]
                if isinstance(value, str):
                    names[name] = value
            issues.complete("readable")
            size = find_size(info, splits, issues)
            if size is not None:
                update_working_copy(size, folder, size.scored_scenarios)
            if _check_headers(info, size, root=folder, issues=issues) and size:
                content_hash = _check_values(
                    opened,
                    file,
                    info=info,
                    truth=Truth(size, folder),
                    require_truth=require_truth,
                    issues=issues,
                )
    except UnreadableFileError as error:
        issues.add_exception("readable", error)
        issues.skip("the file cannot be read", *CHECKS)

    result = issues.result(file, sha256=content_hash, **names)
    require_split(result, expected_split)
    return result


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
    """Make the checks that read positions; return their content hash."""
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
        except DataError as error:
            if require_truth:
                issues.add_exception("dataset", error)
            issues.skip(f"{error.what} in {truth.root}: {error.fix}", *TRUTH_CHECKS)
            return content_hash
        try:
            truth.check()
            starts = read_starts(predictions, truth)
            first_frame = predictions.header.frames[0]
            check_start(starts, first_frame=first_frame, truth=truth, issues=issues)
            check_shift(predictions, truth, issues)
            check_jumps(scans, starts, truth=truth, issues=issues)
        except DataError as error:
            issues.add_exception("dataset", error)
            issues.skip(error.what, *TRUTH_CHECKS)
        return content_hash


def require_split(result: ValidationResult, expected_split: str | None) -> None:
    """Refuse predictions for another split than the expected one.

    Predictions that name no split pass here; their validation rejects them.

    Raises:
        UsageError: the predictions are for another split.
    """
    if expected_split is None or result.split in (None, expected_split):
        return
    raise UsageError(
        f"{result.path} holds predictions for {result.split!a}, not for "
        f"{expected_split}; {suggest_split_of(result.split)}"
    )
