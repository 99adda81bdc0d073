"""Windows of frames: their content, their seeded order, their memory, rollouts."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml
from numpy.testing import assert_array_equal
from scenario_factory import frames_of, make_key, write_scenario
from torch.utils.data import DataLoader

import lagbench
from lagbench.baselines.rollout import scenario_batch, scenario_paths
from lagbench.data.registry import Registry, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import DataError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.store import windows as store_windows
from lagbench.torch import (
    Batch,
    Window,
    WindowDataset,
    WindowSampler,
    collate,
    predict,
    roll_out,
)

FRAMES = {0: 40, 1: 26, 2: 31}
"""Frames of the scenarios of train."""

PARTICLES = {0: 8, 1: 8, 2: 11}
LENGTH = 7
WINDOWS = 34 + 20 + 25


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three scenarios of train and two of test.

    Those of train have unequal lengths and particle numbers.
    """
    folder = tmp_path_factory.mktemp("windows")
    for scenario, frame_count in FRAMES.items():
        key = make_key(scenario, subset="train")
        write_scenario(
            folder,
            key,
            frames=frame_count,
            particles=PARTICLES[scenario],
        )
    for scenario in (4, 5):
        key = make_key(scenario, subset="test")
        write_scenario(folder, key, frames=26)
    return folder


@pytest.fixture(scope="module")
def registry(
    tmp_path_factory: pytest.TempPathFactory, unmeasured_path: Path
) -> Registry:
    """A registry that describes these scenarios as cavity tiny."""
    content = read_yaml(unmeasured_path)
    cavity = content["splits"]["cavity"]
    tiny = cavity["sizes"]["tiny"]
    tiny["subsets"] = {
        "train": "0-2",
        "valid": 3,
        "test": "4-5",
    }
    tiny["frames"] = {
        40: "0",
        26: "1,3-5",
        31: "2",
    }
    path = tmp_path_factory.mktemp("registry") / "datasets.yaml"
    path.write_text(yaml.safe_dump(content))
    return load(path)


Open = Callable[..., WindowDataset]


@pytest.fixture
def train(root: Path, registry: Registry) -> Open:
    """A function that opens train with windows of 6 + 1 frames by default."""

    def open_windows(
        folder: Path = root,
        *,
        subset: str | list[str] = "train",
        **changes: int,
    ) -> WindowDataset:
        lengths: dict[str, Any] = {"history": 6, "future": 1}
        return WindowDataset(
            "cavity",
            size="tiny",
            subset=subset,
            root=folder,
            registry=registry,
            **(lengths | changes),
        )

    return open_windows


Location = dict[str, Any]


@pytest.fixture
def location(root: Path, registry: Registry) -> Location:
    """Where the scenarios lie, as all routes to them take it."""
    return {
        "size": "tiny",
        "root": root,
        "registry": registry,
    }


def batch_of(data: WindowDataset, *numbers: int) -> Batch:
    """Return a batch of some windows."""
    windows = [data[number] for number in numbers]
    return collate(windows)


def assert_same(batch: Batch, expected: Batch) -> None:
    """Assert that two batches have the same bits."""
    for name in (
        "position",
        "sample",
        "material",
        "wall_velocity",
        "scenario",
        "frame",
    ):
        values = getattr(batch, name)
        expected_values = getattr(expected, name)
        assert torch.equal(values, expected_values), name


def stored_frames(scenario: int) -> Any:
    """Return the positions of a scenario of train, shape [frame, particle, 2]."""
    frame_count = FRAMES[scenario]
    particle_count = PARTICLES[scenario]
    return frames_of(scenario, frame_count, particle_count)


def test_every_window_is_the_stored_frames(train: Open) -> None:
    """All windows of all scenarios, each once: 34 + 20 + 25 of 40, 26 and 31 frames."""
    data = train()
    assert len(data) == WINDOWS
    number = 0
    for scenario, frame_count in FRAMES.items():
        frames = stored_frames(scenario)
        for first in range(frame_count - LENGTH + 1):
            window = data[number]
            assert window.scenario == scenario
            assert window.frame == first
            in_window = frames[first : first + LENGTH]
            expected = in_window.transpose(1, 0, 2)
            position = window.position.numpy()
            assert_array_equal(position, expected)
            assert window.position.is_contiguous()
            assert window.origin is None
            number += 1
    assert number == WINDOWS


