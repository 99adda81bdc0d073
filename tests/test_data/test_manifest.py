"""The manifest tells what is there, and completes over partial generations."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from scenario_factory import make_key, write_scenario

from lagbench.data.checksums import dataset_hash, subset_hash
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    build_manifest,
    describe_file,
    read_manifest,
    write_manifest,
)
from lagbench.errors import DataError

SUBSETS = {"train": (0, 1), "valid": (2,), "test": (3, 4), "extra": (5,)}
STATISTICS = {"velocity_std": (0.00219, 0.00218)}


def entry(scenario: int, content: str = "") -> FileEntry:
    """Return a made-up entry."""
    subset = next(name for name, ids in SUBSETS.items() if scenario in ids)
    told = {
        "scenario": scenario,
        "subset": subset,
        "path": f"{subset}/{scenario:04d}.nc",
        "bytes": 100,
    }
    hashes = {
        "content_sha256": content or hashlib.sha256(bytes([scenario])).hexdigest()
    }
    facts = {"energy_last_over_max": 0.25}
    return FileEntry(
        **told,
        **hashes,
        frames=4,
        particles=8,
        file_sha256="0" * 64,
        device="cpu",
        facts=facts,
    )


OPTIONS: dict[str, Any] = {
    "split": "cavity",
    "size": "tiny",
    "version": "1.2.0",
    "subsets": SUBSETS,
}


def merged(
    old: Manifest | None, ids: Iterable[int | FileEntry], **options: Any
) -> Manifest:
    """Return an old manifest with entries merged in, made-up ones where only the id is
    told.
    """
    entries = [entry(i) if isinstance(i, int) else i for i in ids]
    return build_manifest(
        old,
        entries,
        **{**OPTIONS, "environment": {"python": "3.11"}, "statistics": None, **options},
    )


def test_partial_generations_complete_each_other() -> None:
    """Two halves in any order end with the manifest of one whole run."""
    whole = merged(None, range(5), statistics=STATISTICS)
    half = merged(None, (4, 2))
    assert not half.complete
    assert half.dataset_sha256 is None
    assert set(half.subset_sha256) == {"valid"}
    assert merged(half, (3, 0, 1), statistics=STATISTICS) == whole
    assert whole.complete
    assert [file.scenario for file in whole.files] == [0, 1, 2, 3, 4]
    # subset and data set hash follow from the content hashes; extra is hashed but
    # outside
    manifest = merged(None, range(6))
    expected = {
        name: subset_hash({i: entry(i).content_sha256 for i in ids})
        for name, ids in SUBSETS.items()
    }
    assert manifest.subset_sha256 == expected
    assert (
        whole.dataset_sha256
        == manifest.dataset_sha256
        == dataset_hash("cavity", "tiny", 1, expected)
    )


def test_new_entries_replace_old_ones() -> None:
    """A regenerated file counts, not the one before it; ids that the size dropped go.

    Which subset holds a scenario is the registry's word; the file is described anew.
    """
    old = merged(None, range(6))
    less = {name: ids for name, ids in SUBSETS.items() if name != "extra"}
    again = merged(old, [entry(3, "f" * 64)], version="1.3.0", subsets=less)
    assert again.entry(3).content_sha256 == "f" * 64
    assert again.entry(5) is None
    assert again.dataset_sha256 != old.dataset_sha256
    whole = merged(None, range(5))
    moved = [
        e.model_copy(update={"subset": "train"}) if e.scenario == 3 else e
        for e in whole.files
    ]
    again = merged(whole.model_copy(update={"files": tuple(moved)}), ())
    assert [e.scenario for e in again.files] == [0, 1, 2, 4]


def test_statistics_belong_to_train() -> None:
    """Dropped while train is incomplete, kept when a later run brings none; a new train
    file takes them.
    """
    assert merged(None, (0, 3), statistics=STATISTICS).statistics == {}
    first = merged(None, (0, 1), statistics=STATISTICS)
    assert first.statistics == STATISTICS
    whole = merged(first, (2, 3, 4))
    assert whole.statistics == STATISTICS
    again = merged(whole, [entry(1, "f" * 64)])
    assert again.complete
    assert again.statistics == {}


def machine(name: str, device: str = "cpu") -> dict[str, str]:
    """Return an environment."""
    return {"machine": name, "system": "Linux", "device": device}


def test_environments_add_up() -> None:
    """Equal ones are listed once; a merge that wrote no file adds none."""
    first = merged(None, (0,), environment=machine("x86_64"))
    second = merged(first, (1,), environment=machine("aarch64"))
    third = merged(
        merged(second, (2,), environment=machine("x86_64")), (3,), environment=None
    )
    assert third.environments == (machine("x86_64"), machine("aarch64"))


@pytest.mark.parametrize(
    ("environment", "identity"),
    [
        (machine("x86_64"), "bitwise"),
        (machine("AMD64", "parallel"), "bitwise"),
        (machine("aarch64"), "tolerance"),
        (machine("x86_64", "cuda"), "tolerance"),
        ({**machine("x86_64"), "system": "Darwin"}, "tolerance"),
    ],
)
def test_identity_needs_a_promise_or_evidence(
    environment: dict[str, str], identity: str
) -> None:
    """x86-64 Linux CPUs promise equal bits; elsewhere every file needs the hash of
    datasets.yaml.
    """
    files = [
        entry(i).model_copy(update={"device": environment["device"]}) for i in range(3)
    ]
    made = merged(None, files, environment=environment)
    assert made.identity == identity
    hashes = {file.scenario: file.content_sha256[:16] for file in files}
    assert merged(made, (), environment=None, recorded=hashes).identity == "bitwise"
    for recorded in ({**hashes, 1: "0" * 16}, {0: hashes[0]}):
        assert (
            merged(made, (), environment=None, recorded=recorded).identity == identity
        )
    assert merged(made, (3,), environment=machine("x86_64")).identity == identity


def test_the_mean_twin_floor_is_that_of_test() -> None:
    """Mean over the test scenarios at each frame that all have; none where one has no
    twin.
    """
    whole = merged(None, range(5))
    assert whole.mean_twin_floor() == ()
    floors = {3: (1e-6, 2e-3), 4: (3e-6, 4e-3, 1.0)}
    files = tuple(
        e.model_copy(update={"twin_floor": floors.get(e.scenario, ())})
        for e in whole.files
    )
    assert whole.model_copy(update={"files": files}).mean_twin_floor() == (2e-6, 3e-3)


def test_round_trip_and_atomic_write(tmp_path: Path) -> None:
    """What is written is read back, as plain JSON, with no temporary file left."""
    manifest = merged(None, range(5), statistics=STATISTICS)
    path = write_manifest(tmp_path, manifest)
    assert path == tmp_path / "cavity" / "tiny" / "v1" / "manifest.json"
    assert read_manifest(tmp_path, "cavity", "tiny", 1) == manifest
    assert list(path.parent.iterdir()) == [path]
    assert json.loads(path.read_text())["files"][3]["facts"] == {
        "energy_last_over_max": 0.25
    }
    assert read_manifest(tmp_path, "cavity", "tiny", 2) is None


@pytest.mark.parametrize(
    ("change", "of_entry", "said"),
    [
        # wrong types, unknown keys and formats
        ({"complete": "yes"}, {}, ", key complete"),
        ({"files": [{"scenario": 1}]}, {}, ", key files.0.subset"),
        ({"colour": 1}, {}, ", key colour"),
        ({"format": 2}, {}, ", key format"),
        # an entry cannot name a file elsewhere
        ({}, {"path": "../../../../../etc/passwd"}, ", key files.3.path"),
        ({}, {"path": "/etc/passwd"}, ", key files.3.path"),
        ({}, {"path": "train/0004.nc"}, ", key files.3.path"),
        ({}, {"subset": "..", "path": "../0003.nc"}, ", key files.3.subset"),
        (
            {},
            {"subset": "../../etc", "path": "../../etc/0003.nc"},
            ", key files.3.subset",
        ),
        # nor the whole be another data set's, whose files would be read and written
        ({"split": "../../../etc"}, {}, ""),
        ({"size": "mini"}, {}, ""),
        ({"version": "2.0.0"}, {}, ""),
        ({"version": "x.0.0"}, {}, ", key version"),
    ],
)
def test_a_damaged_manifest_names_the_key(
    tmp_path: Path, change: dict[str, Any], of_entry: dict[str, str], said: str
) -> None:
    """The error has file, key and hint; a FIFO is refused too."""
    path = write_manifest(tmp_path, merged(None, range(5)))
    told = json.loads(path.read_text())
    told["files"][3] |= of_entry
    path.write_text(json.dumps(told | change))
    with pytest.raises(DataError) as caught:
        read_manifest(tmp_path, "cavity", "tiny", 1)
    assert caught.value.where == f"{path}{said}"
    assert bool(caught.value.fix)
    path.write_text(path.read_text()[:-20])
    with pytest.raises(DataError) as caught:
        read_manifest(tmp_path, "cavity", "tiny", 1)
    assert caught.value.where.endswith("cavity/tiny/v1/manifest.json, key (whole file)")
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DataError):
        read_manifest(tmp_path, "cavity", "tiny", 1)


def test_entry_of_a_file_on_disk(tmp_path: Path) -> None:
    """The entry holds what the file says and the hash of its bytes."""
    key = make_key(3)
    path, content = write_scenario(tmp_path, key, facts={"energy": 0.5})
    _, content_without_facts = write_scenario(tmp_path / "plain", key)
    assert content == content_without_facts
    entry = describe_file(tmp_path, key)
    assert entry.content_sha256 == content
    assert entry.frames == 4
    assert entry.particles == 8
    assert entry.path == "test/0003.nc"
    assert entry.bytes == path.stat().st_size
    digest = hashlib.sha256(path.read_bytes())
    assert entry.file_sha256 == digest.hexdigest()
    assert entry.facts == {"energy": 0.5}
