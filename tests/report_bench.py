"""Small made-up flows of every split, methods that predict them, and their reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from lagbench.data.checksums import dataset_hash, subset_hash
from lagbench.data.registry import Registry, Size, default_path, load
from lagbench.data.writer import ScenarioKey, ScenarioWriter, scenario_path
from lagbench.data.yamlfile import read_yaml, spell_yaml
from lagbench.report import write_report
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.submission import write

Floats = NDArray[np.float64]
Method = Callable[[Floats, int, int], Floats]
"""From all true positions [frame, particle, 2], given frames n and horizon h to predictions."""

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")


@dataclass(frozen=True)
class ReportBench:
    """Test scenarios of one split in its tiny size, and the registry that describes them."""

    root: Path
    registry: Registry
    size: Size

    @property
    def task(self) -> ScoredTask:
        """Its test subset."""
        return load_scored_task(self.size, self.root)

    def submit(self, path: Path, method: Method, name: str, **labels: Any) -> Path:
        """Write the submission of a method."""
        n, h = self.size.task.input_frames, self.size.task.horizon
        guesses = {i: method(motion(self.size, i), n, h) for i in self.size.subsets["test"]}
        where = {"split": self.size.split, "size": self.size.name, "registry": self.registry}
        return write(path, guesses, method=name, **where, **labels)

    def card(self, path: Path) -> ScoreCard:
        """Return the score card of a submission."""
        return score(path, root=self.root, registry=self.registry, workers=1, write=False)

    def report(self, folder: Path, files: Mapping[str, Method]) -> Path:
        """Submit, score and report methods by name."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = [
            self.submit(folder / f"{i}.nc", method, name) for i, (name, method) in enumerate(files.items())
        ]
        cards = [self.card(path) for path in paths]
        return write_report(folder / "report", cards, paths, root=self.root, registry=self.registry)


def make_report_bench(home: Path, split: str) -> ReportBench:
    """Write the test scenarios of a split and its registry, once for all processes that share a folder."""
    folder = home / f"report-{split}"
    path = folder / "datasets.yaml"
    with FileLock(home / f"report-{split}.lock"):
        if not path.exists():
            plain = load().size(split, "tiny")
            hashes = {i: _write(folder / "root", plain, i) for i in plain.subsets["test"]}
            path.write_text(_registry(plain, hashes))
    registry = load(path)
    return ReportBench(folder / "root", registry, registry.size(split, "tiny"))


def page_of(home: Path, split: str) -> Path:
    """Return the report on two methods of a split, one of a hostile name, made once likewise."""
    page = home / f"page-{split}" / "report" / "index.html"
    with FileLock(home / f"page-{split}.lock"):
        if not page.exists():
            assert make_report_bench(home, split).report(page.parents[1], METHODS) == page
    return page


def motion(size: Size, scenario: int) -> Floats:
    """Return true positions: four eddies in a full box, else two bodies that fall turning."""
    frames = size.task.input_frames + size.task.horizon
    full = size.split in ("cavity", "curl-noise")
    return _eddies(size, scenario, frames) if full else _falling(size, scenario, frames)


def _eddies(size: Size, scenario: int, frames: int) -> Floats:
    (low, high), _ = size.bounds
    rng = np.random.Generator(np.random.PCG64(scenario))
    share = rng.random((size.particles, 2))
    positions = [share]
    for _ in range(frames - 1):
        x, y = 2.0 * np.pi * positions[-1].T
        step = np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], axis=1)
        positions.append(np.clip(positions[-1] + 0.004 * step, 0.0, 1.0))
    return low + (high - low) * np.stack(positions)


def _falling(size: Size, scenario: int, frames: int) -> Floats:
    rng = np.random.Generator(np.random.PCG64(scenario))
    half = size.particles // 2
    body = 0.1 * (rng.random((size.particles, 2)) - 0.5)
    angle = 0.03 * np.arange(frames)[:, None]
    turned = np.stack(
        [
            np.cos(angle) * body[:, 0] - np.sin(angle) * body[:, 1],
            np.sin(angle) * body[:, 0] + np.cos(angle) * body[:, 1],
        ],
        axis=-1,
    )
    middle = np.where(np.arange(size.particles)[:, None] < half, [0.3, 0.7], [0.7, 0.75])
    fall = -0.0004 * np.arange(frames)[:, None] ** 2
    turned[..., 1] += fall
    return np.asarray(turned + middle)


