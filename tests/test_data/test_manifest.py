"""The manifest lists the files, and completes over partial generations."""

from __future__ import annotations

import hashlib
import json
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

SUBSETS = {
    "train": (0, 1),
    "valid": (2,),
    "test": (3, 4),
    "extra": (5,),
}
STATISTICS = {"velocity_std": (0.00219, 0.00218)}


def subset_of(scenario: int) -> str:
    """Return the subset of a scenario."""
    for name, scenarios in SUBSETS.items():
        if scenario in scenarios:
            return name
    raise KeyError(scenario)


def make_entry(scenario: int, content: str = "") -> FileEntry:
    """Return a made-up entry."""
    subset = subset_of(scenario)
    if not content:
        content = hashlib.sha256(bytes([scenario])).hexdigest()
    return FileEntry(
        scenario=scenario,
        subset=subset,
        path=f"{subset}/{scenario:04d}.nc",
        bytes=100,
        content_sha256=content,
        frames=4,
        particles=8,
        file_sha256="0" * 64,
        device="cpu",
        facts={"energy_last_over_max": 0.25},
    )


def merge(
    old: Manifest | None,
    scenarios: Iterable[int | FileEntry],
    **changes: Any,
) -> Manifest:
    """Return an old manifest with entries merged in, made-up ones for plain ids."""
    entries = []
    for scenario in scenarios:
        if isinstance(scenario, int):
            scenario = make_entry(scenario)
        entries.append(scenario)
    options: dict[str, Any] = {
        "split": "cavity",
        "size": "tiny",
        "version": "1.2.0",
        "subsets": SUBSETS,
        "environment": {"python": "3.11"},
        "statistics": None,
    }
    return build_manifest(old, entries, **(options | changes))


def listed_scenarios(manifest: Manifest) -> list[int]:
    """Return the scenarios whose files a manifest lists."""
    return [entry.scenario for entry in manifest.files]


def test_partial_generations_complete_each_other() -> None:
    """Two halves in any order end with the manifest of one whole run."""
    whole = merge(None, range(5), statistics=STATISTICS)
    assert whole.complete
    assert listed_scenarios(whole) == [0, 1, 2, 3, 4]

    half = merge(None, (4, 2))
    assert not half.complete
    assert half.dataset_sha256 is None
    assert set(half.subset_sha256) == {"valid"}
    other_half = (3, 0, 1)
    assert merge(half, other_half, statistics=STATISTICS) == whole


def test_hashes_follow_from_the_content_hashes() -> None:
    """The subset extra has a hash, but is no part of that of the data set."""
    manifest = merge(None, range(6))
    expected = {}
    for name, scenarios in SUBSETS.items():
        hashes = {}
        for scenario in scenarios:
            hashes[scenario] = make_entry(scenario).content_sha256
        expected[name] = subset_hash(hashes)
    assert manifest.subset_sha256 == expected
    expected_hash = dataset_hash("cavity", "tiny", 1, expected)
    assert manifest.dataset_sha256 == expected_hash
    without_extra = merge(None, range(5))
    assert without_extra.dataset_sha256 == expected_hash


OTHER_HASH = "f" * 64


def test_new_entries_replace_old_ones() -> None:
    old = merge(None, range(6))
    changed = merge(old, [make_entry(3, OTHER_HASH)])
    assert changed.entry(3).content_sha256 == OTHER_HASH
    assert changed.dataset_sha256 != old.dataset_sha256


def test_scenarios_that_a_size_has_dropped_go() -> None:
    old = merge(None, range(6))
    subsets = dict(SUBSETS)
    del subsets["extra"]
    changed = merge(old, [make_entry(3)], version="1.3.0", subsets=subsets)
    assert changed.entry(5) is None


def test_statistics_stay_when_a_later_run_brings_none() -> None:
    train = merge(None, (0, 1), statistics=STATISTICS)
    assert train.statistics == STATISTICS
    whole = merge(train, (2, 3, 4))
    assert whole.statistics == STATISTICS


