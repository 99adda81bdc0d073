"""What a generation checks, what it compares with datasets.yaml, and what it then
leaves.
"""

from __future__ import annotations

import json
import platform
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import SIZE, SPLIT
from rewritten_files import forge

from lagbench.data import checksums
from lagbench.data.manifest import Manifest, read_manifest, write_manifest
from lagbench.data.registry import Measured, Registry
from lagbench.errors import DataError
from lagbench.generators.record import measured_values
from lagbench.make import cards
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.verify import verify
from lagbench.work.run import Progress

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


def test_equal_hashes_give_the_verdict_equal(
    copied: Copy, unmeasured: Registry, right: Measured
) -> None:
    """All hashes agree with datasets.yaml, and nothing is simulated."""
    result = generate(
        SPLIT,
        SIZE,
        root=copied(),
        registry=with_measured(unmeasured, right),
    )
    assert result.verdict == "equal to datasets.yaml"
    assert result.simulated == ()


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
    with pytest.raises(DataError) as caught:
        generate(SPLIT, SIZE, force=True, **options)
    assert caught.value.where == "curl-noise tiny, scenarios 4"
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


def test_paths_of_a_manifest_are_not_published(
    copied: Copy, unmeasured: Registry
) -> None:
    """A manifest that names a file elsewhere is written anew from the files."""
    root = copied()
    folder = root / SPLIT / SIZE / "v2"
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["files"][3]["path"] = "../../../../../etc/passwd"
    path.write_text(json.dumps(manifest))
    generate(SPLIT, SIZE, root=root, workers=1, registry=unmeasured)
    for name in ("manifest.json", "croissant.json", "README.md"):
        text = (folder / name).read_text()
        assert "passwd" not in text


def test_a_second_call_hashes_each_file_once_and_draws_nothing(
    copied: Copy, unmeasured: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes are read once, progress is reported meanwhile, and cards that would be the
    same stay.
    """
    root = copied()
    read: Counter[str] = Counter()
    news: list[Progress] = []

    def counted(path: Path) -> str:
        read[path.name] += 1
        return checksums.file_sha256(path)

    def refuse(*_: object) -> list[str]:
        pytest.fail("pictures are drawn again")

    for module in ("make.inventory", "data.manifest"):
        monkeypatch.setattr(f"lagbench.{module}.file_sha256", counted)
    monkeypatch.setattr(cards, "paint_pictures", refuse)
    generate(SPLIT, SIZE, root=root, registry=unmeasured, dry_run=True)
    read.clear()
    generate(SPLIT, SIZE, root=root, registry=unmeasured, progress=news.append)
    each_once = {f"{scenario:04d}.nc": 1 for scenario in range(5)}
    assert read == each_once
    checking = [state for state in news if state.stage == "checking"]
    first = checking[0]
    last = checking[-1]
    assert first.done == 0
    assert last.done == 5
    assert last.total == 5


def test_values_are_hashed_once(
    copied: Copy, unmeasured: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first call of a copied folder; a dry run takes the manifest's word, later
    calls the note.
    """

    def refuse(*_: object) -> str:
        pytest.fail("values are hashed again")

    root = copied()
    for dry_run, may_hash in (
        (True, False),
        (False, True),
        (False, False),
    ):
        with monkeypatch.context() as patch:
            if not may_hash:
                patch.setattr("lagbench.make.inventory.check_scenario", refuse)
            result = generate(
                SPLIT,
                SIZE,
                root=root,
                registry=unmeasured,
                dry_run=dry_run,
            )
        assert result.kept == (0, 1, 2, 3, 4)


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


EDITED = """
from dataclasses import replace
from lagbench.generators import curl_noise
from lagbench.generators.curl_noise import solver_parameters

def initial_state(size, scenario, rng):
    state = curl_noise.initial_state(size, scenario, rng)
    parameters = dict(state.parameters)
    parameters["frequency"] += 1
    return replace(state, parameters=parameters)
"""


@pytest.mark.parametrize("is_recorded", [True, False])
def test_an_edited_module_costs_no_file_with_the_recorded_hash(
    copied: Copy,
    unmeasured: Registry,
    right: Measured,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    is_recorded: bool,
) -> None:
    """Only files without a recorded hash are simulated again: they may be any draw."""
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "edited_noise.py").write_text(EDITED)
    monkeypatch.syspath_prepend(modules)
    split = unmeasured.split(SPLIT).model_copy(update={"generator": "edited_noise"})
    registry = Registry({SPLIT: split}, {})
    if is_recorded:
        registry = with_measured(registry, right)
    root = copied()
    plan = generate(SPLIT, SIZE, root=root, registry=registry, dry_run=True)
    if not is_recorded:
        assert plan.simulated == (0, 1, 2, 3, 4)
        return
    assert plan.simulated == ()
    generate(SPLIT, SIZE, root=root, registry=registry)
    assert manifest_of(root).dataset_sha256 == right.dataset_sha256
    verify(SPLIT, SIZE, root=root, registry=registry).check()
