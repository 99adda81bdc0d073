"""Windows are the stored frames, in a seeded order that can be resumed, in bounded
memory.
"""

from __future__ import annotations

import itertools
import json
import os
import pickle
import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml
from scenario_factory import frames_of, make_key, write_scenario
from torch.utils.data import DataLoader

import lagbench
from lagbench import torch as lagbench_torch
from lagbench.baselines.rollout import scenario_batch, scenario_paths
from lagbench.data.registry import Registry, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError
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
    """A folder with three scenarios of train, of unequal lengths and particle numbers,
    and two of test.
    """
    folder = tmp_path_factory.mktemp("windows")
    for i, frames in FRAMES.items():
        write_scenario(
            folder, make_key(i, subset="train"), frames=frames, particles=PARTICLES[i]
        )
    for i in (4, 5):
        write_scenario(folder, make_key(i, subset="test"), frames=26)
    return folder


@pytest.fixture(scope="module")
def registry(
    tmp_path_factory: pytest.TempPathFactory, unmeasured_path: Path
) -> Registry:
    """A registry that describes these scenarios as cavity tiny."""
    held = read_yaml(unmeasured_path)
    tiny = held["splits"]["cavity"]["sizes"]["tiny"]
    tiny["subsets"] = {"train": "0-2", "valid": 3, "test": "4-5"}
    tiny["frames"] = {40: "0", 26: "1,3-5", 31: "2"}
    path = tmp_path_factory.mktemp("registry") / "datasets.yaml"
    path.write_text(yaml.safe_dump(held))
    return load(path)


Open = Callable[..., WindowDataset]


@pytest.fixture
def train(root: Path, registry: Registry) -> Open:
    """A function that opens train with windows of 6 + 1 frames unless told
    otherwise.
    """

    def opened(
        folder: Path = root, *, subset: str | list[str] = "train", **changes: int
    ) -> WindowDataset:
        lengths = {"history": 6, "future": 1, **changes}
        return WindowDataset(
            "cavity",
            size="tiny",
            subset=subset,
            root=folder,
            registry=registry,
            **lengths,
        )

    return opened


def same(a: Batch, b: Batch) -> bool:
    """Tell whether two batches hold the same bits."""
    names = ("position", "sample", "material", "wall_velocity", "scenario", "frame")
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in names)


def test_every_window_is_the_stored_frames(train: Open) -> None:
    """All windows of all scenarios, each once: 34 + 20 + 25 of 40, 26 and 31 frames.

    Where it is asked for, each holds the scenario's frame 0, which batches put side by
    side.
    """
    data = train()
    more = train(origin=True)
    assert len(data) == len(more) == WINDOWS
    places = []
    for window, other in ((data[i], more[i]) for i in range(len(data))):
        frames = frames_of(
            window.scenario, FRAMES[window.scenario], PARTICLES[window.scenario]
        )
        expected = frames[window.frame : window.frame + LENGTH]
        np.testing.assert_array_equal(
            window.position.numpy(), expected.transpose(1, 0, 2)
        )
        np.testing.assert_array_equal(other.origin, frames[0])
        assert torch.equal(window.position, other.position)
        assert window.position.is_contiguous()
        assert window.origin is None
        places.append((window.scenario, window.frame))
    assert places == [
        (i, f) for i, frames in FRAMES.items() for f in range(frames - LENGTH + 1)
    ]
    assert collate([more[3], more[40]]).origin[PARTICLES[0] :].equal(more[40].origin)
    with pytest.raises(UsageError):
        collate([more[3], data[40]])
    # windows of several subsets follow each other
    both = train(subset=["test", "train"])
    assert len(both) == WINDOWS + 2 * 20
    assert [both.place(i) for i in (0, 40, -1)] == [(4, 0), (0, 0), (2, 24)]


