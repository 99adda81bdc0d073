"""Recording what a data set measures, and the guard against bits that change
unnoticed.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from conftest import SIZE, SPLIT

from lagbench.data.manifest import Manifest, read_manifest, write_manifest
from lagbench.data.registry import default_path, load
from lagbench.generators.record import (
    main,
    measured_values,
    released_name,
    render,
    replace_measured,
)
from lagbench.make.generate import GenerationResult

RELEASED = Path(__file__).parents[1] / "data" / "released_hashes.json"


def manifest_of(root: Path) -> Manifest:
    """Return the manifest of the tiny data set."""
    manifest = read_manifest(root, SPLIT, SIZE, 2)
    assert manifest is not None
    return manifest


@pytest.fixture
def registry(unmeasured_path: Path, tmp_path: Path) -> Path:
    """A registry of one's own that a test may write."""
    return Path(shutil.copy(unmeasured_path, tmp_path / "datasets.yaml"))


def run(root: Path, registry: Path, *options: str) -> int:
    """Run the command in this process."""
    released = registry.parent / "released.json"
    arguments = [
        "--split",
        SPLIT,
        "--size",
        SIZE,
        "--root",
        str(root),
        "--registry",
        str(registry),
    ]
    code: int = main([*arguments, "--released", str(released), *options])
    return code


def test_what_is_recorded_is_what_was_measured(
    generated: GenerationResult,
    registry: Path,
    unmeasured_path: Path,
) -> None:
    """Hashes, statistics and the mean limit come back; what was written by hand is
    untouched.
    """
    assert run(generated.root, registry) == 0
    measured = load(registry).size(SPLIT, SIZE).measured
    manifest = manifest_of(generated.root)
    assert measured is not None
    assert measured.dataset_sha256 == generated.dataset_sha256
    assert measured.subset_sha256 == manifest.subset_sha256
    assert measured.scenario_sha256 == {
        e.scenario: e.content_sha256[:16] for e in manifest.files
    }
    assert measured.statistics == manifest.statistics
    limits = [entry.twin_floor for entry in manifest.files if entry.subset == "test"]
    assert len(measured.twin_floor) == 20
    assert measured.twin_floor[7] == pytest.approx(
        (limits[0][7] + limits[1][7]) / 2, rel=1e-8
    )
    assert registry.read_text().startswith(unmeasured_path.read_text().rstrip("\n"))


def test_statistics_are_computed_anew(
    copied: Callable[[], Path],
    registry: Path,
    generated: GenerationResult,
) -> None:
    """What the manifest says about train is not taken on trust."""
    root = copied()
    manifest = manifest_of(root)
    lie = manifest.model_copy(
        update={"statistics": {**manifest.statistics, "velocity_std": (1.0, 1.0)}}
    )
    write_manifest(root, lie)
    assert run(root, registry) == 0
    measured = load(registry).size(SPLIT, SIZE).measured
    assert measured is not None
    assert measured.statistics == manifest_of(generated.root).statistics


@pytest.mark.slow
def test_recording_again_changes_no_byte(
    generated: GenerationResult, registry: Path
) -> None:
    """The same data set gives the same text, here and by the command, which prints the
    hash.
    """
    run(generated.root, registry)
    first = registry.read_text()
    command = [
        sys.executable,
        "-m",
        "lagbench.generators.record",
        "--split",
        SPLIT,
        "--size",
        SIZE,
    ]
    places = ["--root", str(generated.root), "--registry", str(registry)]
    done = subprocess.run(
        [*command, *places],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout == f"{SPLIT} {SIZE}: {generated.dataset_sha256}\n"
    assert run(generated.root, registry) == 0
    assert registry.read_text() == first
    released = json.loads((registry.parent / "released.json").read_text())
    assert released == {f"{SPLIT}/{SIZE}/v2": generated.dataset_sha256}


def test_numbers_are_floats_in_any_yaml(generated: GenerationResult) -> None:
    """YAML 1.1 reads 1e-5 as a string: every number has a point and a signed exponent;
    hashes are strings.
    """
    values = measured_values(manifest_of(generated.root))
    digits = {
        0: "1234567890123456",
        1: "12345e6789012345",
        2: "0" * 16,
    }
    text = render(
        {SPLIT: {SIZE: values.model_copy(update={"scenario_sha256": digits})}}
    )
    read = yaml.safe_load(text)["measured"][SPLIT][SIZE]
    assert read["scenario_sha256"] == digits
    assert all(isinstance(number, float) for number in read["twin_floor"])
    assert all(
        isinstance(number, float)
        for row in read["statistics"].values()
        for number in row
    )
    assert max(map(len, text.splitlines())) <= 110
    # Text above the marker stays, whatever stood below it.
    assert replace_measured("a: 1\n\nmeasured:\n  old: {}\n", {}) == replace_measured(
        "a: 1\n", {}
    )


def test_changed_bits_need_another_version(
    generated: GenerationResult,
    registry: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A hash of the same MAJOR that differs is refused, by the registry and by the
    list, unless allowed.
    """
    run(generated.root, registry)
    text = registry.read_text()
    registry.write_text(text.replace(str(generated.dataset_sha256), "0" * 64))
    (registry.parent / "released.json").write_text(
        json.dumps({f"{SPLIT}/{SIZE}/v2": "0" * 64})
    )
    capsys.readouterr()
    assert run(generated.root, registry) == 4
    assert "--allow-change" in capsys.readouterr().err
    assert run(generated.root, registry, "--allow-change") == 0
    assert registry.read_text() == text
    # A new MAJOR has an entry of its own beside the old one.
    size = load(registry).size(SPLIT, SIZE)
    assert released_name(size) == f"{SPLIT}/{SIZE}/v2"
    assert (
        released_name(size.model_copy(update={"version": "3.0.0"}))
        == f"{SPLIT}/{SIZE}/v3"
    )


def test_no_released_hash_has_changed() -> None:
    """Bits of a split, size and MAJOR never change; a measured size is whole.
    datasets.yaml and the list of released hashes agree; there is a hash of every
    scenario and a predictability limit for every predicted frame.
    """
    registry = load(default_path())
    released = json.loads(RELEASED.read_text())
    for split, sizes in registry.measured.items():
        for name, values in sizes.items():
            size = registry.size(split, name)
            assert released.get(released_name(size)) == values.dataset_sha256
            assert sorted(values.scenario_sha256) == list(size.scenarios)
            assert set(values.subset_sha256) == set(size.subsets)
            assert len(values.twin_floor) == size.task.horizon
