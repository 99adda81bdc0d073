"""Checks that a file answers the task: split, data set, scenarios, frames, particles."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from lagbench.data.layout import major_of
from lagbench.data.local import remedy
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UnreadableFileError, UsageError

from .anatomy import Anatomy
from .findings import Findings, quoted
from .guesses import guess_frames, guess_scenarios, spell_numbers

__all__ = [
    "check_dataset",
    "check_frames",
    "check_particles",
    "check_scenarios",
    "check_split",
    "dataset_hash_of",
    "frames_to_predict",
]

_VERSION = re.compile(r"[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}")
_HASH = re.compile(r"[0-9a-f]{64}")


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
        fix=f"{known.splitlines()[0]}; or say where a split of your own lies: --split PATH, --root FOLDER",
    )
    return None


def check_dataset(anatomy: Anatomy, size: Size, root: Path, out: Findings) -> None:
    """Check that the predictions were made from the data set that the registry means."""
    version, got = (anatomy.attributes[name] for name in ("dataset_version", "dataset_sha256"))
    if not isinstance(version, str) or not isinstance(got, str):
        out.skip("the file does not name its data set", "dataset")
        return
    out.made("dataset")
    remake = "predict from the data set that is here"
    if size.simulated:
        remake = f"generate {size.split} {size.name} anew and predict from that"
    if not _VERSION.fullmatch(version) or major_of(version) != size.major:
        out.error(
            "dataset",
            "the predictions are for another version of the data set",
            where="attribute 'dataset_version'",
            expected=size.version,
            got=quoted(version),
            fix=remake,
        )
    expected = dataset_hash_of(size, root)
    if expected is None and _HASH.fullmatch(got):
        out.warning(
            "dataset",
            "the data set hash cannot be compared",
            where="attribute 'dataset_sha256'",
            expected=f"a recorded hash of {size.split} {size.name}",
            got="neither datasets.yaml nor a complete manifest has one",
            fix=remedy(size),
        )
    elif got != expected:
        out.error(
            "dataset",
            "the predictions were made from another data set",
            where="attribute 'dataset_sha256'",
            expected=expected or "64 hex digits",
            got=quoted(got),
            fix=f"run `lagbench verify --split {size.split} --size {size.name}`; {remake}",
        )


def dataset_hash_of(size: Size, root: Path) -> str | None:
    """Return the hash of a data set: the registry's, else that of a complete local one."""
    if size.measured is not None:
        return size.measured.dataset_sha256
    try:
        manifest = read_manifest(root, size.split, size.name, size.major)
    except DataError:
        return None
    return manifest.dataset_sha256 if manifest else None


def check_scenarios(anatomy: Anatomy, size: Size, out: Findings) -> bool:
    """Check that every test scenario is there once, in any order, and no other."""
    got = anatomy.integers.get("scenario")
    if got is None:
        out.skip("the coordinate 'scenario' cannot be read", "scenarios")
        return False
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
    return not out.failed("scenarios")


def _numbers(ids: Sequence[int]) -> str:
    """Return numbers for a message; negative ones would read as ranges."""
    return spell_numbers(ids) if min(ids) >= 0 else quoted(list(ids[:20]))


def check_frames(anatomy: Anatomy, size: Size, out: Findings) -> bool:
    """Check that the frames are those to predict, ascending."""
    got = anatomy.integers.get("frame")
    if got is None:
        out.skip("the coordinate 'frame' cannot be read", "frames")
        return False
    out.made("frames")
    expected = frames_to_predict(size)
    if list(got) == list(expected):
        return True
    out.error(
        "frames",
        "the frames are not those to predict",
        where="coordinate 'frame'",
        expected=f"{spell_numbers(expected)} (absolute numbers, {len(expected)} of them)",
        got=f"{_numbers(got) if got else 'none'} ({len(got)})",
        fix=guess_frames(got, expected),
    )
    return False


def frames_to_predict(size: Size) -> range:
    """Return the absolute numbers of the frames that a model must predict."""
    return range(size.task.input_frames, size.task.input_frames + size.task.horizon)


def check_particles(anatomy: Anatomy, size: Size, out: Findings) -> bool:
    """Check the number of particles."""
    array = anatomy.arrays.get("position")
    if array is None or array.shape is None or out.failed("dims"):
        out.skip("the dimensions are not known", "particles")
        return False
    shape = array.shape
    out.made("particles")
    if shape[2] == size.particles:
        return True
    out.error(
        "particles",
        "the number of particles is another",
        where="variable 'position', dimension 'particle'",
        expected=size.particles,
        got=shape[2],
        fix=f"predict every particle of {size.split} {size.name}, in the order of the given frames",
    )
    return False
