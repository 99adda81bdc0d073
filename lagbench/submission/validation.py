"""Validate a predictions.nc: make every check and report all issues together.

Sizes, types and storage are checked before a value is read. HDF5 itself trusts its
input: files of strangers are read in a container or under ``prlimit``
(docs/threats.md).

A bad model is scored, whatever it predicts. Apart from values that are not finite or
far beyond the box, positions are refused only where the first frame holds exactly the
true positions, or the last given ones, in another order of the particles: no model
predicts that, so it can only be a mistake of the file.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import AXES, Box
from lagbench.data.checksums import round_digits
from lagbench.data.hdf5 import open_hdf5
from lagbench.data.judgement import find_shift
from lagbench.data.layout import expand_home, format_ids, major_of, quote_root
from lagbench.data.local import (
    load_rooted_registry,
    locate_split,
    resolve_root,
    suggest_repair,
    suggest_split_of,
)
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.store.copy import update_working_copy

from .format import HASH, MAX_NAME, WRITE, FileInfo, check_layout, inspect_file
from .issues import CHECKS, IssueCollector, ValidationResult, quote
from .predictions import Predictions, attach
from .truth import (
    Truth,
    dataset_hash_of,
    frames_to_predict,
    max_test_particles,
    squared_lengths,
    squared_steps,
)

TRUTH_CHECKS = ("start", "discontinuous_start", "shifted", "max_displacement")
VALUE_CHECKS = ("finite", "in_domain", *TRUTH_CHECKS)
TASK_CHECKS = ("dataset", "scenarios", "frames", "particles")

VERSION = re.compile(r"[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}")

JUMP = 10.0
"""A step is suspect beyond this many of the truth's largest per-frame displacement."""

SHIFT_FRAMES = 5
"""First predicted frames that are compared with the true ones before and after."""

MAX_DISTANCE = 10.0
"""Farthest outside the walls that a position may be [length]; the box has length 1."""

MAX_PERIODS = 1.0
"""Farthest outside the box along a periodic axis without a warning [period]."""

FILL = np.float32(9.969209968386869e36)
"""What netCDF puts where a float32 was never written."""

Block = NDArray[np.float32]
"""Consecutive frames of positions [length], shape [frame, particle, space]."""


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
            the checks ``start``, ``discontinuous_start``, ``shifted`` and
            ``max_displacement`` need the test subset there.
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
        with open_hdf5(file, fix=WRITE) as opened:
            info = inspect_file(opened, file)
            for name in ("split", "size", "method"):
                value = info.attributes.get(name)
                if isinstance(value, str):
                    names[name] = value
            size = None
            subset = str(info.attributes.get("subset", "test"))
            if {"split", "size"} <= names.keys():
                try:
                    tier = splits.size(names["split"], names["size"])
                    size = tier.scored_on(subset)
                except (UsageError, UnreadableFileError) as error:
                    issues.error(
                        "split",
                        f"{error.text[:MAX_NAME]}; name a split of your own by "
                        "--split own/",
                        where=f"split {quote(names['split'])}, size "
                        f"{quote(names['size'])}, subset {quote(subset)}",
                    )
            else:
                issues.skip("the file does not name its split and size", "split")
            dimension = None if size is None else size.dimension
            is_readable = check_layout(info, issues, dimension=dimension)
            if size is None:
                issues.skip("the split is not known", *TASK_CHECKS, *VALUE_CHECKS)
            else:
                update_working_copy(size, folder, size.scored_scenarios)
                is_bounded = _check_task(info, size, folder, issues)
                if is_readable and is_bounded:
                    content_hash = _check_values(
                        opened,
                        file,
                        info=info,
                        truth=Truth(size, folder),
                        require_truth=require_truth,
                        issues=issues,
                    )
                else:
                    issues.skip("the positions do not fit the task", *VALUE_CHECKS)
    except UnreadableFileError as error:
        issues.add_exception("readable", error)
        issues.skip("the file cannot be read", *CHECKS)

    result = issues.result(file, sha256=content_hash, **names)
    require_split(result, expected_split)
    return result


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