def test_a_window_has_materials_and_velocities_of_walls(train: Open) -> None:
    """The velocities of the walls are those of its own frames."""
    data = train(history=2, future=0)
    window = data[3]
    materials = window.material.tolist()
    assert materials == [0, 1, 2, 3, 0, 1, 2, 3]
    assert window.material.dtype == torch.int64
    assert window.wall_velocity is not None
    at_rest = [0, 0]
    top = [0.125, 0]
    of_one_frame = [at_rest, at_rest, at_rest, top]
    wall_velocity = window.wall_velocity.tolist()
    assert wall_velocity == [of_one_frame, of_one_frame]


def test_without_material_all_is_liquid(tmp_path: Path, train: Open) -> None:
    """Without moving walls there is no velocity of walls."""
    for scenario, frames in FRAMES.items():
        key = make_key(scenario, subset="train")
        path, _ = write_scenario(
            tmp_path,
            key,
            frames=frames,
            walls=False,
        )
        with h5py.File(path, "a") as file:
            del file["material"]
    data = train(tmp_path)
    batch = batch_of(data, 0, 40)
    assert not batch.material.any()
    assert batch.material.dtype == torch.int64
    assert batch.wall_velocity is None
    assert not scenario_batch(path).material.any()


def test_arrays_tensors_and_open_split_agree(
    generated: GenerationResult, unmeasured: Registry
) -> None:
    """Both public routes give the frames of the lazy xarray data set."""
    location: dict[str, Any] = {
        "subset": "valid",
        "size": "tiny",
        "root": generated.root,
    }
    options: dict[str, Any] = {
        "history": 3,
        "future": 2,
        "origin": True,
        "registry": unmeasured,
    }
    arrays = lagbench.windows("curl-noise", **location, **options)
    tensors = WindowDataset("curl-noise", **location, **options)
    with lagbench.open_split("curl-noise", **location) as truth:
        window_count = sum(truth.frame_count.values - 4)
        assert len(arrays) == window_count
        assert len(tensors) == window_count
        windows = zip(arrays, tensors, strict=True)
        for number, (array, tensor) in enumerate(windows):
            place = arrays.place(number)
            assert place == (array.scenario, array.frame)
            assert tensor.scenario == array.scenario
            assert tensor.frame == array.frame
            scenario = truth.sel(scenario=array.scenario)
            end = array.frame + 5
            frames = scenario.isel(frame=slice(array.frame, end))
            position = frames.position
            expected = {
                "position": position.transpose("particle", "frame", "space"),
                "origin": scenario.position.isel(frame=0),
                "material": frames.material,
                "wall_velocity": frames.wall_velocity,
            }
            for name, variable in expected.items():
                values = variable.values
                assert_array_equal(getattr(array, name), values)
                assert_array_equal(getattr(tensor, name), values)


def test_the_task_gives_the_default_history(location: Location) -> None:
    data = lagbench.windows("cavity", **location)
    assert data.history == 6
    assert data.future == 1
    assert data.length == 7
    assert data.gravity == 0.0
    assert data.viscosity is None


def write_viscous(
    folder: Path,
    registry: Registry,
    *,
    split: str,
    stated: dict[int, object],
) -> None:
    """Write the valid subset of a tiny split, some scenarios with a viscosity."""
    size = registry.size(split, "tiny")
    for scenario in size.subsets["valid"]:
        parameters: dict[str, object] = {"grid": 16}
        if scenario in stated:
            parameters["viscosity"] = stated[scenario]
        write_scenario(
            folder,
            make_key(scenario, subset="valid", split=split),
            frames=size.frame_count(scenario),
            walls=split == "cavity",
            parameters=parameters,
        )