def test_a_new_file_of_train_removes_the_statistics() -> None:
    whole = merge(None, range(5), statistics=STATISTICS)
    changed = merge(whole, [make_entry(1, OTHER_HASH)])
    assert changed.complete
    assert changed.statistics == {}


Environment = dict[str, str]


def machine(name: str, device: str = "cpu", system: str = "Linux") -> Environment:
    """Return an environment."""
    return {"machine": name, "system": system, "device": device}


def test_environments_add_up() -> None:
    """Equal ones are listed once; a merge that wrote no file adds none."""
    this_machine = machine("x86_64")
    other_machine = machine("aarch64")
    manifest = merge(None, (0,), environment=this_machine)
    manifest = merge(manifest, (1,), environment=other_machine)
    manifest = merge(manifest, (2,), environment=this_machine)
    manifest = merge(manifest, (3,), environment=None)
    assert manifest.environments == (this_machine, other_machine)


@pytest.mark.parametrize(
    ("environment", "identity"),
    [
        (machine("x86_64"), "bitwise"),
        (machine("AMD64", "parallel"), "bitwise"),
        (machine("aarch64"), "tolerance"),
        (machine("x86_64", "cuda"), "tolerance"),
        (machine("x86_64", system="Darwin"), "tolerance"),
    ],
)
def test_identity_needs_a_promise_or_evidence(
    environment: Environment, identity: str
) -> None:
    """x86-64 Linux CPUs promise equal bits.

    Elsewhere every file needs the hash of datasets.yaml.
    """
    device = environment["device"]
    entries = []
    recorded = {}
    for scenario in range(3):
        entry = make_entry(scenario)
        entries.append(entry.model_copy(update={"device": device}))
        recorded[scenario] = entry.content_sha256[:16]
    manifest = merge(None, entries, environment=environment)
    assert manifest.identity == identity

    def identity_with(recorded: dict[int, str]) -> str:
        merged = merge(manifest, (), environment=None, recorded=recorded)
        return merged.identity

    another_hash = {1: "0" * 16}
    one_hash = {0: recorded[0]}

    assert identity_with(recorded) == "bitwise"
    assert identity_with(recorded | another_hash) == identity
    assert identity_with(one_hash) == identity
    with_another = merge(manifest, (3,), environment=machine("x86_64"))
    assert with_another.identity == identity


def test_without_perturbed_runs_there_is_no_mean_twin_floor() -> None:
    manifest = merge(None, range(5))
    assert manifest.mean_twin_floor() == ()


def test_the_mean_twin_floor_is_that_of_test() -> None:
    """It is the mean over the scenarios at each frame that all have."""
    twin_floors = {
        3: (1e-6, 2e-3),
        4: (3e-6, 4e-3, 1.0),
    }
    entries = []
    for scenario in range(5):
        twin_floor = twin_floors.get(scenario, ())
        entry = make_entry(scenario)
        entries.append(entry.model_copy(update={"twin_floor": twin_floor}))
    manifest = merge(None, entries)
    assert manifest.mean_twin_floor() == (2e-6, 3e-3)


def test_a_written_manifest_is_read_back(tmp_path: Path) -> None:
    """It is plain JSON, and no temporary file stays."""
    manifest = merge(None, range(5), statistics=STATISTICS)
    path = write_manifest(tmp_path, manifest)
    folder = tmp_path / "cavity" / "tiny" / "v1"
    assert path == folder / "manifest.json"
    assert read_manifest(tmp_path, "cavity", "tiny", 1) == manifest
    assert list(path.parent.iterdir()) == [path]
    content = json.loads(path.read_text())
    facts = content["files"][3]["facts"]
    assert facts == {"energy_last_over_max": 0.25}
    assert read_manifest(tmp_path, "cavity", "tiny", 2) is None


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
