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

import netCDF4
import numpy as np
import yaml
from filelock import FileLock
from numpy.typing import NDArray

from lagbench.board.entry import Meta
from lagbench.board.entry_file import read_entry
from lagbench.board.publish import SubmitResult
from lagbench.board.ranking import combine, summarise
from lagbench.board.submit import submit
from lagbench.data.checksums import dataset_hash, file_sha256, subset_hash
from lagbench.data.layout import scenario_path
from lagbench.data.registry import Registry, Size, default_path, load
from lagbench.data.writer import ScenarioWriter
from lagbench.data.yamlfile import format_yaml, read_yaml
from lagbench.figures.report.report import write_report
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.score_file_checks import read_score_file
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
        guesses = {
            i: method(motion(self.size, i), n, h) for i in self.size.subsets["test"]
        }
        where = {
            "split": self.size.split,
            "size": self.size.name,
            "registry": self.registry,
        }
        return write(path, guesses, method=name, **where, **labels)

    def card(self, path: Path) -> ScoreCard:
        """Return the score card of a submission."""
        return score(
            path, root=self.root, registry=self.registry, workers=1, write=False
        )

    def report(self, folder: Path, files: Mapping[str, Method]) -> Path:
        """Submit, score and report methods by name."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = [
            self.submit(folder / f"{i}.nc", method, name)
            for i, (name, method) in enumerate(files.items())
        ]
        cards = [self.card(path) for path in paths]
        return write_report(
            folder / "report", cards, paths, root=self.root, registry=self.registry
        )


def make_report_bench(home: Path, split: str) -> ReportBench:
    """Write the test scenarios of a split and its registry, once for all processes that
    share a folder.
    """
    folder = home / f"report-{split}"
    path = folder / "datasets.yaml"
    with FileLock(home / f"report-{split}.lock"):
        if not path.exists():
            plain = load().size(split, "tiny")
            hashes = {
                i: _write(folder / "root", plain, i) for i in plain.subsets["test"]
            }
            path.write_text(_registry(plain, hashes))
    registry = load(path)
    return ReportBench(folder / "root", registry, registry.size(split, "tiny"))


def page_of(home: Path, split: str) -> Path:
    """Return the report on two methods of a split, one of a hostile name, made once
    likewise.
    """
    page = home / f"page-{split}" / "report" / "index.html"
    with FileLock(home / f"page-{split}.lock"):
        if not page.exists():
            assert (
                make_report_bench(home, split).report(page.parents[1], METHODS) == page
            )
    return page


def motion(size: Size, scenario: int) -> Floats:
    """Return true positions: four eddies in a full box, else two bodies that fall
    turning.
    """
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
    (x, y), cos, sin = body.T, np.cos(angle), np.sin(angle)
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    middle = np.where(
        np.arange(size.particles)[:, None] < half, [0.3, 0.7], [0.7, 0.75]
    )
    turned[..., 1] -= 0.0004 * np.arange(frames)[:, None] ** 2
    return np.asarray(turned + middle)


def _material(size: Size, scenario: int) -> NDArray[np.int64]:
    if size.split != "multimaterial":
        return np.zeros(size.particles, np.int64)
    pairs = [(0, 2), (3, 2), (3, 0), (2, 2), (3, 1), (0, 0)]
    first, second = pairs[scenario % 6]
    return np.where(np.arange(size.particles) < size.particles // 2, first, second)


def _write(root: Path, size: Size, scenario: int) -> str:
    key = size.key(scenario)
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
    measured = {
        "dataset_sha256": dataset_hash(size.split, size.name, size.major, subsets),
        "subset_sha256": subsets,
        "scenario_sha256": {i: content[:16] for i, content in hashes.items()},
        "statistics": {"position_std": [0.25, 0.25], "velocity_std": [0.002, 0.002]},
        "twin_floor": [1e-6 * (k + 1) for k in range(size.task.horizon)],
    }
    file["measured"] = {size.split: {size.name: measured}}
    return format_yaml(file)


def still(truth: Floats, n: int, h: int) -> Floats:
    """Predict the last given frame."""
    return np.broadcast_to(truth[n - 1], truth[n : n + h].shape)


def damped(truth: Floats, n: int, h: int) -> Floats:
    """Predict the true steps, each smaller than the one before."""
    steps = (
        np.diff(truth[n - 1 : n + h], axis=0)
        * (0.95 ** np.arange(1, h + 1))[:, None, None]
    )
    return truth[n - 1] + np.cumsum(steps, axis=0)


def noisy(truth: Floats, n: int, h: int) -> Floats:
    """Predict the truth with an error that wanders off."""
    rng = np.random.Generator(np.random.PCG64(7))
    return truth[n : n + h] + np.cumsum(
        1e-4 * (rng.random(truth[n : n + h].shape) - 0.5), axis=0
    )


def runaway(truth: Floats, n: int, h: int) -> Floats:
    """Predict particles that leave the box ever faster, up to 9 lengths away, the most
    that is scored.
    """
    guess = np.array(noisy(truth, n, h))
    guess[1:, :5] += 9.0 * 10.0 ** np.linspace(-8.0, 0.0, h - 1)[:, None, None]
    return guess


HOSTILE = (
    "<script>console.error(1)</script>"
    "<img src=http://example.com/x onerror=console.error(2)>"
)

METHODS: dict[str, Method] = {"GNS & friends": damped, HOSTILE: noisy}
"""The methods of :func:`page_of`."""


@dataclass(frozen=True)
class BoardBench:
    """A leaderboard's folder, and the data and registry that its entries were scored
    with.

    It has the floors, ``damped`` with two seeds, ``noisy`` and the wild ``flipping``.
    """

    folder: Path
    data: ReportBench

    @property
    def registry(self) -> Registry:
        """The registry."""
        return self.data.registry

    def predict(self, method: Method, name: str, **labels: Any) -> Path:
        """Write predictions outside the folder."""
        seed = f"_{labels['seed']}" if "seed" in labels else ""
        return self.data.submit(
            self.folder.parent / f"{name}{seed}.nc", method, name, **labels
        )

    def submit(
        self, *paths: Path, replace: bool = False, add: bool = False, **keys: Any
    ) -> SubmitResult:
        """Submit predictions."""
        meta = Meta(
            **{"authors": ("A. Author",), "command": "make", "date": DAY, **keys}
        )
        return submit(
            paths, meta, replace=replace, add=add, new_board=True, **self.where
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
        held = yaml.load(self.entry(method).read_text(), Loader=yaml.CSafeLoader)
        change(held)
        self.entry(method).write_text(
            yaml.dump(held, Dumper=yaml.CSafeDumper, sort_keys=False)
        )

    def forge(self, method: str) -> None:
        """Make hashes and aggregates of an entry follow from its score files, as one
        does who knows how.
        """
        self.rehash(method)
        entry = read_entry(self.entry(method))
        stored = [
            read_score_file(self.folder / path).scores.tallies
            for path in entry.score_paths
        ]
        plain = {
            name: summary.model_dump()
            for name, summary in summarise(combine(stored)).items()
        }
        self.edit(method, lambda held: held["score"].update(metrics=plain))

    def rehash(self, method: str) -> None:
        """Make the hashes of an entry those of its score files, whatever these hold."""
        paths = read_entry(self.entry(method)).score_paths

        def change(held: dict[str, Any]) -> None:
            for said, path in zip(held["score"]["files"], paths, strict=True):
                said["sha256"] = file_sha256(self.folder / path)

        self.edit(method, change)

    def state(self) -> dict[str, str]:
        """Return path to hash of every file in the folder."""
        files = sorted(path for path in self.folder.rglob("*") if path.is_file())
        return {
            path.relative_to(self.folder).as_posix(): file_sha256(path)
            for path in files
        }


def master(home: Path) -> BoardBench:
    """Return the bench that all tests and processes share; do not change its files."""
    bench = BoardBench(
        home / "board-bench" / "leaderboard", make_report_bench(home, "cavity")
    )
    finished = home / "board-bench" / "finished"
    with FileLock(home / "board-bench.lock"):
        if not finished.exists():
            shutil.rmtree(finished.parent, ignore_errors=True)
            finished.parent.mkdir()
            seeds = [
                bench.predict(
                    damped, "damped", seed=0, device="cpu", seconds_per_frame=0.25
                )
            ]
            seeds.append(
                bench.predict(
                    _worse, "damped", seed=3, device="cpu", seconds_per_frame=0.75
                )
            )
            bench.submit(*seeds, solver_seconds_per_frame=2.0)
            bench.submit(bench.predict(noisy, "noisy", parameters=5))
            bench.submit(bench.predict(flipping, "flipping"))
            finished.touch()
    return bench


def flipping(truth: Any, n: int, h: int) -> Any:
    """Predict a box that is mirrored every other frame from the third on: a vorticity
    out of all bounds.
    """
    guess = np.array(truth[n : n + h])
    guess[3::2, :, 0] = 1.0 - guess[3::2, :, 0]
    return guess


def _worse(truth: Any, n: int, h: int) -> Any:
    return damped(truth, n, h) + 2.0 * (noisy(truth, n, h) - truth[n : n + h])


def nearer(truth: Any, n: int, h: int) -> Any:
    """Predict the truth with half the error of ``noisy``."""
    return truth[n : n + h] + 0.5 * (noisy(truth, n, h) - truth[n : n + h])


def copied(home: Path, folder: Path, *, without: Sequence[str] = ()) -> BoardBench:
    """Return the bench with a copy of the leaderboard that a test may damage, without
    some entries.
    """
    shared = master(home)
    left_out = [f"{name}{end}" for name in without for end in (".yaml", ".nc", "_*.nc")]
    shutil.copytree(
        shared.folder, folder / "leaderboard", ignore=shutil.ignore_patterns(*left_out)
    )
    return BoardBench(folder / "leaderboard", shared.data)


def set_mean(held: dict[str, Any], factor: float = 0.9) -> None:
    """Better the ranking metric of an entry."""
    held["score"]["metrics"]["vorticity_rmse"]["mean"] *= factor


def reform(
    bench: BoardBench, change: Callable[[Any], object], *, whole: bool = True
) -> None:
    """Change the values of a score file and make its hash, and the aggregates,
    follow.
    """
    with netCDF4.Dataset(bench.folder / SCORES / "noisy.nc", "r+") as file:
        file.set_auto_maskandscale(False)
        change(file)
    (bench.forge if whole else bench.rehash)("noisy")


def scale(statistic: str, factor: float) -> Callable[[Any], object]:
    """Return a change that multiplies a statistic."""

    def change(file: Any) -> None:
        row = file.statistics.split().index(statistic)
        file["value"][row] = factor * file["value"][row]

    return change