@pytest.fixture
def viscous(tmp_path: Path, unmeasured: Registry) -> int:
    """A scenario of cavity that states a viscosity; others of its subset do not."""
    size = unmeasured.size("cavity", "tiny")
    scenario = size.subsets["valid"][0]
    write_viscous(
        tmp_path,
        unmeasured,
        split="cavity",
        stated={scenario: 2e-3},
    )
    return scenario


def test_windows_have_the_viscosity_of_their_scenario(
    tmp_path: Path, unmeasured: Registry, viscous: int
) -> None:
    """Windows of loaders and of rollouts agree."""
    options: dict[str, Any] = {
        "subset": "valid",
        "size": "tiny",
        "root": tmp_path,
        "registry": unmeasured,
    }
    data = WindowDataset("cavity", **options)
    path = scenario_paths("cavity", **options)[viscous]
    expected = torch.tensor([2e-3])
    of_loader = batch_of(data, 0)
    of_rollout = scenario_batch(path)
    torch.testing.assert_close(of_loader.viscosity, expected)
    torch.testing.assert_close(of_rollout.viscosity, expected)


def test_windows_have_the_viscosity_of_the_data_set_where_files_state_none(
    tmp_path: Path, unmeasured: Registry
) -> None:
    """That of curl noise is the effective one of its task."""
    write_viscous(tmp_path, unmeasured, split="curl-noise", stated={})
    data = lagbench.windows(
        "curl-noise",
        subset="valid",
        size="tiny",
        root=tmp_path,
        registry=unmeasured,
    )
    task = unmeasured.size("curl-noise", "tiny").task
    assert task.effective_viscosity is not None
    assert data.viscosity == task.effective_viscosity
    assert data[0].viscosity == task.effective_viscosity


def test_collate_puts_windows_side_by_side(train: Open) -> None:
    """Each window keeps its number, scenario and first frame."""
    data = train()
    first = data[2]  # of 8 particles
    second = data[34 + 20 + 1]  # of 11 particles
    batch = collate([first, second])
    of_first = 8 * [0]
    of_second = 11 * [1]
    assert batch.sample.tolist() == of_first + of_second
    assert batch.scenario.tolist() == [0, 2]
    assert batch.frame.tolist() == [2, 1]
    position_of_second = batch.position[8:]
    assert torch.equal(position_of_second, second.position)
    assert batch.material.shape == (19,)
    assert batch.wall_velocity is not None
    expected_shape = (2, LENGTH, 4, 2)
    assert batch.wall_velocity.shape == expected_shape


def test_changing_a_window_changes_nothing_else(train: Open, root: Path) -> None:
    """Noise added in place reaches neither the cache nor the file."""
    data = train()
    path = next(root.rglob("0000.nc"))
    stored = path.read_bytes()
    position = data[0].position.clone()
    changed = data[0]
    for values in (
        changed.position,
        changed.material,
        changed.wall_velocity,
    ):
        assert values is not None
        values.fill_(7)
    assert torch.equal(data[0].position, position)
    batch = batch_of(data, 0)
    assert batch.material.max() == 3
    assert batch.wall_velocity is not None
    assert batch.wall_velocity.max() == 0.125
    assert path.read_bytes() == stored


SOME_FRAMES = 10 * 8 * 8
"""Bytes of ten frames of eight particles."""


@pytest.mark.parametrize("limit", [0, 100, SOME_FRAMES])
def test_memory_is_bounded(train: Open, limit: int) -> None:
    """With any limit of the cache windows are the same."""
    data = train(cache_bytes=limit)
    whole = train()
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(data), generator=generator)
    for number in order.tolist():
        position = data[number].position
        expected = whole[number].position
        assert torch.equal(position, expected)
        assert data.store.cached_bytes <= limit
    frames = data.store._cached_frames.values()
    bytes_of_frames = sum(frame.nbytes for frame in frames)
    assert bytes_of_frames == data.store.cached_bytes
    for frame in frames:
        assert frame.base is None