def _check_task(info: FileInfo, size: Size, root: Path, issues: IssueCollector) -> bool:
    """Check data set, scenarios, frames and particles.

    Returns:
        Whether there are as many particles as the task has, and not far more frames.
    """
    name = f"{size.split} {size.name}"
    predict_again = f"predict again, from {name} {size.version}"
    version = info.attributes.get("dataset_version")
    stored_hash = info.attributes.get("dataset_sha256")
    if isinstance(version, str) and isinstance(stored_hash, str):
        if not VERSION.fullmatch(version) or major_of(version) != size.major:
            issues.error(
                "dataset",
                f"the predictions are for version {quote(version)} of the data, not "
                f"{size.version}; {predict_again}",
                where="attribute 'dataset_version'",
            )
        where = "attribute 'dataset_sha256'"
        recorded_hash = dataset_hash_of(size, root)
        if recorded_hash is None and HASH.fullmatch(stored_hash):
            issues.warning(
                "dataset",
                f"the hash cannot be compared: neither {size.record_name} nor a "
                f"complete manifest has that of {name}; "
                f"{suggest_repair(size, root=root)}",
                where=where,
            )
        elif stored_hash != recorded_hash:
            issues.error(
                "dataset",
                f"the predictions were made from another data set; {predict_again} "
                f"(lagbench verify --split {size.split} --size {size.name} --root "
                f"{quote_root(root)} tells whether it lies here)",
                where=where,
            )
    else:
        issues.skip("the file does not name its data set", "dataset")

    stored = info.integers.get("scenario", ())
    if "scenario" in info.integers:
        scored = set(size.scored_scenarios)
        repeated = [i for i, count in Counter(stored).items() if count > 1]
        for kind, wrong in (
            ("missing", scored - set(stored)),
            ("unknown", set(stored) - scored),
            ("repeated", repeated),
        ):
            if wrong:
                issues.error(
                    "scenarios",
                    f"{kind} scenarios: {quote(sorted(wrong))}; store each test "
                    f"scenario once: {format_ids(size.scored_scenarios)}",
                    where="coordinate 'scenario'",
                )
    else:
        issues.skip("the coordinate 'scenario' cannot be read", "scenarios")

    frames = info.integers.get("frame", ())
    to_predict = frames_to_predict(size)
    if "frame" not in info.integers:
        issues.skip("the coordinate 'frame' cannot be read", "frames")
    elif list(frames) != list(to_predict):
        issues.error(
            "frames",
            f"{len(frames)} frames: {quote(list(frames))}; store the frames "
            f"{to_predict[0]} to {to_predict[-1]}, each once, ascending; frame 0 is "
            "the first given one",
            where="coordinate 'frame'",
        )

    position = info.arrays.get("position")
    shape = None if position is None else position.shape
    if shape is None or len(shape) != 4 or issues.first_failed("dims"):
        issues.skip("the dimensions are not known", "particles")
        return False
    most = max_test_particles(size)
    counts = info.integers.get("particle_count", (most,) * len(stored))
    wrong_counts = {}
    for scenario, count in zip(stored, counts, strict=False):
        is_known = scenario in size.scored_scenarios
        if is_known and count != size.particle_count(scenario):
            wrong_counts[scenario] = count
    what = None
    if shape[2] != most:
        what = f"{shape[2]} particles, not {most}"
    elif wrong_counts:
        what = f"wrong numbers of particles by scenario: {quote(wrong_counts)}"
    if what is not None:
        issues.error(
            "particles",
            f"{what}; predict every particle of {name}, in the order of the given "
            "frames",
            where="variable 'position', dimension 'particle'",
        )
        return False
    # Far more frames than the task has would make the work as long as the file claims
    # to be.
    return len(frames) <= 2 * to_predict.stop


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
    size = truth.size
    with ExitStack() as stack:
        predictions = attach(file, path, info, stack)
        header = predictions.header
        known = sorted(set(header.scenarios).intersection(size.scored_scenarios))
        hasher = predictions.start_hash()
        scans = []
        for scenario in known:
            scan = ScenarioScan(scenario)
            for first, block in predictions.blocks(scenario):
                hasher.update("position", predictions.pad(block))
                scan.add(first, block, size)
            scans.append(scan)
        content_hash = None
        if known == sorted(header.scenarios):
            content_hash = hasher.hexdigest()

        check_finite(scans, issues)
        check_domain(scans, size, issues)
        if not issues.first_failed("diverged_at"):
            for scan in scans:
                frozen_from = header.diverged_at.get(scan.scenario)
                if frozen_from is not None and scan.last_moving_frame > frozen_from:
                    issues.error(
                        "diverged_at",
                        f"the rollout moves after frame {frozen_from}, from which it "
                        "should be frozen; repeat its last finite frame, or leave "
                        "'diverged_at' out",
                        where=f"scenario {scan.scenario}, frame "
                        f"{scan.last_moving_frame}",
                    )

        if issues.first_failed("frames"):
            issues.skip("frames failed", *TRUTH_CHECKS)
            return content_hash
        try:
            truth.require()
        except DataError as error:
            if require_truth:
                issues.add_exception("dataset", error)
            issues.skip(f"{error.text} in {truth.root}", *TRUTH_CHECKS)
            return content_hash
        try:
            truth.check()
            _compare_with_truth(predictions, scans, truth, issues)
        except DataError as error:
            issues.add_exception("dataset", error)
            issues.skip("the data set is damaged", *TRUTH_CHECKS)
        return content_hash


