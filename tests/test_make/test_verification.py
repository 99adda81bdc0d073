"""Verification: what is right passes, and whatever is not is named."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import SIZE, SPLIT
from hypothesis import given
from hypothesis import strategies as st
from rewritten_files import mend_manifest

from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Registry, load
from lagbench.errors import DataError
from lagbench.generators.record import measured_values, replace_measured
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.verify import VerificationResult, evenly_spaced, verify

Copy = Callable[[], Path]


def file_of(root: Path, scenario: str = "test/0003") -> Path:
    """Return the path of a scenario file."""
    return root / SPLIT / SIZE / "v2" / f"{scenario}.nc"


def manifest_of(root: Path) -> Manifest:
    """Return the manifest of the tiny data set."""
    manifest = read_manifest(root, SPLIT, SIZE, 2)
    assert manifest is not None
    return manifest


def told_otherwise(measured: Registry, **update: Any) -> Registry:
    """Return a registry with some other hashes of the tiny data set."""
    own = measured.size(SPLIT, SIZE).measured
    assert own is not None
    for name, value in update.items():
        if isinstance(value, dict):
            update[name] = {**getattr(own, name), **value}
    told = own.model_copy(update=update)
    return Registry(measured.splits, {SPLIT: {SIZE: told}})


def verify_tiny(root: Path, registry: Registry, **options: Any) -> VerificationResult:
    """Verify the tiny data set."""
    return verify(SPLIT, SIZE, root=root, registry=registry, **options)


@pytest.fixture
def measured(
    generated: GenerationResult, unmeasured_path: Path, tmp_path: Path
) -> Registry:
    """A registry that holds the hashes of the generated data set."""
    values = measured_values(manifest_of(generated.root))
    path = tmp_path / "datasets.yaml"
    text = unmeasured_path.read_text()
    path.write_text(replace_measured(text, {SPLIT: {SIZE: values}}))
    return load(path)


def test_what_was_generated_passes(
    generated: GenerationResult, measured: Registry, unmeasured: Registry
) -> None:
    """Every subset is there and equal to datasets.yaml, as is the whole; without a hash
    none claims that.
    """
    result = verify_tiny(generated.root, measured, complete=True)
    counts = {report.name: report.present for report in result.subsets}
    assert counts == {"train": 2, "valid": 1, "test": 2}
    for report in result.subsets:
        assert report.missing == ()
        assert report.wrong == ()
        assert report.extra == ()
        assert report.verdict == "equal to datasets.yaml"
    assert result.verdict == "equal to datasets.yaml"
    assert result.dataset_sha256 == generated.dataset_sha256
    assert result.problems == ()
    assert result.warnings == ()
    assert result.identity == "bitwise"
    result.check()
    result = verify_tiny(generated.root, unmeasured)
    assert "no hash" in result.verdict
    result.check()


def test_a_missing_file_is_a_warning_unless_all_are_wanted(
    copied: Copy, measured: Registry
) -> None:
    """Half a data set may be right, none is not; with complete a fault of exit code 4
    names the ids.
    """
    root = copied()
    file_of(root).unlink()
    result = verify_tiny(root, measured)
    assert result.warnings == ("test lacks 3",)
    verdicts = [report.verdict for report in result.subsets]
    assert verdicts == [
        "equal to datasets.yaml",
        "equal to datasets.yaml",
        "incomplete",
    ]
    result.check()
    all_are_wanted = verify_tiny(root, measured, complete=True)
    with pytest.raises(DataError) as caught:
        all_are_wanted.check()
    assert "missing: test 3" in str(caught.value)
    assert "lagbench generate --split curl-noise --size tiny" in str(caught.value)
    assert caught.value.exit_code == 4
    with pytest.raises(DataError) as caught:
        verify_tiny(root / "none", measured).check()
    assert caught.value.where.endswith("root/none/curl-noise/tiny/v2")


def flipped(variable: str) -> Callable[[Path], None]:
    """Return what flips one bit in the midst of a stored chunk of a variable."""

    def change(path: Path) -> None:
        with h5py.File(path) as file:
            chunk = file[variable].id.get_chunk_info(0)
        data = bytearray(path.read_bytes())
        data[chunk.byte_offset + chunk.size // 2] ^= 0b100
        path.write_bytes(bytes(data))

    return change


def rewritten(path: Path) -> None:
    """Change a value by a library, which leaves a healthy file."""
    with h5py.File(path, "r+") as file:
        file["velocity"][7, 11, 0] += np.float32(1e-6)


def described(**attributes: object) -> Callable[[Path], None]:
    """Return what changes how readers understand positions, not a stored value."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file["position"].attrs.update(attributes)

    return change


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (flipped("position"), "0003.nc, variable 'position'"),
        (flipped("velocity"), "0003.nc, variable 'velocity'"),
        (flipped("material"), "0003.nc, variable 'material'"),
        (
            lambda path: os.truncate(path, path.stat().st_size - 1024),
            "damaged",
        ),
        (rewritten, "variable 'velocity'"),
        (described(scale_factor=2.0), "(?s)variable 'position'.*scale_factor"),
        (described(units="m"), "(?s)variable 'position'.*units"),
        (
            lambda path: shutil.copy(path.with_name("0004.nc"), path),
            "another scenario",
        ),
    ],
)
def test_harm_is_named(
    harm: Callable[[Path], object],
    words: str,
    copied: Copy,
    measured: Registry,
) -> None:
    """A bit flipped, a file cut, changed, to be read otherwise, or of another scenario:
    exit code 4.
    """
    root = copied()
    harm(file_of(root))
    result = verify_tiny(root, measured)
    wrong = [report.wrong for report in result.subsets]
    assert wrong == [(), (), (3,)]
    with pytest.raises(DataError) as caught:
        result.check()
    assert "test/0003.nc" in str(caught.value)
    assert caught.value.exit_code == 4