def test_every_epoch_draws_every_window_once(train: Open) -> None:
    """Epochs are different orders of all windows; seed and epoch alone decide them."""
    data = train()
    sampler = WindowSampler(data, seed=5)
    epochs = [list(sampler) for _ in range(3)]
    for epoch in epochs:
        assert sorted(epoch) == list(range(WINDOWS))
    assert epochs[0] != epochs[1]
    assert epochs[1] != epochs[2]
    state = sampler.state_dict()
    assert state == {"seed": 5, "epoch": 3, "position": 0}

    without_cache = train(cache_bytes=0)
    same_seed = WindowSampler(without_cache, seed=5)
    same_epochs = [list(same_seed) for _ in range(3)]
    assert same_epochs == epochs
    another_seed = WindowSampler(data, seed=6)
    assert list(another_seed) != epochs[0]


def test_the_order_of_a_seed_stays(train: Open) -> None:
    """A change would break the resumption of older runs."""
    sampler = WindowSampler(train(), seed=0)
    beginning = sampler.order(0)[:8]
    assert beginning.tolist() == [61, 70, 63, 8, 2, 53, 11, 18]


def test_the_last_position_is_the_end_of_the_epoch(train: Open) -> None:
    sampler = WindowSampler(train(), seed=0)
    epoch = np.int64(3)
    position = np.int64(WINDOWS)
    sampler.seek(epoch, position)  # type: ignore[arg-type]
    state = sampler.state_dict()
    assert state == {"seed": 0, "epoch": 3, "position": WINDOWS}
    assert json.loads(json.dumps(state)) == state
    beyond = {"seed": 9, "epoch": 4, "position": WINDOWS + 1}
    with pytest.raises(UsageError):
        sampler.load_state_dict(beyond)
    with pytest.raises(UsageError):
        sampler.seek(4, WINDOWS + 1)
    assert sampler.state_dict() == state


def repeat_epochs(sampler: WindowSampler) -> Iterator[int]:
    """Yield the windows of endless epochs."""
    return itertools.chain.from_iterable(itertools.repeat(sampler))


def next_of(windows: Iterator[int], count: int) -> list[int]:
    """Return the next windows that a sampler draws."""
    return list(itertools.islice(windows, count))


@pytest.mark.parametrize(
    "drawn",
    [
        0,
        1,
        30,
        WINDOWS - 1,
        WINDOWS,
        WINDOWS + 3,
    ],
)
def test_resuming_continues_bit_by_bit(train: Open, drawn: int) -> None:
    """A sampler loaded from a state in mid-epoch goes on as the first would have."""
    first = WindowSampler(train(), seed=3)
    windows = repeat_epochs(first)
    assert len(next_of(windows, drawn)) == drawn
    stored_state = json.dumps(first.state_dict())
    second = WindowSampler(train(), seed=0)
    second.load_state_dict(json.loads(stored_state))

    resumed = repeat_epochs(second)
    expected = next_of(windows, 2 * WINDOWS)
    assert next_of(resumed, 2 * WINDOWS) == expected


def test_ranks_share_out_one_order(train: Open) -> None:
    """Three ranks draw every third window each, together all but the last few."""
    data = train()
    alone = WindowSampler(data, seed=1)
    order = alone.order(0).tolist()
    share = WINDOWS // 3
    for rank in range(3):
        sampler = WindowSampler(data, seed=1, rank=rank, ranks=3)
        assert len(sampler) == share
        of_rank = order[rank::3]
        assert list(sampler) == of_rank[:share]


@pytest.mark.filterwarnings(
    "ignore:This DataLoader will create:UserWarning"
)  # on one core
def test_worker_processes_read_the_same(train: Open) -> None:
    """They are forked after this process has opened the files."""
    data = train()
    assert data[0].scenario == 0

    def load_batches(workers: int) -> list[Batch]:
        loader = DataLoader(
            data,
            5,
            sampler=WindowSampler(data, seed=2),
            collate_fn=collate,
            num_workers=workers,
        )
        return list(loader)

    expected_batches = load_batches(0)
    batches = load_batches(2)
    assert len(expected_batches) == 16
    for batch, expected in zip(batches, expected_batches, strict=True):
        assert_same(batch, expected)