@dataclass
class ScenarioScan:
    """What one pass over a scenario's predictions saw."""

    scenario: int
    position_count: int = 0
    bad_values: int = 0  # values that are not finite, or were never written
    # frame, particle and component
    first_bad: tuple[int, ...] | None = None
    outside_box: int = 0  # positions more than a solver cell outside the box
    farthest: float = 0.0  # largest distance outside the walls along an axis [length]
    farthest_at: tuple[int, ...] = ()  # frame and particle
    most_periods: float = 0.0  # largest distance outside along a periodic axis [period]
    most_periods_at: tuple[int, ...] = ()  # frame, particle and axis
    jump_square: float = 0.0  # largest squared step of a particle [length^2]
    jump_at: tuple[int, int] | None = None  # frame and particle
    last_moving_frame: int = 0  # frame that is repeated from there to the end
    _last_frame: Block | None = None

    @property
    def jump(self) -> float:
        """Largest distance of a particle between consecutive frames [length]."""
        return math.sqrt(self.jump_square)

    def add(self, first: int, block: Block, size: Size) -> None:
        """Take in consecutive frames, the first of which has the number ``first``."""
        box = size.box
        # One pass over sound values; a comparison with NaN is false.
        if not (block.min(initial=0.0) > -np.inf and block.max(initial=0.0) < FILL):
            is_bad = ~np.isfinite(block) | (block == FILL)
            if is_bad.any() and self.first_bad is None:
                self.first_bad = _place(is_bad, first)
            self.bad_values += int(np.count_nonzero(is_bad))
            block = np.where(is_bad, np.float32(np.nan), block)

        self.position_count += block[..., 0].size
        cell = 1.0 / size.grid
        if not is_inside(block, box, slack=cell):  # rare, and 20 times as slow
            # distance outside the box along an axis, shape [frame, particle]
            below = box.lower_walls - block
            above = block - box.upper_walls
            beyond = np.nan_to_num(np.fmax(below, above).max(axis=-1))
            self.outside_box += int(np.count_nonzero(beyond > cell))
            farthest = float(beyond.max())
            if farthest > max(cell, self.farthest):
                self.farthest = farthest
                self.farthest_at = _place(beyond == farthest, first)
        if box.is_periodic:
            outside = np.fmax(box.low - block, block - box.high) / box.lengths
            periods = np.nan_to_num(np.where(box.periodic, outside, 0.0))
            most = float(periods.max(initial=0.0))
            if most > self.most_periods:
                self.most_periods = most
                self.most_periods_at = _place(periods == most, first)

        frames = block
        first_step = first + 1
        if self._last_frame is None:
            self.last_moving_frame = first
        else:
            frames = np.concatenate([self._last_frame, block])
            first_step = first
        has_moved = (frames[1:] != frames[:-1]).any(axis=(1, 2))
        if has_moved.any():
            self.last_moving_frame = first_step + int(np.flatnonzero(has_moved)[-1])
        self.add_steps(first_step, frames, box)
        self._last_frame = block[-1:].copy()

    def add_steps(self, first: int, frames: NDArray[np.floating], box: Box) -> None:
        """Take in the lengths of steps; the first leads to the frame ``first``."""
        before = frames[0].astype(np.float64)
        # A frame fits the cache of a processor, a block does not.
        for step, frame in enumerate(frames[1:]):
            after = frame.astype(np.float64)
            squares = squared_lengths(box.displacement(before, after))
            before = after
            if np.isnan(squares.max()):
                squares = np.nan_to_num(squares)
            largest = float(squares.max())
            if largest > self.jump_square:
                self.jump_square = largest
                self.jump_at = (first + step, int(squares.argmax()))


