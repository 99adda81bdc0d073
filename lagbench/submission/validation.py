"""Validate a predictions.nc: every named check, all findings together, in a child with
limits.

HDF5 is C code that parses whatever it is given: of 8000 files with one to eight bytes
changed at random four made HDF5 2.0 loop. What loops, crashes or asks for too much ends
a child process; the parent says so and goes on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py

from lagbench.data.hdf5 import check_file, open_hdf5
from lagbench.data.local import RootedRegistry, load_rooted_registry, resolve_root
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UnreadableFileError, UsageError, suggest_name
from lagbench.work.machine import run_in_child

from .checks import check_domain, check_finite, check_frozen, check_jumps, survey
from .findings import CHECKS, Finding, Findings, Severity, ValidationResult
from .format import (
    WRITE,
    Anatomy,
    check_dims,
    check_dtype,
    check_format,
    check_marks,
    dissect,
    refuse_other_kinds,
)
from .predictions import attach
from .start import check_start, read_starts
from .task_checks import (
    check_dataset,
    check_frames,
    check_particles,
    check_scenarios,
    check_split,
)
from .truth import Truth

CPU_SECONDS = 5.0
"""Computing time for a small file, the start of the child aside [s]; a sound one takes
2 on a busy core.
"""

WALL_SECONDS = 600.0
"""Time for a child and a small file [s]; only a child that waits gets that far.

What computes too long is stopped by the kernel, which counts computing time: on a
machine that is busy with other work a sound file may take minutes.
"""

BYTES_PER_SECOND = 20e6
"""Larger files get more time: a slow reader's speed [bytes/s]."""

TRUE = ("start", "discontinuous_start", "max_displacement")
VALUES = ("finite", "in_domain", *TRUE)
TASK = ("dataset", "scenarios", "frames", "particles")