Paths = dict[int, Path]


@pytest.fixture
def paths_of_test(location: Location) -> Paths:
    """The files of the test scenarios."""
    return scenario_paths("cavity", **location)


def test_whole_scenarios_lie_side_by_side(paths_of_test: Paths) -> None:
    files = list(paths_of_test.values())
    batch = scenario_batch(files, slice(3, 9))
    assert list(paths_of_test) == [4, 5]
    assert batch.windows == 2
    assert batch.frames == 6
    assert batch.scenario.tolist() == [4, 5]
    assert batch.frame.tolist() == [3, 3]
    for row, scenario in enumerate(paths_of_test):
        all_frames = frames_of(scenario, 26, 8)
        expected = all_frames[3:9].transpose(1, 0, 2)
        is_of_scenario = batch.sample == row
        position = batch.position[is_of_scenario]
        assert_array_equal(position.numpy(), expected)


def write_train(root: Path) -> Path:
    """Write the scenarios of train and return their folder."""
    for scenario, frame_count in FRAMES.items():
        key = make_key(scenario, subset="train")
        write_scenario(root, key, frames=frame_count)
    return next(root.rglob("train"))


def assert_data_error(data: WindowDataset, number: int, words: str) -> None:
    """Assert that a window cannot be read, and that the error names its file."""
    scenario, _ = data.place(number)
    with pytest.raises(DataError) as caught:
        data[number]
    assert f"000{scenario}.nc" in str(caught.value)


def test_a_scenario_of_another_length_is_refused(tmp_path: Path, train: Open) -> None:
    write_train(tmp_path)
    key = make_key(1, subset="train")
    one_more = FRAMES[1] + 1
    write_scenario(tmp_path, key, frames=one_more)
    assert_data_error(train(tmp_path), 40, "not that of the registry")


def test_a_scenario_of_another_hash_is_refused(
    tmp_path: Path, registry: Registry
) -> None:
    path = write_train(tmp_path) / "0002.nc"
    another_hash = "0" * 16
    measured = SimpleNamespace(scenario_sha256={2: another_hash})
    tiny = registry.size("cavity", "tiny")
    measured_tiny = tiny.model_copy(update={"measured": measured})
    store = store_windows.FrameStore(measured_tiny, {2: path})
    with pytest.raises(DataError) as caught:
        store.frames(2, 0, 2)
    assert caught.value.where == str(path)


def test_verify_refuses_a_changed_value(tmp_path: Path, train: Open) -> None:
    """The file states its old hash; without the check its values are read as they are.

    Files that were hashed are noted, and a change after that is noticed too.
    """
    folder = write_train(tmp_path)
    unverified = train(tmp_path)
    verified = train(tmp_path, verify=True)
    assert len(verified) == len(unverified)
    path = folder / "0001.nc"
    with h5py.File(path, "r+") as file:
        file["position"][3, 2, 0] += np.float32(1e-3)
    assert isinstance(train(tmp_path)[40], Window)
    with pytest.raises(DataError) as caught:
        train(tmp_path, verify=True)
    assert str(path) in str(caught.value.where)


def extrapolate(batch: Batch) -> torch.Tensor:
    """Move particles on as before, plus the walls' velocities of the next frame."""
    last_two = batch.position[:, -2:]
    before, now = last_two.unbind(1)
    assert batch.wall_velocity is not None
    next_wall_velocity = batch.wall_velocity[batch.sample, batch.frames]
    return 2 * now - before + next_wall_velocity.sum(1)


def test_a_window_is_followed_by_a_frame(train: Open) -> None:
    """The first frame leaves, the new one joins, with forcing and frame number."""
    data = train(history=3, future=2)
    batch = batch_of(data, 0, 4)
    window = batch.part(slice(3))
    next_position = batch.position[:, 3]
    later = window.followed_by(next_position)
    expected = batch.part(slice(1, 4))
    assert_same(later, expected)
    assert later.frame.tolist() == [1, 5]
    assert window.frames == 3
    assert later.frames == 3


