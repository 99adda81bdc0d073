"""Checks that a file answers the task: split, data set, scenarios, frames,
particles.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from lagbench.data.layout import major_of, quote_root
from lagbench.data.local import suggest_repair
from lagbench.data.manifest import read_or_empty
from lagbench.data.registry import Registry, Size, format_ids
from lagbench.errors import UnreadableFileError, UsageError

from .findings import Findings, quoted
from .format import Anatomy

_VERSION = re.compile(r"[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}")
HASH = re.compile(r"[0-9a-f]{64}")

MAX_SPELLED = 60
"""Longest list of numbers in a message [characters]."""


def check_split(anatomy: Anatomy, registry: Registry, out: Findings) -> Size | None:
    """Check that split and size are known; return what the registry says of them."""
    split, size = (anatomy.attributes[name] for name in ("split", "size"))
    if not isinstance(split, str) or not isinstance(size, str):
        out.skip("the file does not name its split and size", "split")
        return None
    out.made("split")
    try:
        return registry.size(split, size)
    except (UsageError, UnreadableFileError) as error:
        known = error.fix or error.what
    out.error(
        "split",
        "no such split and size",
        where="attributes 'split' and 'size'",
        expected="a split and size that `lagbench list` shows",
        got=f"{quoted(split)}, {quoted(size)}",
        fix=f"{known.splitlines()[0]}; or say where a split of your own lies: "
        f"--root FOLDER",
    )
    return None


def check_dataset(anatomy: Anatomy, size: Size, root: Path, out: Findings) -> None:
    """Check that the predictions were made from the data set that the registry
    means.
    """
    version, got = (
        anatomy.attributes[name] for name in ("dataset_version", "dataset_sha256")
    )
    if not isinstance(version, str) or not isinstance(got, str):
        out.skip("the file does not name its data set", "dataset")
        return
    out.made("dataset")
    remake = f"predict again, from {size.split} {size.name} {size.version}"
    if not _VERSION.fullmatch(version) or major_of(version) != size.major:
        out.error(
            "dataset",
            "the predictions are for another version of the data set",
            where="attribute 'dataset_version'",
            expected=size.version,
            got=quoted(version),
            fix=f"{remake}; if theirs is later, install a later lagbench",
        )
    expected = dataset_hash_of(size, root)
    if expected is None and HASH.fullmatch(got):
        out.warning(
            "dataset",
            "the data set hash cannot be compared",
            where="attribute 'dataset_sha256'",
            expected=f"a recorded hash of {size.split} {size.name}",
            got="neither datasets.yaml nor a complete manifest has one",
            fix=suggest_repair(size, root=root),
        )
    elif got != expected:
        out.error(
            "dataset",
            "the predictions were made from another data set",
            where="attribute 'dataset_sha256'",
            expected=expected or "64 hex digits",
            got=quoted(got),
            fix=f"{remake}; whether it is what lies here, says lagbench verify "
            f"--split {size.split}"
            f" --size {size.name} --root {quote_root(root)}",
        )


def dataset_hash_of(size: Size, root: Path) -> str | None:
    """Return the hash of a data set: the registry's, else that of a complete local
    one.
    """
    return (size.measured or read_or_empty(size, root)).dataset_sha256


def check_scenarios(anatomy: Anatomy, size: Size, out: Findings) -> None:
    """Check that every test scenario is there once, in any order, and no other."""
    got = anatomy.integers.get("scenario")
    if got is None:
        out.skip("the coordinate 'scenario' cannot be read", "scenarios")
        return
    out.made("scenarios")
    wanted = size.subsets["test"]
    twice = sorted(i for i, count in Counter(got).items() if count > 1)
    problems = {
        "missing": (sorted(set(wanted) - set(got)), "predict every test scenario"),
        "unknown": (sorted(set(got) - set(wanted)), guess_scenarios(got, size.subsets)),
        "duplicate": (twice, "store every scenario once"),
    }
    for word, (ids, fix) in problems.items():
        if ids:
            out.error(
                "scenarios",
                f"{len(ids)} {word} scenario{'s' if len(ids) > 1 else ''}",
                where="coordinate 'scenario'",
                expected=spell_numbers(wanted),
                got=f"{word}: {_numbers(ids)}",
                fix=fix,
            )


def _numbers(ids: Sequence[int]) -> str:
    """Return numbers for a message; negative ones would read as ranges."""
    if min(ids) >= 0:
        return spell_numbers(ids)
    return quoted(list(ids[:20]))


def check_frames(anatomy: Anatomy, size: Size, out: Findings) -> None:
    """Check that the frames are those to predict, ascending."""
    got = anatomy.integers.get("frame")
    if got is None:
        out.skip("the coordinate 'frame' cannot be read", "frames")
        return
    out.made("frames")
    expected = frames_to_predict(size)
    if list(got) != list(expected):
        out.error(
            "frames",
            "the frames are not those to predict",
            where="coordinate 'frame'",
            expected=f"{spell_numbers(expected)} (absolute numbers, {len(expected)} "
            f"of them)",
            got=f"{_numbers(got) if got else 'none'} ({len(got)})",
            fix=guess_frames(got, expected),
        )


def frames_to_predict(size: Size) -> range:
    """Return the absolute numbers of the frames that a model must predict."""
    return range(size.task.input_frames, size.task.input_frames + size.task.horizon)


def check_particles(anatomy: Anatomy, size: Size, out: Findings) -> bool:
    """Check the number of particles."""
    array = anatomy.arrays.get("position")
    if array is None or array.shape is None or out.failed("dims"):
        out.skip("the dimensions are not known", "particles")
        return False
    out.made("particles")
    if array.shape[2] != size.particles:
        out.error(
            "particles",
            "the number of particles is another",
            where="variable 'position', dimension 'particle'",
            expected=size.particles,
            got=array.shape[2],
            fix=f"predict every particle of {size.split} {size.name}, in the order of "
            f"the given frames",
        )
    return array.shape[2] == size.particles


# --- guesses, so that a message can say what may have happened ------------------------


def spell_numbers(numbers: Sequence[int]) -> str:
    """Return numbers as ranges, shortened in the middle where they are many.

    >>> spell_numbers([6, 7, 8, 10])
    '6-8,10'
    """
    text = format_ids(numbers)
    if len(text) <= MAX_SPELLED:
        return text
    return f"{text[: MAX_SPELLED - 3]}... ({len(numbers)} numbers)"


def guess_frames(got: Sequence[int], expected: range) -> str:
    """Return what seems to have happened to the frame numbers."""
    given = expected.start
    count = len(expected)
    if not got:
        return "there are no frames"
    number, times = Counter(got).most_common(1)[0]
    if times > 1:
        return f"frame {number} stands twice"
    if sorted(got) == list(expected):
        return "seems to hold the right frames in another order: store them ascending"
    steps = {b - a for a, b in pairwise(got)}
    if len(steps) == 1 and (step := min(steps)) > 1:
        if step % 100 in (11, 12, 13):
            ending = "th"
        else:
            ending = {1: "st", 2: "nd", 3: "rd"}.get(step % 10, "th")
        return f"seems to skip: it holds every {step}{ending} frame only"
    first = got[0]
    last = got[-1]
    if steps and steps != {1}:
        if missing := sorted(set(expected) - set(got)):
            return f"lacks the frames {spell_numbers(missing)}"
        return "holds frames that are no predictions"
    if first in (0, 1) and len(got) == count:
        return f"seems to count from the first predicted frame, whose absolute number is {given}"
    if first < given and last == given + count - 1:
        return (
            f"seems to start at the input frames: leave out the frames before {given}"
        )
    if first == given and last < given + count - 1:
        return f"stops too early: the last frame is {given + count - 1}"
    if first == given:
        return f"goes on too long: leave out the frames after {given + count - 1}"
    if len(got) == count:
        return f"seems to be shifted by {first - given} frames"
    return "holds other frames"


def guess_scenarios(got: Sequence[int], subsets: Mapping[str, Sequence[int]]) -> str:
    """Return where unknown scenario ids may come from."""
    for subset, ids in subsets.items():
        if subset != "test" and set(got) <= set(ids):
            return f"these are scenarios of {subset}"
    if list(got) == list(range(len(subsets["test"]))) or list(got) == list(
        range(1, len(got) + 1)
    ):
        return "seems to count the scenarios: store their ids"
    return "name the scenarios by their ids"
