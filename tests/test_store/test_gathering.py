"""Gathering: the joint manifest names the files that are there."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
from scenario_factory import make_key, write_scenario

from lagbench.data.checksums import file_sha256
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    describe_file,
    merge_entries,
    write_manifest,
)
from lagbench.data.registry import Size, load
from lagbench.store.copy import gather

LIMIT = (1e-3, 2e-3)


@pytest.fixture
def size() -> Size:
    """Cavity tiny without hashes."""
    size = load().size("cavity", "tiny")
    return size.model_copy(update={"measured": None})


def write_root(root: Path, size: Size, *scenarios: int) -> list[FileEntry]:
    """Write test scenarios below a root folder and return their entries."""
    entries = []
    for scenario in scenarios:
        key = make_key(scenario)
        write_scenario(root, key)
        entries.append(describe_file(root, key))
    write_manifest(root, merge_entries(size, None, entries))
    return entries


def repack(path: Path) -> None:
    """Change the bytes of a file, but no value."""
    with h5py.File(path, "r+") as file:
        file.attrs["lagbench_version"] = "0.0.9"


def assert_is_of_the_file(entry: FileEntry, path: Path) -> None:
    """Assert that an entry has the hash and the length of a file."""
    assert entry.file_sha256 == file_sha256(path)
    assert entry.bytes == path.stat().st_size


def test_a_file_that_is_there_keeps_its_entry(tmp_path: Path, size: Size) -> None:
    """The source adds the predictability limit. Its file is packed otherwise."""
    root = tmp_path / "root"
    source = tmp_path / "source"
    write_root(root, size, 3)
    (other_entry,) = write_root(source, size, 3)
    limited = other_entry.model_copy(update={"twin_floor": LIMIT})
    write_manifest(source, merge_entries(size, None, [limited]))
    repack(size.path(root, 3))
    entry = describe_file(root, size.key(3))
    assert entry.content_sha256 == other_entry.content_sha256

    joint = gather(size, root, source, merge_entries(size, None, [entry]))
    joint_entry = joint.entry(3)
    assert joint_entry is not None
    assert_is_of_the_file(joint_entry, size.path(root, 3))
    assert joint_entry.twin_floor == LIMIT


def test_scenarios_that_the_size_lacks_stay_in_the_source(
    tmp_path: Path, size: Size
) -> None:
    """Another minor version of the split may have more of them."""
    root = tmp_path / "root"
    source = tmp_path / "source"
    write_root(source, size, 3, 77)
    empty = merge_entries(size, None)
    joint = gather(size, root, source, empty)
    assert list_ids(joint) == [3]
    names = [path.name for path in root.rglob("*.nc")]
    assert names == ["0003.nc"]


def list_ids(manifest: Manifest) -> list[int]:
    """Return the ids of a manifest's scenarios."""
    return [entry.scenario for entry in manifest.files]