@pytest.mark.parametrize(
    "frames",
    [
        slice(0, 4, 2),
        slice(None, None, -1),
        slice(2, 2),
        slice(9, 12),
        slice("a"),
        slice(None, None, 0),
        1,
        None,
    ],
)
def test_parts_are_consecutive_frames(train: Open, frames: Any) -> None:
    """With steps the forcing would be that of another frame."""
    data = train(history=3, future=2)
    batch = batch_of(data, 0, 4)
    with pytest.raises(UsageError):
        batch.part(frames)


def test_a_rollout_feeds_on_itself(train: Open) -> None:
    """By hand: x2 = 2 x1 - x0 + w2 and x3 = 2 x2 - x1 + w3, with gradients."""
    data = train(history=2, future=2)
    batch = batch_of(data, 0, 40)
    assert batch.wall_velocity is not None
    x0 = batch.position[:, 0].requires_grad_()
    x1 = batch.position[:, 1]
    wall_velocity = batch.wall_velocity[batch.sample]
    w2 = wall_velocity[:, 2].sum(1)
    w3 = wall_velocity[:, 3].sum(1)
    x2 = 2 * x1 - x0 + w2
    x3 = 2 * x2 - x1 + w3
    expected = torch.stack([x2, x3], 1)

    given = torch.stack([x0, x1], 1)
    window = replace(batch.part(slice(2)), position=given)
    path = roll_out(extrapolate, window, 2)
    assert torch.equal(path, expected)
    path.sum().backward()
    assert x0.grad is not None
    expected_gradient = torch.full_like(x0, -3.0)
    assert torch.equal(x0.grad, expected_gradient)


@pytest.fixture
def two_frames(train: Open) -> Batch:
    """A window of two frames with the forcing of three more."""
    data = train(history=2, future=3)
    return batch_of(data, 0).part(slice(2))


def last_position(batch: Batch) -> torch.Tensor:
    """Leave every particle where it is."""
    return batch.position[:, -1]


def test_a_rollout_ends_where_the_forcing_does(two_frames: Batch) -> None:
    """A model that takes the last known velocity of walls would be wrong unseen."""
    path = roll_out(extrapolate, two_frames, 3)
    assert path.shape[1] == 3
    with pytest.raises(UsageError) as caught:
        roll_out(last_position, two_frames, 4)
    assert caught.value.where == "roll_out"


def test_a_model_may_use_the_memory_of_its_output_again(two_frames: Batch) -> None:
    """Every frame of the rollout is as the model returned it."""
    memory = torch.empty_like(last_position(two_frames))

    def extrapolate_into_memory(batch: Batch) -> torch.Tensor:
        return memory.copy_(extrapolate(batch))

    path = roll_out(extrapolate_into_memory, two_frames, 3)
    expected = roll_out(extrapolate, two_frames, 3)
    assert torch.equal(path, expected)


@pytest.mark.parametrize("history", [None, 2])
def test_predictions_are_rollouts_of_the_task(
    location: Location, registry: Registry, history: int | None
) -> None:
    """They start from the last input frames of every test scenario.

    They reach over the horizon, with the walls of these frames.
    """
    batches: list[Batch] = []

    def step(batch: Batch) -> torch.Tensor:
        batches.append(batch)
        return extrapolate(batch)

    rollouts = predict(
        step,
        "cavity",
        history=history,
        device="cpu",
        **location,
    )
    predictions = dict(rollouts)
    assert list(predictions) == [4, 5]

    task = registry.size("cavity", "tiny").task
    input_frames = task.input_frames
    start = input_frames - (history or input_frames)
    paths = scenario_paths("cavity", **location)
    for row, (scenario, path) in enumerate(paths.items()):
        window = scenario_batch(path).part(slice(start, input_frames))
        assert_same(batches[row * task.horizon], window)
        rollout = roll_out(extrapolate, window, task.horizon)
        expected = rollout.transpose(0, 1).numpy()
        prediction = predictions[scenario]
        assert prediction.dtype == np.float32
        assert_array_equal(prediction, expected)
