"""What a generation checks, what it compares with datasets.yaml, and what it then
leaves.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import SIZE, SPLIT
from rewritten_files import forge

from lagbench.data.manifest import Manifest, read_manifest, write_manifest
from lagbench.data.registry import Measured, Registry
from lagbench.errors import DataError
from lagbench.generators.record import measured_values
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.verify import verify

Copy = Callable[[], Path]


def manifest_of(root: Path) -> Manifest:
    """Return the manifest of the tiny data set."""
    manifest = read_manifest(root, SPLIT, SIZE, 2)
    assert manifest is not None
    return manifest


def with_measured(registry: Registry, values: Measured) -> Registry:
    """Return a registry with other measured values of the tiny data set."""
    return Registry(registry.splits, {SPLIT: {SIZE: values}})


@pytest.fixture
def right(generated: GenerationResult) -> Measured:
    """What datasets.yaml says about the generated data set once it is recorded."""
    values: Measured = measured_values(manifest_of(generated.root))
    return values


def card_of(root: Path) -> str:
    """Return the text of the data set's card."""
    return (root / SPLIT / SIZE / "v2" / "README.md").read_text()


def test_all_hashes_are_compared(
    copied: Copy, unmeasured: Registry, right: Measured
) -> None:
    """Equal scenarios are not enough to be equal to datasets.yaml; an id without a hash
    equals nothing.
    """
    without_two = dict(right.scenario_sha256)
    del without_two[2]
    root = copied()
    for change, place in (
        ({"dataset_sha256": "0" * 64}, "the data set"),
        ({"subset_sha256": {"train": "0" * 64}}, "train"),
        ({"scenario_sha256": without_two}, "scenarios 2"),
    ):
        changed = right.model_copy(update=change)
        registry = with_measured(unmeasured, changed)
        with pytest.raises(DataError) as caught:
            generate(SPLIT, SIZE, root=root, registry=registry)
        assert place in str(caught.value.where)
        assert caught.value.exit_code == 4


@pytest.mark.slow
def test_a_forged_file_is_simulated_again(
    copied: Copy, unmeasured: Registry, generated: GenerationResult
) -> None:
    """Without a recorded hash the manifest's counts: a file that agrees with itself is
    not adopted.
    """
    root = copied()
    test_folder = root / SPLIT / SIZE / "v2" / "test"
    forge(test_folder / "0003.nc")
    result = generate(SPLIT, SIZE, root=root, workers=1, registry=unmeasured)
    assert result.simulated == (3,)
    assert result.dataset_sha256 == generated.dataset_sha256


def change_manifest(root: Path, **changes: object) -> None:
    """Change the manifest of the tiny data set."""
    manifest = manifest_of(root)
    write_manifest(root, manifest.model_copy(update=changes))


def test_another_machine_has_tolerance_until_its_hashes_agree(
    copied: Copy, unmeasured: Registry, right: Measured
) -> None:
    """Without a recorded hash nothing shows that the bits are equal; the card says it
    too.
    """
    root = copied()
    manifest = manifest_of(root)
    environment = {**manifest.environments[0], "machine": "aarch64"}
    change_manifest(root, environments=(environment,))
    generate(SPLIT, SIZE, root=root, registry=unmeasured)
    assert manifest_of(root).identity == "tolerance"
    assert "tolerance" in card_of(root)
    recorded = with_measured(unmeasured, right)
    generate(SPLIT, SIZE, root=root, registry=recorded)
    assert manifest_of(root).identity == "bitwise"
    assert "same bits on every" in card_of(root)


@pytest.mark.slow
def test_other_bits_of_another_machine_stay_and_count_as_tolerance(
    tmp_path: Path,
    unmeasured: Registry,
    right: Measured,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An ARM CPU whose bits differ: tolerance in manifest and card, no error, nothing
    simulated twice.
    """
    wrong = {**right.scenario_sha256, 4: "0" * 16}
    with_wrong = right.model_copy(update={"scenario_sha256": wrong})
    registry = with_measured(unmeasured, with_wrong)
    options: dict[str, Any] = {
        "root": tmp_path,
        "scenarios": "4",
        "workers": 1,
        "registry": registry,
    }
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    first = generate(SPLIT, SIZE, **options)
    assert first.simulated == (4,)
    assert "tolerance" in first.verdict
    assert manifest_of(tmp_path).identity == "tolerance"
    assert "tolerance" in card_of(tmp_path)
    second = generate(SPLIT, SIZE, **options)
    assert second.simulated == ()
    verify(SPLIT, SIZE, root=tmp_path, registry=registry).check()
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    third = generate(SPLIT, SIZE, **options)
    assert third.simulated == ()
    # A broken promise is never tolerated: bitwise still, and no card says more.
    root = tmp_path / "other"
    options["root"] = root
    with pytest.raises(DataError) as caught:
        generate(SPLIT, SIZE, **options)
    assert caught.value.where == "curl-noise tiny, scenarios 4"
    assert caught.value.exit_code == 4
    assert manifest_of(root).identity == "bitwise"
    assert not (root / SPLIT / SIZE / "v2" / "README.md").exists()


def test_wrong_statistics_are_mended(
    copied: Copy, unmeasured: Registry, right: Measured
) -> None:
    """Where datasets.yaml says otherwise, the statistics of train are computed anew."""
    root = copied()
    manifest = manifest_of(root)
    lie = {**manifest.statistics, "velocity_std": (1.0, 1.0)}
    change_manifest(root, statistics=lie)
    recorded = with_measured(unmeasured, right)
    generate(SPLIT, SIZE, root=root, registry=recorded)
    assert manifest_of(root).statistics == right.statistics


@pytest.mark.parametrize("name", ["README.md", "croissant.json", "pictures/frame.png"])
def test_a_missing_or_changed_card_is_written_again(
    name: str, copied: Copy, unmeasured: Registry
) -> None:
    """Only cards that are there and the same are left alone."""
    root = copied()
    path = root / SPLIT / SIZE / "v2" / name
    before = path.read_bytes()
    path.unlink()
    generate(SPLIT, SIZE, root=root, registry=unmeasured)
    assert path.read_bytes() == before
