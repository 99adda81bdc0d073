"""Small made-up flows of every split, methods that predict them, their reports and a
leaderboard of them.
"""

from __future__ import annotations

import datetime
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from filelock import FileLock
from numpy.typing import NDArray
from registry_text import described_splits

from lagbench.board.entry import Meta, read_entry
from lagbench.board.submit import SubmitResult, submit
from lagbench.data.checksums import dataset_hash, file_sha256, subset_hash
from lagbench.data.layout import scenario_path
from lagbench.data.registry import Registry, Size, load
from lagbench.data.writer import ScenarioWriter
from lagbench.data.yamlfile import format_yaml
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.submission import write

Floats = NDArray[np.float64]
Method = Callable[[Floats, int, int], Floats]
"""From all true positions [frame, particle, 2], given frames n and horizon h to
predictions.
"""

DAY = datetime.date(2026, 1, 31)
PLACE = "submissions/cavity/tiny"
SCORES = "scores/cavity/tiny"
FULL_BOXES = ("cavity", "curl-noise")
SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")


@dataclass(frozen=True)
class ReportBench:
    """Test scenarios of one split in its tiny size, and the registry that describes
    them.
    """

    root: Path
    registry: Registry
    size: Size

    @property
    def task(self) -> ScoredTask:
        """Its test subset."""
        return load_scored_task(self.size, self.root)

    def submit(self, path: Path, method: Method, name: str, **labels: Any) -> Path:
        """Write the submission of a method."""
        n = self.size.task.input_frames
        h = self.size.task.horizon
        predictions = {}
        for scenario in self.size.subsets["test"]:
            truth = motion(self.size, scenario)
            predictions[scenario] = method(truth, n, h)
        return write(
            path,
            predictions,
            method=name,
            split=self.size.split,
            size=self.size.name,
            registry=self.registry,
            **labels,
        )

    def card(self, path: Path) -> ScoreCard:
        """Return the score card of a submission."""
        return score(
            path,
            root=self.root,
            registry=self.registry,
            workers=1,
            write=False,
        )


def make_report_bench(home: Path, split: str) -> ReportBench:
    """Write the test scenarios of a split and its registry.

    They are written once for all processes that share a folder.
    """
    folder = home / f"report-{split}"
    path = folder / "datasets.yaml"
    with FileLock(home / f"report-{split}.lock"):
        if not path.exists():
            size = load().size(split, "tiny")
            hashes = {}
            for scenario in size.subsets["test"]:
                hashes[scenario] = _write(folder / "root", size, scenario)
            path.write_text(_registry(size, hashes))
    registry = load(path)
    size = registry.size(split, "tiny")
    return ReportBench(folder / "root", registry, size)


def motion(size: Size, scenario: int) -> Floats:
    """Return true positions, shape [frame, particle, 2].

    Four eddies turn in a full box; elsewhere two bodies fall and turn.
    """
    frame_count = size.task.input_frames + size.task.horizon
    if size.split in FULL_BOXES:
        return _eddies(size, scenario, frame_count)
    return _falling_bodies(size, scenario, frame_count)


def _eddies(size: Size, scenario: int, frame_count: int) -> Floats:
    (low, high), _ = size.bounds
    rng = np.random.Generator(np.random.PCG64(scenario))
    # positions as shares of the box, by frame
    position = rng.random((size.particles, 2))
    positions = [position]
    for _ in range(frame_count - 1):
        x, y = 2.0 * np.pi * position.T
        velocity_x = np.sin(x) * np.cos(y)
        velocity_y = -np.cos(x) * np.sin(y)
        step = 0.004 * np.stack([velocity_x, velocity_y], axis=1)
        position = np.clip(position + step, 0.0, 1.0)
        positions.append(position)
    return low + (high - low) * np.stack(positions)


def _falling_bodies(size: Size, scenario: int, frame_count: int) -> Floats:
    rng = np.random.Generator(np.random.PCG64(scenario))
    points = rng.random((size.particles, 2))
    body = 0.1 * (points - 0.5)
    x, y = body.T
    frame = np.arange(frame_count)[:, None]
    cos = np.cos(0.03 * frame)
    sin = np.sin(0.03 * frame)
    turned_x = cos * x - sin * y
    turned_y = sin * x + cos * y
    fall = 0.0004 * frame**2
    moved = np.stack([turned_x, turned_y - fall], axis=-1)
    is_first = _is_first_body(size)[:, None]
    middle = np.where(is_first, [0.3, 0.7], [0.7, 0.75])
    return np.asarray(moved + middle)


