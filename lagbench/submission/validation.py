"""Validate a predictions.nc: every named check, all findings together.

A stranger's file can make HDF5 loop, crash or ask for all memory (HDF5 2.0 looped on 4 of 8000
files with one to eight bytes changed at random). So the checks run in a child process with
limits, see sandbox.py.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import h5py

from lagbench.data.layout import resolve_root
from lagbench.data.local import rooted
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UnreadableFileError, UsageError

from .anatomy import Anatomy, dissect
from .findings import CHECKS, Findings, ValidationResult
from .format_checks import check_dims, check_dtype, check_format, check_marks
from .opening import check_file, opened
from .reader import Predictions, attach
from .sandbox import Request, run_isolated
from .task_checks import check_dataset, check_frames, check_particles, check_scenarios, check_split
from .truth import Truth
from .value_checks import Survey, check_domain, check_finite, check_frozen, check_jumps, check_start, survey

__all__ = ["examine", "validate"]

TRUE = ("start", "max_displacement")
VALUES = ("finite", "in_domain", *TRUE)
TASK = ("dataset", "scenarios", "frames", "particles")


def validate(
    path: str | Path,
    *,
    root: str | Path | None = None,
    require_truth: bool = False,
    isolated: bool = True,
    registry: Registry | None = None,
) -> ValidationResult:
    """Check a predictions.nc; nothing is raised for what is wrong with it.

    Args:
        path: the file.
        root: folder of all data sets, see :func:`lagbench.data.layout.resolve_root`; the checks
            ``start`` and ``max_displacement`` need the test subset there.
        require_truth: whether a missing test subset is an error of the check ``dataset``, as it
            is for scoring; else those checks are skipped and say so.
        isolated: whether to look at the file in a child process with limits on memory and time.
            Without it a malicious file can stop this process.
        registry: where splits are described; ours when None.

    Returns:
        What was found; ``result.check()`` raises unless the file is valid.
    """
    folder = resolve_root(root)
    request = Request(
        path=Path(path).absolute(),
        root=folder,
        require_truth=require_truth,
        registry=rooted(folder, registry),
    )
    if isolated:
        try:
            check_file(request.path)
        except UnreadableFileError as error:
            return _unreadable(request.path, error)
    look = run_isolated if isolated else examine
    result = look(request)
    # Only the file says which test subset it needs; the child that reads it fetches nothing.
    return look(request) if _brought(result, request) else result


def _brought(result: ValidationResult, request: Request) -> bool:
    """Bring the test subset that a file is for, where data live in a store; return whether any came."""
    if result.split is None or result.size is None:
        return False
    try:
        size = request.registry.size(result.split, result.size)
    except UsageError:
        return False
    from lagbench.store.copy import bring

    return bring(size, request.root, size.subsets["test"])


def examine(request: Request) -> ValidationResult:
    """Make all checks in this process."""
    out = Findings()
    names: dict[str, str] = {}
    try:
        with opened(request.path) as file:
            anatomy = dissect(file, request.path)
            texts = {name: anatomy.attributes[name] for name in ("split", "size", "method")}
            names = {name: text for name, text in texts.items() if isinstance(text, str)}
            out.made("readable")
            _examine(request, file, anatomy, out)
    except UnreadableFileError as error:
        _report_unreadable(error, out)
    return out.result(request.path, **names)


def _examine(request: Request, file: h5py.File, anatomy: Anatomy, out: Findings) -> None:
    stored = check_format(anatomy, out)
    laid_out = check_dims(anatomy, out)
    typed = check_dtype(anatomy, out)
    marked = check_marks(anatomy, out)
    size = check_split(anatomy, request.registry, out)
    if size is None:
        out.skip("the split is not known", *TASK, *VALUES)
        return
    check_dataset(anatomy, size, request.root, out)
    check_scenarios(anatomy, size, out)
    in_time = check_frames(anatomy, size, out)
    sized = check_particles(anatomy, size, out)
    # Frames far beyond the horizon would make the work as long as the file claims to be.
    bounded = len(anatomy.integers.get("frame", ())) <= 2 * (size.task.input_frames + size.task.horizon)
    if not (stored and laid_out and typed and sized and bounded):
        out.skip(f"{out.failed('format', 'dims', 'dtype', 'particles', 'frames')} failed", *VALUES)
        return
    with ExitStack() as stack:
        predictions = attach(file, request.path, anatomy, stack)
        surveys = survey(predictions, size)
        check_finite(surveys, out)
        if marked:
            check_frozen(predictions, surveys, out)
        check_domain(surveys, size, out)
        if not in_time:
            out.skip("frames failed", *TRUE)
            return
        _compare(predictions, surveys, Truth(size, request.root), request.require_truth, out)


def _compare(
    predictions: Predictions, surveys: list[Survey], truth: Truth, require_truth: bool, out: Findings
) -> None:
    try:
        truth.require()
    except DataError as error:
        if require_truth:
            _report_dataset(error, out)
        reason = f"{error.what} in {truth.root}"
        out.skip(f"{reason}: {error.fix}", *TRUE)
        return
    try:
        check_start(predictions, truth, out)
        check_jumps(surveys, truth, out)
    except DataError as error:
        _report_dataset(error, out)
        out.skip(f"{error.what}: {error.where}", *TRUE)


def _report_dataset(error: DataError, out: Findings) -> None:
    out.error(
        "dataset",
        error.what,
        where=error.where or "the data set",
        expected=error.expected or "an undamaged data set",
        got=error.got or "a damaged one",
        fix=error.fix or "lagbench verify says what is wrong",
    )


def _report_unreadable(error: UnreadableFileError, out: Findings) -> None:
    out.error(
        "readable",
        error.what,
        where=error.where or "the file",
        expected=error.expected or "a netCDF4 file",
        got=error.got,
        fix=error.fix or "write it again",
    )
    out.skip("the file cannot be read", *CHECKS)


def _unreadable(path: Path, error: UnreadableFileError) -> ValidationResult:
    out = Findings()
    _report_unreadable(error, out)
    return out.result(path)
