"""Training windows per second from files of cavity full's size, beside two conventional
readers.

    OMP_NUM_THREADS=1 pytest benchmarks/test_windows.py -s

The readers do what geoelements/gns (NPZ, everything in memory) and LagrangeBench (HDF5,
one group per trajectory, windows read when asked for) do for a window of 6 + 1 frames;
all draw windows at random. Files are made without simulating, in seconds: each scenario
is a rotation at its own speed. Ours is timed over whole pools of its sampler,
decompression included, in one process. Memory is that of two fresh processes: one reads
7 scenarios, the other 12.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture
from score_data import write_scenario
from timing import measured_apart
from torch.utils.data import DataLoader

import lagbench
from lagbench.data.layout import ScenarioKey
from lagbench.data.registry import REGISTRY_VARIABLE, default_path, load
from lagbench.data.yamlfile import read_yaml
from lagbench.store.windows import Windows
from lagbench.torch import RUN, WindowDataset, WindowSampler, collate

TARGET = 1000.0
"""Windows per second in one process on an EPYC server; printed only."""

SCENARIOS = 12
"""Their frames fill more than one pool of the sampler."""

FEW = 7
"""So do these."""

TRAJECTORIES = 3
"""Scenarios for the other readers, whose speed does not depend on the number."""

HISTORY = 6
SEED = 0

FRAMES = 600
PARTICLES = 8192
"""Size of one scenario of cavity full."""

RADIUS = 0.43
"""Particles fill a disc of this radius about the centre of the box [length]."""

Frames = NDArray[np.float32]

CHILD = """
import json, sys
from pathlib import Path
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.data.registry import load
root, windows = Path(sys.argv[1]), int(sys.argv[2])
registry = load(root / "datasets.yaml")
data = WindowDataset("cavity", root=root, history=6, registry=registry)
for drawn, index in enumerate(WindowSampler(data, seed=0)):
    data[index]
    if drawn == windows:
        break
peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
print(json.dumps(1024 * peak))
"""


def trajectory(scenario: int) -> Frames:
    """Return positions [length], shape [frame, particle, 2]."""
    return np.stack(list(_rotation(scenario)))


def _rotation(scenario: int) -> Iterator[Frames]:
    """Yield frames of a solid-body rotation of random particles: files compress as real
    ones do.
    """
    rng = np.random.Generator(np.random.PCG64(scenario))
    area_share = rng.random(PARTICLES)
    distance = RADIUS * np.sqrt(area_share)
    start_angle = 2.0 * np.pi * rng.random(PARTICLES)
    rotation = 0.005 * (1 + scenario % 5)  # [1/frame]
    for frame in range(FRAMES):
        angle = start_angle + rotation * frame
        x = 0.5 + distance * np.cos(angle)
        y = 0.5 + distance * np.sin(angle)
        position = np.stack([x, y], axis=1)
        yield position.astype(np.float32)


def write_ours(root: Path, scenarios: int) -> None:
    """Write the train subset as lagbench does, and the registry that describes it."""
    registry_content = read_yaml(default_path())
    cavity = registry_content["splits"]["cavity"]
    size = cavity["sizes"]["full"]
    size["subsets"] = {
        "train": f"0-{scenarios - 1}",
        "valid": f"{scenarios}",
        "test": f"{scenarios + 1}",
    }
    registry_content["measured"] = {}
    path = root / "datasets.yaml"
    path.write_text(yaml.safe_dump(registry_content))
    registry = load(path)
    version = registry.split("cavity").version
    still = np.zeros((PARTICLES, 2), np.float32)
    for i in range(scenarios):
        key = ScenarioKey(
            split="cavity",
            size="full",
            version=version,
            scenario=i,
            subset="train",
        )
        flow = ((position, still) for position in _rotation(i))
        write_scenario(
            root,
            key,
            flow,
            particles=PARTICLES,
            frames=FRAMES,
            wall_velocity=np.zeros((4, 2)),
        )


def write_gns_npz(path: Path, scenarios: int) -> None:
    """Write what geoelements/gns loads into memory: one array per trajectory."""
    arrays = {}
    for i in range(scenarios):
        arrays[f"simulation_trajectory_{i}"] = trajectory(i)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def write_lagrangebench_h5(path: Path, scenarios: int) -> None:
    """Write what LagrangeBench reads: a group per trajectory, gzip in the chunks that
    h5py guesses.
    """
    particle_type = np.zeros(PARTICLES, np.int64)
    with h5py.File(path, "w") as file:
        for i in range(scenarios):
            group = file.create_group(f"{i:05d}")
            group.create_dataset("particle_type", data=particle_type)
            group.create_dataset("position", data=trajectory(i), compression="gzip")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the train subset in our format."""
    folder = tmp_path_factory.mktemp("windows")
    write_ours(folder, SCENARIOS)
    return folder


def dataset(root: Path) -> WindowDataset:
    """Open the train subset with an empty cache."""
    registry = load(root / "datasets.yaml")
    return WindowDataset("cavity", root=root, history=HISTORY, registry=registry)


def rate(
    read: Callable[[int], object],
    indices: Iterator[int] | NDArray[np.int64],
    count: int,
) -> float:
    """Return windows per second of processor time, which hardly changes on a busy
    machine.
    """
    drawn = iter(indices)
    start = time.process_time()
    for _ in range(count):
        read(int(next(drawn)))
    seconds = time.process_time() - start
    return count / seconds