def test_material_and_walls(tmp_path: Path, train: Open) -> None:
    """A window holds the particles' materials and its own frames of the walls'
    velocity.

    Without material all is liquid, without moving walls there is no velocity of walls.
    """
    window = train(history=2, future=0)[3]
    assert window.material.tolist() == [0, 1, 2, 3, 0, 1, 2, 3]
    assert window.material.dtype == torch.int64
    assert window.wall_velocity is not None
    assert window.wall_velocity.tolist() == 2 * [[[0, 0], [0, 0], [0, 0], [0.125, 0]]]
    for i, frames in FRAMES.items():
        path, _ = write_scenario(
            tmp_path, make_key(i, subset="train"), frames=frames, walls=False
        )
        with h5py.File(path, "a") as file:
            del file["material"]
    batch = collate([train(tmp_path)[i] for i in (0, 40)])
    assert not batch.material.any()
    assert batch.material.dtype == torch.int64
    assert batch.wall_velocity is None
    assert not scenario_batch(path).material.any()


def test_arrays_tensors_and_open_split_agree(
    generated: GenerationResult, unmeasured: Registry
) -> None:
    """Both public routes give, value for value, the frames of the lazy xarray data
    set.
    """
    options: dict[str, Any] = {
        "subset": "valid",
        "size": "tiny",
        "root": generated.root,
        "history": 3,
    }
    options |= {"future": 2, "origin": True, "registry": unmeasured}
    arrays = lagbench.windows("curl-noise", **options)
    tensors = WindowDataset("curl-noise", **options)
    truth = lagbench.open_split(
        "curl-noise", subset="valid", size="tiny", root=generated.root
    )
    assert len(arrays) == len(tensors) == sum(truth.frame_count.values - 4)
    for number, (array, tensor) in enumerate(zip(arrays, tensors, strict=True)):
        assert (
            arrays.place(number)
            == (array.scenario, array.frame)
            == (tensor.scenario, tensor.frame)
        )
        frames = truth.sel(scenario=array.scenario).isel(
            frame=slice(array.frame, array.frame + 5)
        )
        expected = {
            "position": frames.position.transpose("particle", "frame", "space"),
            "origin": truth.position.sel(scenario=array.scenario).isel(frame=0),
            **{name: frames[name] for name in ("material", "wall_velocity")},
        }
        for name, values in expected.items():
            np.testing.assert_array_equal(getattr(array, name), values.values)
            np.testing.assert_array_equal(getattr(tensor, name), values.values)
    truth.close()


def test_what_is_published_comes_along(
    root: Path, registry: Registry, tmp_path: Path, unmeasured: Registry
) -> None:
    """The task gives the default history; gravity and viscosity are told where all
    scenarios share them.
    """
    box = lagbench.windows("cavity", size="tiny", root=root, registry=registry)
    assert box.history == 6
    assert box.future == 1
    assert box.length == 7
    assert box.gravity == 0.0
    assert box.viscosity is None
    for i in unmeasured.size("fluid", "tiny").subsets["valid"]:
        frames = unmeasured.size("fluid", "tiny").frame_count(i)
        write_scenario(
            tmp_path,
            make_key(i, subset="valid", split="fluid"),
            frames=frames,
            walls=False,
        )
    splash = lagbench.windows(
        "fluid", subset="valid", size="tiny", root=tmp_path, registry=unmeasured
    )
    assert splash.history == 2
    assert splash.gravity == 2.5
    assert splash.viscosity == 1e-3


def test_collate_puts_windows_side_by_side(train: Open) -> None:
    """Windows of 8 and 11 particles make one row; each keeps its number, scenario and
    first frame.

    No windows, unequal lengths and walls that move in some only are errors.
    """
    data = train()
    windows = [data[2], data[34 + 20 + 1]]
    batch = collate(windows)
    assert batch.sample.tolist() == 8 * [0] + 11 * [1]
    assert batch.scenario.tolist() == [0, 2]
    assert batch.frame.tolist() == [2, 1]
    assert torch.equal(batch.position[8:], windows[1].position)
    assert batch.material.shape == (19,)
    assert batch.wall_velocity is not None
    assert batch.wall_velocity.shape == (2, LENGTH, 4, 2)
    window = windows[0]
    for windows in (
        [],
        [window, train(history=3)[0]],
        [window, window._replace(wall_velocity=None)],
    ):
        with pytest.raises(UsageError) as caught:
            collate(windows)
        assert caught.value.where == "collate"