def _place(mask: NDArray[np.bool_], first: int) -> tuple[int, ...]:
    """Return the index of the first true value, its frame as an absolute number."""
    frame, *rest = (int(places[0]) for places in np.nonzero(mask))
    return (first + frame, *rest)


def is_inside(block: Block, box: Box, *, slack: float) -> bool:
    """Return whether no position lies more than a slack [length] beyond a wall.

    NaN is not inside.
    """
    walls = zip(box.lower_walls, box.upper_walls, strict=True)
    for axis, (lowest, highest) in enumerate(walls):
        values = block[..., axis]
        beyond_low = lowest - values.min()
        beyond_high = values.max() - highest
        if not (beyond_low <= slack and beyond_high <= slack):
            return False
    return True


def check_finite(scans: list[ScenarioScan], issues: IssueCollector) -> None:
    """Report values that are NaN, infinite or were never written."""
    bad_scans = [scan for scan in scans if scan.first_bad is not None]
    if bad_scans and bad_scans[0].first_bad is not None:
        frame, particle, axis = bad_scans[0].first_bad
        issues.error(
            "finite",
            f"{sum(scan.bad_values for scan in scans)} values are not finite, or were "
            "never written; freeze a diverging rollout at its last finite frame and "
            "name it in diverged_at",
            where=f"first in scenario {bad_scans[0].scenario}, frame {frame}, particle "
            f"{particle}, {AXES[axis]}",
        )


def check_domain(scans: list[ScenarioScan], size: Size, issues: IssueCollector) -> None:
    """Flag positions outside the box; refuse those beyond ten boxes."""
    astray = max(scans, key=lambda scan: scan.most_periods, default=None)
    if astray is not None and astray.most_periods > MAX_PERIODS:
        frame, particle, axis = astray.most_periods_at
        issues.warning(
            "in_domain",
            f"positions lie {astray.most_periods:.3g} periods outside the box; wrap "
            "them; where the model moves particles that far, leave it: their images in "
            "the box are scored",
            where=f"scenario {astray.scenario}, frame {frame}, particle {particle}, "
            f"{AXES[axis]}",
        )
    lost = max(scans, key=lambda scan: scan.farthest, default=None)
    if lost is None or not lost.farthest_at:
        return
    frame, particle = lost.farthest_at
    where = f"farthest in scenario {lost.scenario}, frame {frame}, particle {particle}"
    if lost.farthest > MAX_DISTANCE:
        issues.error(
            "in_domain",
            f"positions lie {lost.farthest:.3g} beyond the walls, more than "
            f"{MAX_DISTANCE:g}: they would ruin every mean; give them in lengths of "
            "the unit box, or freeze a diverging rollout before",
            where=where,
        )
        return
    position_count = sum(scan.position_count for scan in scans)
    share = sum(scan.outside_box for scan in scans) / position_count
    issues.warning(
        "in_domain",
        f"{share:.2%} of the positions lie outside the box, up to {lost.farthest:.3g} "
        f"beyond its walls; the unit is the side of the unit box",
        where=where,
        share=round_digits(share, 4),
    )