@pytest.mark.slow
def test_a_forger_who_keeps_the_stored_hashes_is_caught(
    copied: Copy, measured: Registry
) -> None:
    """Only the packed bytes and the manifest's word for them changed: generate hashes
    the values.
    """
    root = copied()
    path = file_of(root, "train/0000")
    content = manifest_of(root).files[0].content_sha256
    with h5py.File(path, "r+") as file:
        file["position"][:] = 0.5
    mend_manifest(path.parents[1] / "manifest.json", 0, path, content)
    result = generate(SPLIT, SIZE, root=root, workers=1, registry=measured)
    assert result.simulated == (0,)
    assert result.kept == (1, 2, 3, 4)
    verify_tiny(root, measured).check()


Content = dict[str, Any]


def change_manifest(root: Path, change: Callable[[Content], object]) -> None:
    """Change the manifest of the tiny data set as a text editor would."""
    path = file_of(root).parents[1] / "manifest.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_statistics_and_twin_floor_of_the_manifest_are_compared(
    copied: Copy, measured: Registry
) -> None:
    """They follow from files that are right: another value is the manifest's fault and
    a warning.
    """
    root = copied()

    def lie(content: Content) -> None:
        content["statistics"]["velocity_std"] = [1.0, 1.0]
        content["files"][4]["twin_floor"][3] = 0.5

    change_manifest(root, lie)
    result = verify_tiny(root, measured)
    assert [line for line in result.warnings if "velocity_std" in line]
    assert [line for line in result.warnings if "twin_floor" in line]
    result.check()


def test_the_data_set_hash_is_compared_too(
    generated: GenerationResult, measured: Registry
) -> None:
    """A registry with right hashes of scenarios and a wrong hash of the data set is an
    error.
    """
    registry = told_otherwise(
        measured,
        dataset_sha256="0" * 64,
        subset_sha256={"train": "1" * 64},
    )
    result = verify_tiny(generated.root, registry)
    assert result.verdict == "NOT that of datasets.yaml"
    assert result.subsets[0].verdict == "NOT that of datasets.yaml"
    with pytest.raises(DataError) as caught:
        result.check()
    assert caught.value.where.endswith("curl-noise/tiny/v2")


def test_simulating_anew_is_identical(
    generated: GenerationResult, measured: Registry
) -> None:
    """First and last scenario, simulated anew, have the hashes of their files."""
    result = verify_tiny(generated.root, measured, regenerate=2, workers=2)
    assert result.regenerated == {0: "identical", 4: "identical"}
    result.check()


def test_simulating_anew_needs_no_file_but_a_hash(
    tmp_path: Path, measured: Registry, unmeasured: Registry
) -> None:
    """A missing scenario is compared with datasets.yaml; without a hash there is
    nothing to compare.
    """
    wrong = told_otherwise(measured, scenario_sha256={2: "0" * 16})
    for word, registry in (
        ("identical", measured),
        ("nothing to compare with", unmeasured),
        ("different", wrong),
    ):
        result = verify_tiny(tmp_path, registry, scenarios="2", regenerate=1)
        assert result.regenerated == {2: word}
    with pytest.raises(DataError) as caught:
        result.check()
    assert caught.value.where.endswith("curl-noise/tiny/v2")


SORTED_IDS = st.lists(st.integers(0, 9999), min_size=1, unique=True).map(sorted)


@given(SORTED_IDS, st.integers(0, 80))
def test_evenly_spaced_ids(ids: list[int], count: int) -> None:
    """As many distinct ids as requested (or all), ascending, first and last included,
    gaps alike.
    """
    chosen = evenly_spaced(ids, count)
    expected_count = min(count, len(ids))
    assert len(chosen) == expected_count
    assert len(set(chosen)) == expected_count
    assert list(chosen) == sorted(chosen)
    if len(chosen) > 1:
        assert chosen[0] == ids[0]
        assert chosen[-1] == ids[-1]
        places = [ids.index(chosen_id) for chosen_id in chosen]
        gaps = np.diff(places)
        assert gaps.max() - gaps.min() <= 1


@pytest.mark.parametrize("name", ["obstacle_x", "obstacle_y", "obstacle_diameter"])
def test_a_changed_obstacle_is_named(
    name: str, tiny_split: Callable[..., GenerationResult], tmp_path: Path
) -> None:
    """Its place and its size are hashed parameters of a file."""
    size = load().size("cylinder", "tiny")
    scenario = size.subsets["test"][0]
    source = tiny_split("cylinder").root
    path = size.path(tmp_path, scenario)
    path.parent.mkdir(parents=True)
    shutil.copy(size.path(source, scenario), path)
    verify("cylinder", "tiny", root=tmp_path, scenarios=[scenario]).check()
    with h5py.File(path, "r+") as file:
        file.attrs[name] = 0.999 * file.attrs[name]
    result = verify("cylinder", "tiny", root=tmp_path, scenarios=[scenario])
    (problem,) = result.problems
    assert name in problem