def test_changing_a_window_changes_nothing_else(train: Open, root: Path) -> None:
    """Noise added to a window in place reaches neither the cache nor the file."""
    data = train()
    path = next(root.rglob("0000.nc"))
    stored = path.read_bytes()
    first = data[0].position.clone()
    spoilt = data[0]
    for values in (spoilt.position, spoilt.material, spoilt.wall_velocity):
        assert values is not None
        values.fill_(7)
    assert torch.equal(data[0].position, first)
    batch = collate([data[0]])
    assert batch.material.max() == 3
    assert batch.wall_velocity is not None
    assert batch.wall_velocity.max() == 0.125
    assert path.read_bytes() == stored


@pytest.mark.parametrize("limit", [0, 100, 10 * 8 * 8])
def test_memory_is_bounded(train: Open, limit: int) -> None:
    """However little may be kept, windows are the same and no more is kept."""
    data = train(cache_bytes=limit)
    whole = train()
    for i in torch.randperm(
        len(data), generator=torch.Generator().manual_seed(0)
    ).tolist():
        assert torch.equal(data[i].position, whole[i].position)
        assert data.store.cached_bytes <= limit
    kept = sum(frame.nbytes for frame in data.store._cached_frames.values())
    assert kept == data.store.cached_bytes
    assert all(frame.base is None for frame in data.store._cached_frames.values())