def _compare_with_truth(
    predictions: Predictions,
    scans: list[ScenarioScan],
    truth: Truth,
    issues: IssueCollector,
) -> None:
    """Refuse permuted particles; flag jumps, and rollouts that are late or early."""
    box = truth.size.box
    first = frames_to_predict(truth.size)[0]
    count = min(SHIFT_FRAMES, truth.size.task.horizon - 2)
    shifts = set()
    for scan in scans:
        scenario = scan.scenario
        # from the last but one given frame on
        true = truth.frames(scenario, first - 2, first + count + 2)
        begin = predictions.frames(scenario, first, max(1, count))
        where = f"scenario {scenario}, frame {first}"
        if is_permutation(begin[0], true[2]) or is_permutation(begin[0], true[1]):
            issues.error(
                "start",
                "true or given positions in another order of the particles; keep the "
                "order of the given frames",
                where=where,
            )
        scan.add_steps(first, np.stack([true[1], begin[0]]), box)
        with np.errstate(all="ignore"):
            way = box.displacement(true[1], begin[0].astype(np.float64))
            distance = float(np.sqrt(np.einsum("ij,ij->", way, way) / len(way)))
        # More of the truth is read only where the first frames do not suffice.
        enough = max(scan.jump, np.nan_to_num(distance)) / JUMP
        largest = float(np.sqrt(np.max(squared_steps(true[1:], box))))
        if largest < enough:
            largest = truth.largest_displacement(scenario, enough=enough)
        limit = JUMP * largest
        if np.isfinite(distance) and distance > limit:
            issues.warning(
                "discontinuous_start",
                f"the first predicted frame is {distance:.3g} from the last given one "
                f"(root mean square), more than {limit:.3g}; store positions, x first, "
                "of every scenario under its own id; where the model jumps, leave it",
                where=where,
            )
        if scan.jump_at is not None and scan.jump > limit:
            frame, particle = scan.jump_at
            issues.warning(
                "max_displacement",
                f"a particle jumps by {scan.jump:.3g}, more than {JUMP:g} times as far "
                "as any true one; look for instability, and keep particles in order",
                where=f"scenario {scenario}, from frame {frame - 1} to {frame}, "
                f"particle {particle}",
            )
        shift = 0
        if count > 1 and np.isfinite(begin).all():
            shift = find_shift(begin.astype(np.float64), true.astype(np.float64), box)
        shifts.add(shift)
    shift = shifts.pop() if len(shifts) == 1 else 0
    if shift:
        frames = "a frame" if abs(shift) == 1 else f"{abs(shift)} frames"
        issues.warning(
            "shifted",
            f"predictions are {frames} {'late' if shift < 0 else 'early'}: in every "
            f"scenario they fit the true frames {'before' if shift < 0 else 'after'} "
            "far better than their own; begin with the frame after the last given one",
            where=f"frames {first} to {first + count - 1}",
        )


def is_permutation(predicted: Block, reference: Block) -> bool:
    """Return whether two frames hold the same positions in another particle order.

    >>> square = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.float32)
    >>> is_permutation(square[::-1], square), is_permutation(square, square)
    (True, False)
    """
    if np.array_equal(predicted, reference):
        return False
    one = predicted[np.lexsort(predicted.T[::-1])]
    other = reference[np.lexsort(reference.T[::-1])]
    return np.array_equal(one, other)