def test_windows_per_second(benchmark: BenchmarkFixture, root: Path) -> None:
    """The sampler's order is read as fast as any order, or faster.

    Each epoch has one random order, decompression included. Windows per second depend
    on the machine: they are printed beside the target.
    """
    data = dataset(root)
    rates: list[float] = []

    def epoch() -> None:
        sampler = WindowSampler(data, seed=SEED + len(rates))
        epoch_rate = rate(data.__getitem__, iter(sampler), len(data))
        rates.append(epoch_rate)

    benchmark.pedantic(epoch, rounds=2)  # type: ignore[no-untyped-call]
    fresh = dataset(root)
    sampler = WindowSampler(fresh, seed=SEED)
    loader = DataLoader(fresh, 2, sampler=sampler, collate_fn=collate)
    start = time.process_time()
    batches = sum(1 for _ in loader)
    seconds = time.process_time() - start
    loaded = 2 * batches / seconds
    rng = np.random.default_rng(SEED)
    any_order = rng.integers(len(data), size=500)
    plain = rate(dataset(root).__getitem__, any_order, 500)
    print(f"\nours, sampler's order: {min(rates):.0f} windows/s (target {TARGET:.0f})")
    print(
        f"ours through DataLoader and collate, batch 2: {loaded:.0f}; any order, cold "
        f"cache: {plain:.0f}"
    )
    assert min(rates) >= plain


def test_public_routes(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The public arrays are read within 10 % of the rate of the trainer's tensors."""
    tensors = dataset(root)
    registry = load(root / "datasets.yaml")
    arrays = lagbench.windows("cavity", root=root, history=HISTORY, registry=registry)
    routes: dict[str, WindowDataset | Windows] = {"tensors": tensors, "arrays": arrays}
    order = list(WindowSampler(tensors, seed=SEED))
    spent = dict.fromkeys(routes, 0.0)
    # In turns over the same windows, so that a machine that slows down slows both.
    for first in range(0, len(order), RUN):
        indices = order[first : first + RUN]
        for name, data in routes.items():
            start = time.process_time()
            for index in indices:
                data[index]
            spent[name] += time.process_time() - start
    monkeypatch.setenv(REGISTRY_VARIABLE, str(root / "datasets.yaml"))
    lazy = lagbench.open_split("cavity", subset="train", root=root)

    def read(index: int) -> NDArray[np.float32]:
        scenario, frame = tensors.place(index)
        frames = slice(frame, frame + tensors.length)
        positions = lazy.position.sel(scenario=scenario)
        window: NDArray[np.float32] = positions.isel(frame=frames).values
        return window

    ratio = spent["tensors"] / spent["arrays"]
    print(
        f"\nlagbench.torch.WindowDataset, the trainer's: "
        f"{len(order) / spent['tensors']:.0f} windows/s"
    )
    print(
        f"lagbench.windows: {len(order) / spent['arrays']:.0f}, {ratio:.2f} times that"
    )
    print(f"open_split: {rate(read, iter(order), 60):.0f}")
    assert ratio > 0.9


def test_memory_is_flat(root: Path, tmp_path: Path) -> None:
    """Reading 12 scenarios needs at most 5 % more memory at its peak than reading 7.

    Each process reads nearly one epoch: 594 windows of each scenario.
    """
    few = tmp_path / "few"
    few.mkdir()
    write_ours(few, FEW)
    peak_of_few = measured_apart("-c", CHILD, str(few), "4100")  # [bytes]
    peak_of_all = measured_apart("-c", CHILD, str(root), "7000")
    print(
        f"\npeak memory, {FEW} scenarios: {peak_of_few / 1e6:.0f} MB; {SCENARIOS}: "
        f"{peak_of_all / 1e6:.0f} MB"
    )
    assert peak_of_all <= 1.05 * peak_of_few


def test_npz_in_memory(tmp_path: Path) -> None:
    """How geoelements/gns reads: whole trajectories in memory, a window is a view of
    them.
    """
    write_gns_npz(tmp_path / "train.npz", TRAJECTORIES)
    start = time.process_time()
    with np.load(tmp_path / "train.npz") as arrays:
        trajectories = [arrays[name] for name in arrays.files]
    loading = time.process_time() - start
    windows_in_each = FRAMES - HISTORY

    def read(index: int) -> tuple[NDArray[np.float32], ...]:
        number, first = divmod(index, windows_in_each)
        frames = trajectories[number]
        stop = first + HISTORY
        position = np.transpose(frames[first:stop], (1, 0, 2))
        # Their collate stacks the windows: that copy is where the bytes are touched.
        return (
            np.ascontiguousarray(position),
            np.full(len(position), 5),
            frames[stop].copy(),
        )

    rng = np.random.default_rng(SEED)
    indices = rng.integers(TRAJECTORIES * windows_in_each, size=1000)
    windows_per_second = rate(read, indices, 1000)
    size = sum(frames.nbytes for frames in trajectories)
    print(
        f"\nNPZ in memory: {windows_per_second:.0f} windows/s, after {loading:.1f} s "
        f"to load {size / 1e6:.0f} MB"
    )


def test_hdf5_of_trajectories(tmp_path: Path) -> None:
    """How LagrangeBench reads: seven frames of a group of an HDF5 file."""
    write_lagrangebench_h5(tmp_path / "train.h5", TRAJECTORIES)
    windows_in_each = FRAMES - HISTORY
    with h5py.File(tmp_path / "train.h5") as file:

        def read(index: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
            number, first = divmod(index, windows_in_each)
            group = file[f"{number:05d}"]
            stop = first + HISTORY + 1
            frames = group["position"][first:stop]
            position = frames.transpose((1, 0, 2))
            return position, group["particle_type"][:]

        rng = np.random.default_rng(SEED)
        indices = rng.integers(TRAJECTORIES * windows_in_each, size=200)
        windows_per_second = rate(read, indices, 200)
    print(f"\nHDF5 of trajectories: {windows_per_second:.0f} windows/s")