def _material(size: Size, scenario: int) -> NDArray[np.int64]:
    if size.split != "multimaterial":
        return np.zeros(size.particles, np.int64)
    pairs = [(0, 2), (3, 2), (3, 0), (2, 2), (3, 1), (0, 0)]
    first, second = pairs[scenario % 6]
    return np.where(np.arange(size.particles) < size.particles // 2, first, second)


def _write(root: Path, size: Size, scenario: int) -> str:
    key = ScenarioKey(
        split=size.split, size=size.name, version=size.version, scenario=scenario, subset="test"
    )
    positions = motion(size, scenario).astype(np.float32)
    cavity = size.split == "cavity"
    marks = {"cavity": {"reynolds_number": 80.0}, "curl-noise": {"frequency": 2}}
    with ScenarioWriter(
        scenario_path(root, key),
        key,
        particles=size.particles,
        frames=len(positions),
        frame_interval=0.1,
        material=_material(size, scenario),
        particle_mass=float(size.value("density")) * _area(size) / size.particles,
        wall_velocity=np.array([[0, 0], [0, 0], [0, 0], [0.1, 0]]) if cavity else None,
        parameters=marks.get(size.split, {"family": "two <bodies>"}),
        seed="none",
        device="cpu",
        generator="tests",
        reynolds=None,
    ) as writer:
        for position in positions:
            writer.append(position, 0.0 * position)
    return writer.content_sha256


def _area(size: Size) -> float:
    (low, high), _ = size.bounds
    return (high - low) ** 2 if size.split in ("cavity", "curl-noise") else 2.0 * 0.1**2


def _registry(size: Size, hashes: Mapping[int, str]) -> str:
    """Return our registry with what would be measured of this data set."""
    file = read_yaml(default_path())
    subsets = {"train": "0" * 64, "valid": "1" * 64, "test": subset_hash(hashes)}
    file["measured"] = {
        size.split: {
            size.name: {
                "dataset_sha256": dataset_hash(size.split, size.name, size.major, subsets),
                "subset_sha256": subsets,
                "scenario_sha256": {i: content[:16] for i, content in hashes.items()},
                "statistics": {"position_std": [0.25, 0.25], "velocity_std": [0.002, 0.002]},
                "twin_floor": [1e-6 * (k + 1) for k in range(size.task.horizon)],
            }
        }
    }
    return spell_yaml(file)


def still(truth: Floats, n: int, h: int) -> Floats:
    """Predict the last given frame."""
    return np.broadcast_to(truth[n - 1], truth[n : n + h].shape)


def damped(truth: Floats, n: int, h: int) -> Floats:
    """Predict the true steps, each smaller than the one before."""
    steps = np.diff(truth[n - 1 : n + h], axis=0) * (0.95 ** np.arange(1, h + 1))[:, None, None]
    return truth[n - 1] + np.cumsum(steps, axis=0)


def noisy(truth: Floats, n: int, h: int) -> Floats:
    """Predict the truth with an error that wanders off."""
    rng = np.random.Generator(np.random.PCG64(7))
    return truth[n : n + h] + np.cumsum(1e-4 * (rng.random(truth[n : n + h].shape) - 0.5), axis=0)


def runaway(truth: Floats, n: int, h: int) -> Floats:
    """Predict particles that leave the box ever faster, up to 9 lengths away, the most that is scored."""
    guess = np.array(noisy(truth, n, h))
    guess[1:, :5] += 9.0 * 10.0 ** np.linspace(-8.0, 0.0, h - 1)[:, None, None]
    return guess


HOSTILE = "<script>console.error(1)</script><img src=http://example.com/x onerror=console.error(2)>"

METHODS: dict[str, Method] = {"GNS & friends": damped, HOSTILE: noisy}
"""The methods of :func:`page_of`."""
