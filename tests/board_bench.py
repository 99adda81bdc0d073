"""A small leaderboard on made-up cavity flows, built once, for tests of the board."""

from __future__ import annotations

import datetime
import functools
import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from report_bench import Method, ReportBench, damped, make_report_bench, noisy

from lagbench.board import draft
from lagbench.board.entry_file import read_entry, spell_entry
from lagbench.board.meta import Meta
from lagbench.board.seal import sealed
from lagbench.board.submit import SubmitResult, submit, submit_floor
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Registry
from lagbench.scoring import score
from lagbench.submission import validate

DAY = datetime.date(2026, 1, 31)
PLACE = "submissions/cavity/tiny"


@contextmanager
def in_process() -> Iterator[None]:
    """Validate predictions without a child process, which has tests of its own, to save its start."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (score, draft):
            patch.setattr(module, "validate", functools.partial(validate, isolated=False))
        yield


@dataclass(frozen=True)
class BoardBench:
    """A leaderboard's folder, and the data and registry that its entries were scored with.

    It has both floors, ``damped`` with two seeds, ``noisy`` and the wild ``flipping``.
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
        return self.data.submit(self.folder.parent / f"{name}{seed}.nc", method, name, **labels)

    def submit(self, *paths: Path, replace: bool = False, **keys: Any) -> SubmitResult:
        """Submit predictions."""
        meta = Meta(**{"authors": ("A. Author",), "command": "make", "date": DAY, **keys})
        with in_process():
            return submit(paths, meta, replace=replace, **self.where)

    def submit_floor(self, name: str) -> SubmitResult:
        """Submit a floor."""
        with in_process():
            return submit_floor(name, split="cavity", size="tiny", date=DAY, **self.where)

    @property
    def where(self) -> dict[str, Any]:
        """Folders and registry as arguments."""
        return {"board": self.folder, "root": self.data.root, "registry": self.registry, "workers": 1}

    def entry(self, method: str) -> Path:
        """Return the YAML file of an entry."""
        return self.folder / PLACE / f"{method}.yaml"

    def edit(self, method: str, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the YAML file of an entry by hand."""
        held = yaml.safe_load(self.entry(method).read_text())
        change(held)
        self.entry(method).write_text(yaml.safe_dump(held, sort_keys=False))

    def reseal(self, method: str) -> None:
        """Forge an entry as one does who knows how: hash of the score file and digest made anew."""
        entry = read_entry(self.entry(method))
        files = tuple(
            said.model_copy(update={"sha256": file_sha256(self.folder / path)})
            for said, path in zip(entry.score.files, entry.score_paths, strict=True)
        )
        block = entry.score.model_copy(update={"files": files})
        block = sealed(entry.place, entry.dataset, entry.predictions, entry, block)
        self.entry(method).write_bytes(spell_entry(entry.model_copy(update={"score": block})))

    def state(self) -> dict[str, str]:
        """Return path to hash of every file in the folder."""
        files = sorted(path for path in self.folder.rglob("*") if path.is_file())
        return {
            path.relative_to(self.folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        }


@functools.cache
def _master(base: Path) -> BoardBench:
    home = base / "board-bench"
    bench = BoardBench(home / "leaderboard", make_report_bench(home, "cavity"))
    for name in ("persistence", "constant-velocity"):
        bench.submit_floor(name)
    seeds = [bench.predict(damped, "damped", seed=0, device="cpu", seconds_per_frame=0.25)]
    seeds.append(bench.predict(_worse, "damped", seed=3, device="cpu", seconds_per_frame=0.75))
    bench.submit(*seeds, solver_seconds_per_frame=2.0)
    bench.submit(bench.predict(noisy, "noisy", parameters=5))
    bench.submit(bench.predict(flipping, "flipping"))
    return bench


def flipping(truth: Any, n: int, h: int) -> Any:
    """Predict a box that is mirrored every other frame from the third on: a vorticity out of all bounds."""
    guess = np.array(truth[n : n + h])
    guess[3::2, :, 0] = 1.0 - guess[3::2, :, 0]
    return guess


def _worse(truth: Any, n: int, h: int) -> Any:
    return damped(truth, n, h) + 2.0 * (noisy(truth, n, h) - truth[n : n + h])


def master(factory: pytest.TempPathFactory) -> BoardBench:
    """Return the bench that all tests share; do not change its files."""
    return _master(factory.getbasetemp())


def copied(factory: pytest.TempPathFactory, folder: Path, *, without: Sequence[str] = ()) -> BoardBench:
    """Return the bench with a copy of the leaderboard that a test may damage, without some entries."""
    shared = master(factory)
    left_out = [f"{name}{end}" for name in without for end in (".yaml", ".nc", "_*.nc")]
    shutil.copytree(shared.folder, folder / "leaderboard", ignore=shutil.ignore_patterns(*left_out))
    return BoardBench(folder / "leaderboard", shared.data)
