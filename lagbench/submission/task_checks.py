"""Check that a file answers the task: split, data set, scenarios, frames, particles."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from lagbench.data.layout import format_ids, major_of, quote_root
from lagbench.data.local import suggest_repair
from lagbench.data.manifest import read_or_empty
from lagbench.data.registry import Registry, Size
from lagbench.errors import UnreadableFileError, UsageError, format_count

from .format import MAX_NAME, FileInfo
from .issues import IssueCollector, quote

HASH = re.compile(r"[0-9a-f]{64}")
VERSION = re.compile(r"[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}")

MAX_LIST = 60
"""Longest list of numbers in a message [characters]."""

MAX_QUOTED_NUMBERS = 20
"""Most numbers that are quoted one by one."""


def find_size(
    info: FileInfo, registry: Registry, issues: IssueCollector
) -> Size | None:
    """Return the split, size and subset that a file names; None if there is none."""
    split = info.attributes["split"]
    size = info.attributes["size"]
    if not isinstance(split, str) or not isinstance(size, str):
        issues.skip("the file does not name its split and size", "split")
        return None
    issues.complete("split")
    subset = info.attributes["subset"]
    if not isinstance(subset, str):
        subset = "test"
    try:
        return registry.size(split, size).scored_on(subset)
    except (UsageError, UnreadableFileError) as error:
        issues.error(
            "split",
            error.what[:MAX_NAME],
            where="attributes 'split', 'size' and 'subset'",
            expected="a split and size that `lagbench list` shows",
            got=f"{quote(split)}, {quote(size)}, {quote(subset)}",
            fix="predictions for a split of your own are validated and scored with "
            "--split own/",
        )
        return None


def check_dataset(
    info: FileInfo, size: Size, root: Path, issues: IssueCollector
) -> None:
    """Check that the predictions were made from the data set of the registry."""
    version = info.attributes["dataset_version"]
    stored_hash = info.attributes["dataset_sha256"]
    if not isinstance(version, str) or not isinstance(stored_hash, str):
        issues.skip("the file does not name its data set", "dataset")
        return

    issues.complete("dataset")
    name = f"{size.split} {size.name}"
    predict_again = f"predict again, from {name} {size.version}"
    if not VERSION.fullmatch(version) or major_of(version) != size.major:
        issues.error(
            "dataset",
            "the predictions are for another version of the data set",
            where="attribute 'dataset_version'",
            expected=size.version,
            got=quote(version),
            fix=f"{predict_again}; if theirs is later, install a later lagbench",
        )

    where = "attribute 'dataset_sha256'"
    expected_hash = dataset_hash_of(size, root)
    if expected_hash is None and HASH.fullmatch(stored_hash):
        issues.warning(
            "dataset",
            "the data set hash cannot be compared",
            where=where,
            expected=f"a recorded hash of {name}",
            got=f"neither {size.record_name} nor a complete manifest has one",
            fix=suggest_repair(size, root=root),
        )
    elif stored_hash != expected_hash:
        verify = f"lagbench verify --split {size.split} --size {size.name}"
        issues.error(
            "dataset",
            "the predictions were made from another data set",
            where=where,
            expected=expected_hash or "64 hex digits",
            got=quote(stored_hash),
            fix=f"{predict_again}; {verify} --root {quote_root(root)} says whether it"
            " is the data set that lies here",
        )


def dataset_hash_of(size: Size, root: Path) -> str | None:
    """Return the recorded hash of a data set.

    It is the registry's, else that of a complete local data set; None without either.
    """
    if size.measured is not None:
        return size.measured.dataset_sha256
    return read_or_empty(size, root).dataset_sha256


def check_scenarios(info: FileInfo, size: Size, issues: IssueCollector) -> None:
    """Check that every test scenario is there once, in any order, and no other."""
    stored = info.integers.get("scenario")
    if stored is None:
        issues.skip("the coordinate 'scenario' cannot be read", "scenarios")
        return
    issues.complete("scenarios")
    expected = size.scored_scenarios
    missing = sorted(set(expected) - set(stored))
    unknown = sorted(set(stored) - set(expected))
    duplicate = []
    for scenario, count in Counter(stored).items():
        if count > 1:
            duplicate.append(scenario)
    for kind, scenarios, fix in (
        ("missing", missing, "predict every test scenario"),
        ("unknown", unknown, "store the ids of the test scenarios, and no others"),
        ("duplicate", sorted(duplicate), "store every scenario once"),
    ):
        if not scenarios:
            continue
        issues.error(
            "scenarios",
            format_count(len(scenarios), f"{kind} scenario"),
            where="coordinate 'scenario'",
            expected=format_ranges(expected),
            got=f"{kind}: {format_numbers(scenarios)}",
            fix=fix,
        )


def check_frames(info: FileInfo, size: Size, issues: IssueCollector) -> None:
    """Check that the frames are those to predict, ascending."""
    stored = info.integers.get("frame")
    if stored is None:
        issues.skip("the coordinate 'frame' cannot be read", "frames")
        return
    issues.complete("frames")
    expected = frames_to_predict(size)
    if list(stored) == list(expected):
        return
    first = expected[0]
    last = expected[-1]
    issues.error(
        "frames",
        "the frames are not those to predict",
        where="coordinate 'frame'",
        expected=f"{format_ranges(expected)} (absolute numbers, {len(expected)} "
        f"of them)",
        got=f"{format_numbers(stored)} ({len(stored)})",
        fix=f"store the frames {first} to {last}, each once, ascending; "
        f"frame 0 is the first given one",
    )


def frames_to_predict(size: Size) -> range:
    """Return the absolute numbers of the frames that a model must predict."""
    task = size.task
    return range(task.input_frames, task.input_frames + task.horizon)


def check_particles(info: FileInfo, size: Size, issues: IssueCollector) -> bool:
    """Check the number of particles; return whether it is right."""
    array = info.arrays.get("position")
    if array is None or array.shape is None or issues.first_failed("dims"):
        issues.skip("the dimensions are not known", "particles")
        return False
    issues.complete("particles")
    fix = (
        f"predict every particle of {size.split} {size.name}, in the order of the given"
        f" frames"
    )
    most = max_test_particles(size)
    if array.shape[2] != most:
        issues.error(
            "particles",
            "the number of particles is another",
            where="variable 'position', dimension 'particle'",
            expected=most,
            got=array.shape[2],
            fix=fix,
        )
        return False
    stored = info.integers.get("scenario", ())
    counts = info.integers.get("particle_count", (most,) * len(stored))
    for scenario, count in zip(stored, counts, strict=False):
        is_known = scenario in size.scored_scenarios
        if not is_known or count == size.particle_count(scenario):
            continue
        issues.error(
            "particles",
            "the number of particles of a scenario is another",
            where=f"variable 'particle_count', scenario {scenario}",
            expected=size.particle_count(scenario),
            got=count,
            fix=f"{fix}; lagbench.submission.write stores the numbers of particles",
        )
        return False
    return True


def max_test_particles(size: Size) -> int:
    """Return the most particles of a test scenario."""
    return max(size.particle_count(scenario) for scenario in size.scored_scenarios)


def format_numbers(numbers: Sequence[int]) -> str:
    """Return numbers for a message, as ranges unless a minus would read as one.

    >>> format_numbers([6, 7, 8, 10]), format_numbers([-1, 3]), format_numbers([])
    ('6-8,10', '[-1, 3]', 'none')
    """
    if not numbers:
        return "none"
    if min(numbers) >= 0:
        return format_ranges(numbers)
    text = quote(list(numbers[:MAX_QUOTED_NUMBERS]))
    if len(numbers) <= MAX_QUOTED_NUMBERS:
        return text
    start = text.removesuffix("...")  # of a text that is cut off already
    return f"{start}... ({len(numbers)} numbers)"


def format_ranges(numbers: Sequence[int]) -> str:
    """Return numbers as ranges, cut off where the text is long.

    >>> format_ranges([6, 7, 8, 10])
    '6-8,10'
    """
    text = format_ids(numbers)
    if len(text) <= MAX_LIST:
        return text
    return f"{text[: MAX_LIST - 3]}... ({len(numbers)} numbers)"