def seconds_for(path: Path) -> float:
    """Return the time beyond that of a small file that a file is given [s].

    A sparse file claims any length; what it occupies, where the system tells it, is
    what has to be read.
    """
    status = path.stat()
    blocks: int | None = getattr(status, "st_blocks", None)
    return (
        status.st_size if blocks is None else min(status.st_size, 512 * blocks)
    ) / BYTES_PER_SECOND


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
        root: folder of all data sets, else LAGBENCH_ROOT, else the user data folder;
            the checks ``start``, ``discontinuous_start`` and ``max_displacement`` need
            the test subset there.
        require_truth: whether a missing test subset is an error of the check
            ``dataset``, as it is for scoring; else those checks are skipped and say so.
        isolated: whether to look at the file in a child process with limits on memory
            and time. Without it a malicious file can stop this process.
        registry: where splits are described; ours when None.

    Returns:
        What was found; ``result.check()`` raises unless the file is valid.
        ``lagbench.score`` takes it, so that nothing is read twice.
    """
    folder = resolve_root(root)
    file = Path(path).absolute()
    known = load_rooted_registry(folder, registry)
    if isolated:
        look = _isolated
    else:
        look = _examine
    result = look(file, folder, known, require_truth=require_truth)
    if result.split is None or result.size is None or "split" not in result.passed:
        return result
    size = known.size(result.split, result.size)
    # Only the file says which test subset it needs; the child that reads it fetches
    # nothing.
    from lagbench.store.copy import update_working_copy

    if update_working_copy(size, folder, size.subsets["test"]):
        result = look(file, folder, known, require_truth=require_truth)
    if "discontinuous_start" in result.skipped:
        return result
    try:
        Truth(size, folder).check()
    except DataError as error:
        # What was said by a truth that is not the one of the registry is taken back.
        out = Findings()
        out.raised("dataset", error)
        findings = [f for f in result.findings if f.check not in TRUE]
        findings += out.result(result.path).findings
        return dataclasses.replace(
            result,
            findings=tuple(sorted(findings, key=lambda f: CHECKS.index(f.check))),
            passed=tuple(
                check for check in result.passed if check not in ("dataset", *TRUE)
            ),
            skipped={
                **result.skipped,
                **dict.fromkeys(TRUE, f"{error.what}: {error.where}"),
            },
        )
    return result


def _isolated(
    path: Path, root: Path, registry: Registry, *, require_truth: bool
) -> ValidationResult:
    """Examine a file in a child process; whatever stops the child fails the check
    ``readable``.
    """
    request = {
        "path": str(path),
        "root": str(root),
        "require_truth": require_truth,
        "sizes": {
            split: {
                name: registry.size(split, name).model_dump_json()
                for name in found.sizes
            }
            for split, found in registry.splits.items()
        },
    }
    try:
        check_file(path, fix=WRITE)
        extra = seconds_for(path)
        seconds = CPU_SECONDS + extra
        wall = WALL_SECONDS + extra
        values, stopped = run_in_child(
            f"{__name__}.{examine.__name__}", [request], seconds=seconds, wall=wall
        )
        if not values:
            raise UnreadableFileError(
                "reading the file had to be stopped",
                where=str(path),
                expected="a file that HDF5 reads within the limits",
                got=stopped,
                fix="the file is damaged or made to do harm; write it again with "
                "lagbench.submission.write",
            )
    except UnreadableFileError as error:
        out = Findings()
        out.raised("readable", error)
        out.skip("the file cannot be read", *CHECKS)
        return out.result(path)
    said = values[0]
    findings = tuple(
        Finding(**{**f, "severity": Severity(f["severity"])}) for f in said["findings"]
    )
    return ValidationResult(
        **{**said, "path": path, "findings": findings, "passed": tuple(said["passed"])}
    )


class _Sizes(RootedRegistry):
    """The sizes that a parent sent, and the local splits of its root folder."""

    def __init__(self, sent: Mapping[str, Mapping[str, str]], root: Path) -> None:
        super().__init__(Registry({}, {}), root)
        self.sent = sent

    def size(self, split: str, name: str) -> Size:
        """Return one size of a split."""
        if split in self.sent and name in self.sent[split]:
            return Size.model_validate_json(self.sent[split][name], strict=False)
        if split in self.sent:
            raise UsageError(
                f"split {split!r} has no size {name!r}",
                fix=suggest_name(name, self.sent[split]),
            )
        if split not in self.local_names():
            raise UsageError(
                f"no split {split!r}",
                fix=suggest_name(split, [*self.sent, *self.local_names()]),
            )
        return super().size(split, name)


def examine(request: Mapping[str, Any]) -> Mapping[str, Any]:
    """Make all checks in this process, for a parent."""
    path = Path(request["path"])
    root = Path(request["root"])
    result = _examine(
        path,
        root,
        _Sizes(request["sizes"], root),
        require_truth=request["require_truth"],
    )
    return dataclasses.asdict(result) | {"path": str(path)}


def _examine(
    path: Path, root: Path, registry: Registry, *, require_truth: bool
) -> ValidationResult:
    out = Findings()
    names: dict[str, str] = {}
    content = None
    try:
        with open_hdf5(path, fix=WRITE) as file:
            anatomy = dissect(file, path)
            refuse_other_kinds(anatomy, path)
            texts = {
                name: anatomy.attributes[name] for name in ("split", "size", "method")
            }
            names = {
                name: text for name, text in texts.items() if isinstance(text, str)
            }
            out.made("readable")
            size = _check_layout_and_task(anatomy, registry, root, out)
            if size is not None:
                content = _check_values(
                    file, path, anatomy, Truth(size, root), require_truth, out
                )
    except UnreadableFileError as error:
        out.raised("readable", error)
        out.skip("the file cannot be read", *CHECKS)
    return out.result(path, sha256=content, **names)


def _check_layout_and_task(
    anatomy: Anatomy, registry: Registry, root: Path, out: Findings
) -> Size | None:
    """Make the checks that need no values; return the size if the values can be looked
    at.
    """
    stored, laid_out, typed = (
        check(anatomy, out) for check in (check_format, check_dims, check_dtype)
    )
    check_marks(anatomy, out)
    size = check_split(anatomy, registry, out)
    if size is None:
        out.skip("the split is not known", *TASK, *VALUES)
        return None
    check_dataset(anatomy, size, root, out)
    check_scenarios(anatomy, size, out)
    check_frames(anatomy, size, out)
    sized = check_particles(anatomy, size, out)
    # Frames far beyond the horizon would make the work as long as the file claims to
    # be.
    bounded = len(anatomy.integers.get("frame", ())) <= 2 * (
        size.task.input_frames + size.task.horizon
    )
    if stored and laid_out and typed and sized and bounded:
        return size
    out.skip(
        f"{out.failed('format', 'dims', 'dtype', 'particles', 'frames')} failed",
        *VALUES,
    )
    return None


def _check_values(
    file: h5py.File,
    path: Path,
    anatomy: Anatomy,
    truth: Truth,
    require_truth: bool,
    out: Findings,
) -> str | None:
    """Make the checks that read positions; return the content hash where all were
    read.
    """
    with ExitStack() as stack:
        predictions = attach(file, path, anatomy, stack)
        surveys, content = survey(predictions, truth.size)
        check_finite(surveys, out)
        if not out.failed("diverged_at") and "diverged_at" not in out.skipped:
            check_frozen(predictions, surveys, out)
        check_domain(surveys, truth.size, out)
        if out.failed("frames") or "frames" in out.skipped:
            out.skip("frames failed", *TRUE)
            return content
        try:
            truth.require()
        except DataError as error:
            if require_truth:
                out.raised("dataset", error)
            out.skip(f"{error.what} in {truth.root}: {error.fix}", *TRUE)
            return content
        try:
            starts = read_starts(predictions, truth)
            check_start(starts, predictions.header.frames[0], truth, out)
            check_jumps(surveys, starts, truth, out)
        except DataError as error:
            out.raised("dataset", error)
            out.skip(f"{error.what}: {error.where}", *TRUE)
        return content
