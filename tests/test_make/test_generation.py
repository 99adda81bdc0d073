"""Generation: what is written, what is resumed, and that workers and devices leave no
trace.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import PAINT_PICTURES, SIZE, SPLIT
from independent_hash import content_hash, dumps
from numpy.testing import assert_array_equal
from numpy.typing import NDArray
from turns import of_this_turn

from lagbench.data import WALLS
from lagbench.data.layout import PICTURES
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Registry, load
from lagbench.data.scenario import check_scenario, read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.generators.batch import (
    draw_initial_state,
    substep_count,
)
from lagbench.generators.draws import generator
from lagbench.generators.simulate import active_frames, draw_perturbation
from lagbench.make import cards
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.plan import estimate, select
from lagbench.work.run import Progress


def folder_of(root: Path) -> Path:
    """Return the folder of the tiny data set."""
    return root / SPLIT / SIZE / "v2"


def manifest_of(root: Path, split: str = SPLIT) -> Manifest:
    """Return the manifest of a tiny data set."""
    manifest = read_manifest(root, split, SIZE, 2)
    assert manifest is not None
    return manifest


def contents(root: Path) -> dict[str, bytes]:
    """Return name and bytes of every scenario file."""
    files = {}
    for path in sorted(folder_of(root).glob("*/*.nc")):
        files[path.name] = path.read_bytes()
    return files


def test_everything_is_there_and_hashed(generated: GenerationResult) -> None:
    """Five files, whose data set hash follows by h5py and hashlib from the rules of the
    design.
    """
    subsets = {}
    for subset in ("train", "valid", "test"):
        lines = ""
        for path in sorted((generated.folder / subset).glob("*.nc")):
            lines += f"{path.stem} {content_hash(path)}\n"
        subsets[subset] = hashlib.sha256(lines.encode()).hexdigest()
    whole = {
        "split": SPLIT,
        "size": SIZE,
        "major": 2,
        "subsets": subsets,
    }
    expected = hashlib.sha256(dumps(whole)).hexdigest()
    assert generated.dataset_sha256 == expected
    assert generated.simulated == (0, 1, 2, 3, 4)
    assert generated.kept == ()
    assert generated.missing == ()
    assert generated.complete
    assert "nothing to compare with" in generated.verdict
    # Beside the scenarios stand manifest, cards, pictures, the lock and the notes; no
    # temporary file.
    names = set()
    for path in generated.folder.rglob("*"):
        if path.is_file():
            names.add(str(path.relative_to(generated.folder)))
    scenarios = {
        "train/0000.nc",
        "train/0001.nc",
        "valid/0002.nc",
        "test/0003.nc",
        "test/0004.nc",
    }
    card_files = {
        "manifest.json",
        "README.md",
        "croissant.json",
        "pictures/frame.png",
        "pictures/scenarios.png",
    }
    assert names == scenarios | card_files | {".lock", ".verified.json"}


def test_a_file_holds_what_its_scenario_says(
    generated: GenerationResult, unmeasured: Registry
) -> None:
    """Frame 0 is the initial state drawn from the stated seed; parameters are those of
    the registry.
    """
    size = unmeasured.size(SPLIT, SIZE)
    with read_scenario(generated.folder / "test" / "0003.nc") as file:
        header = file.header
        first = file.read("position", 0)
        material = file.read("material")
        velocity = file.read("velocity", 0)
    state = draw_initial_state(size, 3)
    assert_array_equal(first, state.position.astype(np.float32))
    assert_array_equal(velocity, state.velocity.astype(np.float32))
    assert_array_equal(material, state.material)
    words = [int(word) for word in header.seed.split(", ")]
    sequence = np.random.SeedSequence(words)
    from_seed = np.random.Generator(np.random.PCG64(sequence))
    own = generator(SPLIT, SIZE, 2, 3)
    assert from_seed.random() == own.random()
    assert header.parameters["frequency"] == 2
    assert header.parameters["start_frame"] == 0
    assert header.parameters["modulus"] == size.value("modulus")


@pytest.mark.slow
def test_cavity_files_hold_the_walls_of_every_frame(
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """Row f of ``wall_velocity`` is what the program says of frame f, counted from
    where recording starts.
    """
    state = draw_initial_state(load().size("cavity", "tiny"), 3)
    folder = tiny_split("cavity").folder
    with read_scenario(folder / "test" / "0003.nc") as file:
        walls = file.read("wall_velocity")
        start = file.header.parameters["start_frame"]
        assert "active_frames" not in file.header.parameters
    assert start == state.start_frame
    expected = state.wall_velocity[-26:].astype(np.float32)
    assert_array_equal(walls, expected)
    wall = str(state.parameters["wall"])
    velocities = walls[:, WALLS.index(wall)]
    assert len(np.unique(velocities, axis=0)) > 13


def test_active_frames_end_when_little_energy_is_left() -> None:
    """Two frames given, six to predict: the last above 1 % counts, later peaks beyond
    the horizon do not.
    """
    changes = {"input_frames": 2, "horizon": 6}
    task = load().size("fluid", "tiny").task.model_copy(update=changes)
    for energies, expected in (
        ([1.0, 2.0, 1.0, 0.5, 0.3, 0.1, 0.05, 0.02, 90.0], 6),
        ([1.0, 2.0, 1.0, 0.5, 0.0199, 0.1, 0.0199, 0.0, 0.5], 4),
        ([1.0, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0),
    ):
        assert active_frames(energies, task) == expected


def square_speeds(velocity: NDArray[Any]) -> NDArray[np.float64]:
    """Return the sum of squared speeds of each frame."""
    squares = velocity.astype(np.float64) ** 2
    return np.sum(squares, axis=(1, 2))


def test_active_frames_stand_in_the_file_and_its_hash(
    tmp_path: Path, tiny_split: Callable[..., GenerationResult]
) -> None:
    """They follow from the stored velocities; another number is another content
    hash.
    """
    test_files = tmp_path / "test"
    shutil.copytree(tiny_split("fluid").folder / "test", test_files)
    task = load().size("fluid", "tiny").task
    for path in sorted(test_files.glob("*.nc")):
        with read_scenario(path) as file:
            energy = square_speeds(file.read("velocity"))
            stated = file.header.parameters["active_frames"]
        span = energy[: task.input_frames + task.horizon]
        is_active = span >= 0.01 * span.max()
        last_active = np.flatnonzero(is_active)[-1]
        assert stated == last_active + 1 - task.input_frames
        check_scenario(path)
        with h5py.File(path, "r+") as raw:
            raw.attrs.modify("active_frames", stated + 1)
        with pytest.raises(DataError):
            check_scenario(path)


def test_diagnostics_of_the_manifest_follow_from_the_files(
    generated: GenerationResult, unmeasured: Registry
) -> None:
    """Energies are sums over the stored velocities; speed, CFL number and J stay in
    their bounds.

    The predictability limit is known for each predicted frame; after one frame it is
    still near 2^-20.
    """
    horizon = unmeasured.size(SPLIT, SIZE).task.horizon
    for entry in manifest_of(generated.root).files:
        with read_scenario(generated.folder / entry.path) as file:
            velocity = file.read("velocity")
            mass = float(file.read("particle_mass"))
        energy = 0.5 * mass * square_speeds(velocity)
        facts = entry.facts
        last = energy[-1]
        expected = {
            "kinetic_energy_first": energy[0],
            "kinetic_energy_last": last,
            "kinetic_energy_mean": energy.mean(),
            "energy_last_over_max": last / energy.max(),
        }
        for name, value in expected.items():
            assert facts[name] == pytest.approx(value, rel=1e-12), name
        assert facts["max_speed"] >= np.abs(velocity).max()
        assert 0.0 < facts["cfl"] < 1.0
        assert 0.9 < facts["jacobian_min"] <= 1.0
        assert 1.0 <= facts["jacobian_max"] < 1.1
        floors = entry.twin_floor
        assert len(floors) == (horizon if entry.subset == "test" else 0)
        for floor in floors:
            assert floor < 1e-4
        if floors:
            assert 0.5 < floors[0] * 2**20 < 2.0


def test_the_perturbation_has_a_random_stream_of_its_own(unmeasured: Registry) -> None:
    """Every coordinate moves by exactly 2^-20, up or down as often, not as the scenario
    is drawn.
    """
    size = unmeasured.size(SPLIT, SIZE)
    signs = draw_perturbation(size, 3, size.particles) * 2**20
    assert set(np.unique(signs)) == {-1.0, 1.0}
    assert abs(signs.mean()) < 0.1
    other_signs = draw_perturbation(size, 4, size.particles) * 2**20
    assert not np.array_equal(signs, other_signs)
    rng = generator(SPLIT, SIZE, 2, 3)
    plain = rng.random((size.particles, 2))
    assert not np.array_equal(signs > 0, plain >= 0.5)


@pytest.mark.slow
def test_resuming_makes_what_is_missing_or_wrong(
    copied: Callable[[], Path],
    unmeasured: Registry,
    generated: GenerationResult,
) -> None:
    """One worker simulates a removed and a damaged scenario again; then all bytes are
    as before.
    """
    root = copied()
    before = contents(root)
    folder = folder_of(root)
    (folder / "test" / "0003.nc").unlink()
    damaged = folder / "train" / "0001.nc"
    size = damaged.stat().st_size
    os.truncate(damaged, size - 1000)
    leftover = folder / "test" / ".0003.nc.99999.partial"
    leftover.write_bytes(b"half a file")
    result = generate(SPLIT, SIZE, root=root, workers=1, registry=unmeasured)
    assert result.simulated == (1, 3)
    assert result.kept == (0, 2, 4)
    assert result.dataset_sha256 == generated.dataset_sha256
    assert contents(root) == before
    assert not leftover.exists()


def test_parts_complete_each_other(
    tmp_path: Path, unmeasured: Registry, generated: GenerationResult
) -> None:
    """One subset first leaves complete: false and no data set hash; the rest gives the
    whole hash.
    """
    part = generate(
        SPLIT,
        SIZE,
        subset="test",
        root=tmp_path,
        workers=1,
        registry=unmeasured,
    )
    assert part.simulated == (3, 4)
    assert part.missing == (0, 1, 2)
    assert not part.complete
    assert part.dataset_sha256 is None
    manifest = manifest_of(tmp_path)
    assert not manifest.complete
    assert manifest.statistics == {}
    rest = generate(SPLIT, SIZE, root=tmp_path, workers=1, registry=unmeasured)
    assert rest.simulated == (0, 1, 2)
    assert rest.kept == (3, 4)
    assert rest.dataset_sha256 == generated.dataset_sha256


def test_files_of_other_parameters_are_simulated_again(
    copied: Callable[[], Path],
    unmeasured_path: Path,
    tmp_path: Path,
) -> None:
    """A changed parameter of an unreleased split keeps no file of the old one."""
    text = unmeasured_path.read_text()
    old = "velocity_relaxation: {value: 0.002"
    assert old in text
    own = tmp_path / "own.yaml"
    own.write_text(text.replace(old, "velocity_relaxation: {value: 0.003"))
    result = generate(
        SPLIT,
        SIZE,
        root=copied(),
        dry_run=True,
        registry=load(own),
    )
    assert result.simulated == (0, 1, 2, 3, 4)
    assert result.kept == ()


def test_a_dry_run_touches_nothing(
    tmp_path: Path, unmeasured: Registry, generated: GenerationResult
) -> None:
    """It prints bytes (an upper bound, not by much), time and free disk, and makes no
    folder.
    """
    result = generate(
        SPLIT,
        SIZE,
        root=tmp_path / "new",
        dry_run=True,
        registry=unmeasured,
    )
    sizes = [len(content) for content in contents(generated.root).values()]
    real = sum(sizes)
    assert real < result.bytes_needed
    assert result.bytes_free > result.bytes_needed
    assert result.seconds_expected > 0.0
    assert result.simulated == (0, 1, 2, 3, 4)
    assert not (tmp_path / "new").exists()


def test_progress_ends_at_its_total(tmp_path: Path, unmeasured: Registry) -> None:
    """Substeps of the scenario and of its perturbed run are counted, none twice."""
    news: list[Progress] = []
    generate(
        SPLIT,
        SIZE,
        scenarios="3",
        root=tmp_path,
        progress=news.append,
        registry=unmeasured,
    )
    size = unmeasured.size(SPLIT, SIZE)
    simulating = [state for state in news if state.stage == "simulating"]
    first = simulating[0]
    last = simulating[-1]
    assert first.total == 2 * substep_count(size, 3)
    assert first.total == 2 * 25 * 12
    counts = [state.done for state in simulating]
    assert counts == sorted(counts)
    assert last.done == last.total
    assert last.scenarios_done == 1


def hashes_of(manifest: Manifest) -> dict[int, str]:
    """Return the content hashes of scenarios."""
    return {entry.scenario: entry.content_sha256 for entry in manifest.files}


@pytest.mark.slow
def test_batches_start_each_scenario_at_its_own_frame(
    tmp_path: Path, tiny_split: Callable[..., GenerationResult]
) -> None:
    """Three cavities with programs and starts of their own: one batch and single runs,
    equal hashes.
    """
    size = load().size("cavity", "tiny")
    starts = {draw_initial_state(size, scenario).start_frame for scenario in range(3)}
    assert len(starts) == 3
    batch = generate(
        "cavity",
        "tiny",
        root=tmp_path,
        device="parallel",
        scenarios="0-2",
    )
    single = hashes_of(manifest_of(tiny_split("cavity").root, "cavity"))
    together = hashes_of(manifest_of(batch.root, "cavity"))
    assert together.keys() == {0, 1, 2}
    for scenario, content_hash_of_batch in together.items():
        assert content_hash_of_batch == single[scenario]


@pytest.mark.slow
@pytest.mark.parametrize(
    "split", of_this_turn(["curl-noise", "fluid", "multimaterial"], turns=3)
)
def test_parallel_driver_gives_the_same_data_set(
    split: str, tmp_path: Path, tiny_split: Callable[..., GenerationResult]
) -> None:
    """The GPU's kernels with all scenarios in one batch agree to the bit with the
    serial kernel.
    """
    together = generate(split, "tiny", root=tmp_path, device="parallel")
    single = tiny_split(split)
    assert single.dataset_sha256 is not None
    assert together.dataset_sha256 == single.dataset_sha256


def test_selection_by_subset_and_id(unmeasured: Registry) -> None:
    """Both narrow the choice; ids come back ascending and once."""
    size = unmeasured.size("multimaterial", "full")
    assert select(size, subset="valid,test") == tuple(range(48, 72))
    assert select(size, subset=["extra"], scenarios="73,72") == (72, 73)
    assert select(size, scenarios=[5, 3, 5]) == (3, 5)
    chosen = select(size, scenarios=np.arange(3, 5))
    assert [type(scenario) for scenario in chosen] == [int, int]
    for no_ids in (3, [3.0], [None]):
        with pytest.raises(UsageError):
            select(size, scenarios=no_ids)  # type: ignore[arg-type]
    everything = set().union(*size.subsets.values())
    assert set(select(size)) == everything


def test_an_estimate_follows_from_frames_and_particles(unmeasured: Registry) -> None:
    expected = estimate(unmeasured.size("fluid", "tiny"), (0, 1))
    assert expected.substeps == (31 * 15, 31 * 15)
    assert expected.bytes > 2 * 32 * 256 * 16


@pytest.mark.slow
def test_a_registry_of_ones_own_is_all_that_counts(
    tmp_path: Path, unmeasured: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A split that only the given registry knows is generated, drawn and described with
    its own title.
    """
    monkeypatch.setattr(cards, "paint_pictures", PAINT_PICTURES)
    described = unmeasured.split(SPLIT).model_copy(update={"title": "Noise of our own"})
    own = Registry({"own-noise": described}, {})
    result = generate(
        "own-noise",
        SIZE,
        scenarios="3",
        root=tmp_path,
        workers=1,
        registry=own,
    )
    assert "# Noise of our own" in (result.folder / "README.md").read_text()
    assert all((result.folder / name).stat().st_size > 1000 for name in PICTURES)