def _is_first_body(size: Size) -> NDArray[np.bool_]:
    """Return whether a particle belongs to the first of two bodies."""
    half = size.particles // 2
    return np.arange(size.particles) < half


def _material(size: Size, scenario: int) -> NDArray[np.int64]:
    if size.split != "multimaterial":
        return np.zeros(size.particles, np.int64)
    pairs = [
        (0, 2),
        (3, 2),
        (3, 0),
        (2, 2),
        (3, 1),
        (0, 0),
    ]
    first, second = pairs[scenario % 6]
    return np.where(_is_first_body(size), first, second)


def _write(root: Path, size: Size, scenario: int) -> str:
    """Write a scenario and return its content hash."""
    key = size.key(scenario)
    positions = motion(size, scenario).astype(np.float32)
    wall_velocity = None
    if size.split == "cavity":
        wall_velocity = np.zeros((4, 2))
        wall_velocity[3] = [0.1, 0.0]
    parameters_by_split = {
        "cavity": {"reynolds_number": 80.0},
        "curl-noise": {"frequency": 2},
    }
    parameters: dict[str, object] = {"family": "two <bodies>"}
    if size.split in parameters_by_split:
        parameters |= parameters_by_split[size.split]
    mass = float(size.value("density")) * _area(size)
    with ScenarioWriter(
        scenario_path(root, key),
        key,
        particles=size.particles,
        frames=len(positions),
        frame_interval=0.1,
        material=_material(size, scenario),
        particle_mass=mass / size.particles,
        wall_velocity=wall_velocity,
        parameters=parameters,
        seed="none",
        device="cpu",
        generator="tests",
        reynolds=None,
    ) as writer:
        for position in positions:
            writer.append(position, 0.0 * position)
    return writer.content_sha256


def _area(size: Size) -> float:
    """Return the area of all particles."""
    (low, high), _ = size.bounds
    if size.split in FULL_BOXES:
        return (high - low) ** 2
    return 2.0 * 0.1**2


def _registry(size: Size, hashes: Mapping[int, str]) -> str:
    """Return our registry with a measured block of this data set."""
    subsets = {
        "train": "0" * 64,
        "valid": "1" * 64,
        "test": subset_hash(hashes),
    }
    statistics = {
        "position_std": [0.25, 0.25],
        "velocity_std": [0.002, 0.002],
    }
    predictability_limit = [1e-6 * (k + 1) for k in range(size.task.horizon)]
    dataset_sha256 = dataset_hash(size.split, size.name, size.major, subsets)
    scenario_hashes = {}
    for scenario, content_hash in hashes.items():
        scenario_hashes[scenario] = content_hash[:16]
    measured = {
        "dataset_sha256": dataset_sha256,
        "subset_sha256": subsets,
        "scenario_sha256": scenario_hashes,
        "statistics": statistics,
        "twin_floor": predictability_limit,
    }
    block = format_yaml({"measured": {size.split: {size.name: measured}}})
    return described_splits() + block


def still(truth: Floats, n: int, h: int) -> Floats:
    """Predict the last given frame."""
    future = truth[n : n + h]
    return np.broadcast_to(truth[n - 1], future.shape)


def damped(truth: Floats, n: int, h: int) -> Floats:
    """Predict the true steps, each smaller than the one before."""
    last_given = truth[n - 1]
    steps = np.diff(truth[n - 1 : n + h], axis=0)
    shrinkage = 0.95 ** np.arange(1, h + 1)
    shrunk_steps = steps * shrinkage[:, None, None]
    return last_given + np.cumsum(shrunk_steps, axis=0)


def noisy(truth: Floats, n: int, h: int) -> Floats:
    """Predict the truth with an error that wanders off."""
    future = truth[n : n + h]
    rng = np.random.Generator(np.random.PCG64(7))
    noise = 1e-4 * (rng.random(future.shape) - 0.5)
    return future + np.cumsum(noise, axis=0)


def runaway(truth: Floats, n: int, h: int) -> Floats:
    """Predict five particles that leave the box ever faster.

    They end 9 lengths away, the most that is scored.
    """
    prediction = np.array(noisy(truth, n, h))
    exponents = np.linspace(-8.0, 0.0, h - 1)
    distance = 9.0 * 10.0**exponents
    prediction[1:, :5] += distance[:, None, None]
    return prediction


HOSTILE = (
    "<script>console.error(1)</script>"
    "<img src=http://example.com/x onerror=console.error(2)>"
)

METHODS: dict[str, Method] = {
    "GNS & friends": damped,
    HOSTILE: noisy,
}
"""The methods of :func:`page_of`."""