def test_open_files_are_bounded(train: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one file open at a time, others are opened anew."""

    def open_scenarios() -> set[Path]:
        return {
            path
            for path in Path("/proc/self/fd").iterdir()
            if path.resolve().suffix == ".nc"
        }

    before = open_scenarios()
    monkeypatch.setattr(store_windows, "OPEN_FILES", 1)
    data = train(cache_bytes=0)
    for i in (0, 40, 60, 0, 40, 60):
        assert data[i].scenario == data.place(i)[0]
        assert len(data.store._open_scenarios) == 1
        assert len(open_scenarios() - before) <= 1


def test_the_systems_limit_of_files_is_no_damage(train: Open) -> None:
    """Where the system opens no more files, the error says that, and reading goes on
    once it does.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    data = train()
    with open(os.devnull) as lowest:
        free = lowest.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        with pytest.raises(WorkFailedError):
            data[0]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert data[0].scenario == data.place(0)[0]


def test_every_epoch_draws_every_window_once(train: Open) -> None:
    """Epochs are different orders of all windows; seed and epoch alone decide them."""
    data = train()
    sampler = WindowSampler(data, seed=5)
    other = WindowSampler(train(cache_bytes=0), seed=5)
    epochs = [list(sampler) for _ in range(3)]
    assert all(sorted(epoch) == list(range(WINDOWS)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    assert epochs == [list(other) for _ in range(3)]
    assert epochs[0] != list(WindowSampler(data, seed=6))
    # pinned: a change would break the resumption of older runs
    assert WindowSampler(data, seed=0).order(0)[:8].tolist() == [
        61,
        70,
        63,
        8,
        2,
        53,
        11,
        18,
    ]
    assert sampler.state_dict() == {"seed": 5, "epoch": 3, "position": 0}


@pytest.mark.parametrize("odd", [-1, 1.5, None, "1"])
def test_places_that_there_are_not(train: Open, odd: Any) -> None:
    """Seeds, epochs and positions are whole numbers from 0.

    The last position is the end of the epoch itself; what is refused moves nothing.
    """
    with pytest.raises(UsageError):
        WindowSampler(train(), seed=odd)
    sampler = WindowSampler(train(), seed=0)
    sampler.seek(np.int64(3), np.int64(WINDOWS))  # type: ignore[arg-type]
    assert json.loads(json.dumps(sampler.state_dict())) == sampler.state_dict()
    for epoch, position in ((odd, 0), (0, odd), (4, WINDOWS + 1)):
        with pytest.raises(UsageError):
            sampler.load_state_dict({"seed": 9, "epoch": epoch, "position": position})
    with pytest.raises(UsageError):
        sampler.seek(4, WINDOWS + 1)
    assert sampler.state_dict() == {"seed": 0, "epoch": 3, "position": WINDOWS}


def test_an_index_may_be_of_numpy_or_torch(train: Open) -> None:
    """The window is the same, and the caller's index stays."""
    data = train()
    for index in (np.array(-1), torch.tensor(-1)):
        window = data[index]  # type: ignore[index]
        assert window.scenario == data[-1].scenario
        assert window.frame == data[-1].frame
        assert type(window.frame) is int
        assert int(index) == -1


@pytest.mark.parametrize("drawn", [0, 1, 30, WINDOWS - 1, WINDOWS, WINDOWS + 3])
def test_resuming_continues_bit_by_bit(train: Open, drawn: int) -> None:
    """A sampler loaded from a state in mid-epoch draws on as the first would have."""
    first = WindowSampler(train(), seed=3)
    run = itertools.chain.from_iterable(itertools.repeat(first))
    assert len(list(itertools.islice(run, drawn))) == drawn
    second = WindowSampler(train(), seed=0)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    resumed = itertools.chain.from_iterable(itertools.repeat(second))
    count = 2 * WINDOWS
    expected = list(itertools.islice(run, count))
    assert list(itertools.islice(resumed, count)) == expected


def test_ranks_share_out_one_order(
    train: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three ranks draw every third window of the one order each, together all but the
    last few.

    A rank that does not exist, and more ranks than windows, are errors.
    torch.distributed tells its own. What two ranks have not drawn, one rank draws.
    """
    data = train()
    alone = WindowSampler(data, seed=1).order(0).tolist()
    ranks = [WindowSampler(data, seed=1, rank=rank, ranks=3) for rank in range(3)]
    parts = [list(sampler) for sampler in ranks]
    assert (
        [len(sampler) for sampler in ranks]
        == [len(part) for part in parts]
        == 3 * [WINDOWS // 3]
    )
    assert [window for turn in zip(*parts, strict=True) for window in turn] == alone[
        : WINDOWS // 3 * 3
    ]
    for rank, count in ((2, 2), (-1, 2), (0, WINDOWS + 1)):
        with pytest.raises(UsageError) as caught:
            WindowSampler(data, seed=0, rank=rank, ranks=count)
        assert caught.value.where == "WindowSampler"
    for name, value in {
        "is_initialized": True,
        "get_rank": 1,
        "get_world_size": 3,
    }.items():
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)
    assert list(WindowSampler(data, seed=1)) == parts[1]
    monkeypatch.undo()
    two = WindowSampler(data, seed=1, rank=1, ranks=2)
    one = WindowSampler(data, seed=1)
    assert len(list(itertools.islice(two, 5))) == 5
    one.load_state_dict(two.state_dict())
    assert list(one) == alone[10:]


def test_a_pool_shares_its_frames(train: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for one pool, an epoch reads hardly more frames than there are, not
    seven times as many.
    """
    monkeypatch.setattr(lagbench_torch, "RUN", 8)
    data = train(cache_bytes=3 * 14 * 11 * 8)
    monkeypatch.setattr(lagbench_torch, "POOL_BYTES", 3 * 14 * data.frame_bytes)
    read: list[int] = []
    inner = store_windows.FrameStore._read

    def counted(
        store: store_windows.FrameStore, scenario: int, first: int, last: int
    ) -> object:
        read.extend(range(first, last))
        return inner(store, scenario, first, last)

    monkeypatch.setattr(store_windows.FrameStore, "_read", counted)
    order = list(WindowSampler(data, seed=0))
    assert sorted(order) == list(range(WINDOWS))
    assert all(
        len({data.place(i)[0] for i in order[k : k + 24]}) <= 3
        for k in range(0, WINDOWS, 24)
    )
    for i in order:
        data[i]
    # a run of 8 windows has 14 frames: 79 windows at 14/8 frames, and a few more of
    # shorter runs
    assert len(read) <= 2 * WINDOWS


@pytest.mark.filterwarnings(
    "ignore:This DataLoader will create:UserWarning"
)  # on one core
def test_worker_processes_read_the_same(train: Open) -> None:
    """Two forked workers, after this process has opened the files, give the batches of
    none.

    A pickled data set takes neither open files nor frames along.
    """
    data = train()
    first = data[0]
    sent = pickle.loads(pickle.dumps(data))
    assert sent.store.cached_bytes == 0
    assert len(sent.store._open_scenarios) == 0
    assert torch.equal(sent[0].position, first.position)
    batches = [
        list(
            DataLoader(
                data,
                5,
                sampler=WindowSampler(data, seed=2),
                collate_fn=collate,
                num_workers=count,
            )
        )
        for count in (0, 2)
    ]
    assert len(batches[0]) == 16
    assert all(same(a, b) for a, b in zip(*batches, strict=True))


def test_whole_scenarios_for_rollouts(root: Path, registry: Registry) -> None:
    """All test scenarios side by side; unequal lengths do not go together."""
    paths = scenario_paths("cavity", size="tiny", root=root, registry=registry)
    batch = scenario_batch(list(paths.values()), slice(3, 9))
    assert list(paths) == [4, 5]
    assert batch.windows == 2
    assert batch.frames == 6
    assert batch.scenario.tolist() == [4, 5]
    assert batch.frame.tolist() == [3, 3]
    for row, scenario in enumerate(paths):
        expected = frames_of(scenario, 26, 8)[3:9].transpose(1, 0, 2)
        position = batch.position[batch.sample == row]
        np.testing.assert_array_equal(position.numpy(), expected)
    assert scenario_batch(paths[4]).frames == 26
    assert scenario_batch(paths[4], slice(-2, None)).frame.tolist() == [24]
    for frames in (slice(50, 60), slice(0, 10, 2), slice(5, 5)):
        with pytest.raises(UsageError) as caught:
            scenario_batch(paths[4], frames)
        assert caught.value.where.endswith("cavity/tiny/v2/test/0004.nc")
    with pytest.raises(UsageError) as caught:
        scenario_batch(sorted(root.rglob("*.nc")))
    assert caught.value.where == "collate"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"subset": "trian"}, "did you mean 'train'"),
        ({"size": "tiney"}, "did you mean 'tiny'"),
        ({"split": "cavty"}, "did you mean 'cavity'"),
        ({"history": 40}, "no scenario is as long as a window"),
        ({"history": 0}, "at least one given frame"),
        ({"subset": []}, "0 scenarios"),
        ({"cache_bytes": -1}, "cache_bytes -1"),
        (
            {"subset": "valid"},
            "1 of 1 scenarios are not there.*missing: 3.*lagbench generate",
        ),
    ],
)
def test_what_is_not_there_is_said(
    root: Path, registry: Registry, options: dict[str, object], words: str
) -> None:
    """Unknown names, too few frames and missing files are errors that say what to
    do.
    """
    given: dict[str, Any] = {"split": "cavity", "size": "tiny", "history": 6, **options}
    with pytest.raises(LagbenchError, match="(?s)" + words):
        WindowDataset(**given, root=root, registry=registry)