@dataclass(frozen=True)
class BoardBench:
    """A leaderboard's folder, and the data and registry of its scores.

    Its entries are ``damped`` with two seeds, ``noisy`` and the wild ``flipping``.
    """

    folder: Path
    data: ReportBench

    @property
    def registry(self) -> Registry:
        """The registry."""
        return self.data.registry

    def predict(self, method: Method, name: str, **labels: Any) -> Path:
        """Write predictions outside the folder."""
        stem = name
        if "seed" in labels:
            stem = f"{name}_{labels['seed']}"
        path = self.folder.parent / f"{stem}.nc"
        return self.data.submit(path, method, name, **labels)

    def submit(
        self,
        *paths: Path,
        replace: bool = False,
        **keys: Any,
    ) -> SubmitResult:
        """Submit predictions."""
        description: dict[str, Any] = {
            "authors": ("A. Author",),
            "command": "make",
            "date": DAY,
        }
        meta = Meta(**(description | keys))
        return submit(
            paths,
            meta,
            replace=replace,
            new_board=True,
            **self.where,
        )

    @property
    def where(self) -> dict[str, Any]:
        """Folders and registry as arguments."""
        return {
            "board": self.folder,
            "root": self.data.root,
            "registry": self.registry,
            "workers": 1,
        }

    def entry(self, method: str) -> Path:
        """Return the YAML file of an entry."""
        return self.folder / PLACE / f"{method}.yaml"

    def edit(self, method: str, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the YAML file of an entry by hand."""
        path = self.entry(method)
        content = yaml.load(path.read_text(), Loader=yaml.CSafeLoader)
        change(content)
        text = yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False)
        path.write_text(text)

    def rehash(self, method: str) -> None:
        """Make the hashes of an entry those of its score files, whatever these hold."""
        paths = read_entry(self.entry(method)).score_paths

        def change(content: dict[str, Any]) -> None:
            for file, path in zip(content["score"]["files"], paths, strict=True):
                file["sha256"] = file_sha256(self.folder / path)

        self.edit(method, change)

    def state(self) -> dict[str, str]:
        """Return path to hash of every file in the folder."""
        files = []
        for path in sorted(self.folder.rglob("*")):
            if path.is_file() and path.name != ".lock":
                files.append(path)
        hashes = {}
        for path in files:
            name = path.relative_to(self.folder).as_posix()
            hashes[name] = file_sha256(path)
        return hashes


def master(home: Path) -> BoardBench:
    """Return the bench that all tests and processes share; do not change its files."""
    folder = home / "board-bench" / "leaderboard"
    bench = BoardBench(folder, make_report_bench(home, "cavity"))
    finished = home / "board-bench" / "finished"
    with FileLock(home / "board-bench.lock"):
        if not finished.exists():
            shutil.rmtree(finished.parent, ignore_errors=True)
            finished.parent.mkdir()
            first_seed = bench.predict(
                damped,
                "damped",
                seed=0,
                device="cpu",
                seconds_per_frame=0.25,
            )
            second_seed = bench.predict(
                _worse,
                "damped",
                seed=3,
                device="cpu",
                seconds_per_frame=0.75,
            )
            bench.submit(first_seed, second_seed, solver_seconds_per_frame=2.0)
            with_parameters = bench.predict(noisy, "noisy", parameters=5)
            bench.submit(with_parameters)
            bench.submit(bench.predict(flipping, "flipping"))
            finished.touch()
    return bench


def flipping(truth: Any, n: int, h: int) -> Any:
    """Predict a box that is mirrored every other frame from the third on.

    Its vorticity is out of all bounds.
    """
    prediction = np.array(truth[n : n + h])
    x = prediction[3::2, :, 0]
    prediction[3::2, :, 0] = 1.0 - x
    return prediction


def _worse(truth: Any, n: int, h: int) -> Any:
    future = truth[n : n + h]
    error = noisy(truth, n, h) - future
    return damped(truth, n, h) + 2.0 * error


def copied(home: Path, folder: Path, *, without: Sequence[str] = ()) -> BoardBench:
    """Return the bench with a copy of the leaderboard that a test may damage.

    Args:
        home: the folder that all processes share.
        folder: where the copy goes.
        without: methods whose entries are left out.
    """
    shared = master(home)
    patterns = []
    for name in without:
        patterns += [f"{name}.yaml", f"{name}.nc", f"{name}_*.nc"]
    target = folder / "leaderboard"
    ignore = shutil.ignore_patterns(*patterns)
    shutil.copytree(shared.folder, target, ignore=ignore)
    return BoardBench(target, shared.data)