def test_another_scenario_under_its_name_is_refused(
    tmp_path: Path, train: Open, registry: Registry
) -> None:
    """Files of another id or length, or of other values than the registry's hash names,
    are data errors.

    So are bytes that are no netCDF file.
    """
    for i, frames in FRAMES.items():
        write_scenario(tmp_path, make_key(i, subset="train"), frames=frames + (i == 1))
    folder = next(tmp_path.rglob("train"))
    (folder / "0002.nc").rename(folder / "kept")
    (folder / "0002.nc").write_bytes((folder / "0000.nc").read_bytes())
    (folder / "0000.nc").write_bytes(b"nothing")
    data = train(tmp_path)
    for window, words in (
        (0, "damaged"),
        (40, "not that of the registry"),
        (60, "not that of the registry"),
    ):
        with pytest.raises(DataError, match=words) as caught:
            data[window]
        assert f"000{data.place(window)[0]}.nc" in str(caught.value)
    (folder / "kept").replace(folder / "0002.nc")
    assert isinstance(data[60], Window)
    with pytest.raises(IndexError):
        data[WINDOWS]
    measured = SimpleNamespace(scenario_sha256={2: "0" * 16})
    size = registry.size("cavity", "tiny").model_copy(update={"measured": measured})
    store = store_windows.FrameStore(size, {2: folder / "0002.nc"})
    with pytest.raises(DataError) as caught:
        store.frames(2, 0, 2)
    assert caught.value.where.endswith("cavity/tiny/v2/train/0002.nc")


def drifting(batch: Batch) -> torch.Tensor:
    """Move every particle on as before, and with what the first wall's successors do on
    the way.
    """
    before, now = batch.position[:, -2:].unbind(1)
    assert batch.wall_velocity is not None
    coming = batch.wall_velocity[batch.sample, batch.frames]  # [particle, wall, 2]
    return 2 * now - before + coming.sum(1)


def test_a_window_is_followed_by_a_frame(train: Open) -> None:
    """The first frame leaves, the new one joins, with forcing and frame number.

    Parts are consecutive frames: with steps the forcing would be another frame's.
    """
    data = train(history=3, future=2)
    batch = collate([data[0], data[4]])
    given = batch.part(slice(3))
    later = given.followed_by(batch.position[:, 3])
    assert same(later, batch.part(slice(1, 4)))
    assert later.frame.tolist() == [1, 5]
    assert given.frames == later.frames == 3
    for odd in (slice(0, 4, 2), slice(None, None, -1), slice(2, 2), slice(9, 12)):
        with pytest.raises(UsageError):
            batch.part(odd)


def test_a_rollout_feeds_on_itself(train: Open) -> None:
    """By hand: x2 = 2 x1 - x0 + w2 and x3 = 2 x2 - x1 + w3, with gradients."""
    data = train(history=2, future=2)
    batch = collate([data[0], data[40]])
    assert batch.wall_velocity is not None
    x0 = batch.position[:, 0].requires_grad_()
    x1 = batch.position[:, 1]
    w2 = batch.wall_velocity[batch.sample, 2].sum(1)
    w3 = batch.wall_velocity[batch.sample, 3].sum(1)
    x2 = 2 * x1 - x0 + w2
    x3 = 2 * x2 - x1 + w3
    expected = torch.stack([x2, x3], 1)
    given_positions = torch.stack([x0, x1], 1)
    given = replace(batch.part(slice(2)), position=given_positions)
    found = roll_out(drifting, given, 2)
    assert torch.equal(found, expected)
    found.sum().backward()
    assert x0.grad is not None
    assert torch.equal(x0.grad, torch.full_like(x0, -3.0))


def test_a_rollout_ends_where_the_forcing_does(train: Open) -> None:
    """Beyond it no wall moves as it did: a model that takes the last velocity known
    would be wrong unseen.

    A model may use the memory of its answer again: every frame is kept as it was
    returned. Answers of another shape than positions (an axis more, a particle too few,
    one axis) or of NumPy, and no frames, are refused.
    """
    given = collate([train(history=2, future=3)[0]]).part(slice(2))
    shapes: list[Callable[[Any], Any]] = [
        lambda p: p[None],
        lambda p: p[:-1],
        lambda p: p[:, :1],
        np.asarray,
    ]
    for wrong in shapes:
        with pytest.raises(UsageError):
            roll_out(lambda seen, wrong=wrong: wrong(seen.position[:, -1]), given, 2)
    with pytest.raises(UsageError):
        roll_out(drifting, given, 0)
    memory = torch.empty_like(given.position[:, -1])
    found = roll_out(drifting, given, 3)
    assert found.shape[1] == 3
    assert torch.equal(
        found, roll_out(lambda seen: memory.copy_(drifting(seen)), given, 3)
    )
    with pytest.raises(UsageError) as caught:
        roll_out(lambda seen: seen.position[:, -1], given, 4)
    assert caught.value.where == "roll_out"


@pytest.mark.parametrize("history", [None, 2])
def test_predictions_are_rollouts_from_what_the_task_gives(
    root: Path, registry: Registry, history: int | None
) -> None:
    """Every test scenario once, from its own last given frames, over the horizon, with
    the walls of then.
    """
    seen: list[Batch] = []

    def step(batch: Batch) -> torch.Tensor:
        seen.append(batch)
        return drifting(batch)

    where: dict[str, Any] = {"size": "tiny", "root": root, "registry": registry}
    found = dict(predict(step, "cavity", history=history, device="cpu", **where))
    for wrong in (0, 7):  # none, or more than the task gives
        with pytest.raises(UsageError) as caught:
            next(predict(drifting, "cavity", history=wrong, **where))
        assert caught.value.where == "predict"
    task = registry.size("cavity", "tiny").task
    assert list(found) == [4, 5]
    files = scenario_paths("cavity", **where)
    for row, (scenario, path) in enumerate(files.items()):
        whole = scenario_batch(path)
        start = task.input_frames - (history or task.input_frames)
        given = whole.part(slice(start, task.input_frames))
        assert same(seen[row * task.horizon], given)
        expected = roll_out(drifting, given, task.horizon).transpose(0, 1)
        assert found[scenario].dtype == np.float32
        np.testing.assert_array_equal(found[scenario], expected.numpy())
