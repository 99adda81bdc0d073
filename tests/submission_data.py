"""A small data set, its registry and a valid predictions.nc, for tests of
submissions.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from registry_text import described_splits
from scenario_factory import frames_of, make_key, write_scenario

from lagbench.data.checksums import dataset_hash, subset_hash
from lagbench.data.layout import major_of
from lagbench.data.registry import Registry, load
from lagbench.data.yamlfile import format_yaml, read_yaml
from lagbench.submission import ValidationResult, validate, write

TESTS = (3, 4, 5)
"""Ids of the test scenarios."""

GIVEN = 3
HORIZON = 8
PARTICLES = 48
FRAMES = GIVEN + HORIZON
VERSION = "2.2.0"


@dataclass(frozen=True)
class Bench:
    """A root folder with test scenarios, the registry that describes them, a valid
    submission.
    """

    folder: Path
    root: Path
    registry_path: Path
    valid: Path

    @property
    def registry(self) -> Registry:
        """The registry."""
        return load(self.registry_path)

    def copy(self, name: str = "predictions.nc") -> Path:
        """Return a copy of the valid submission that a test may damage."""
        target = self.folder / name
        shutil.copyfile(self.valid, target)
        return target

    def validate(self, path: Path, *, require_truth: bool = False) -> ValidationResult:
        """Validate a file against this data set."""
        return validate(
            path,
            root=self.root,
            registry=self.registry,
            require_truth=require_truth,
        )


def truth(scenario: int) -> NDArray[np.float32]:
    """Positions of a test scenario at the frames to predict, shape [frame, particle,
    2].
    """
    return frames_of(scenario, FRAMES, PARTICLES)[GIVEN:]


def frozen(values: NDArray[np.float32], mark: int) -> NDArray[np.float32]:
    """Return a rollout that repeats the frame before an absolute frame number from
    there on.
    """
    values = values.copy()
    values[mark - GIVEN :] = values[mark - GIVEN - 1]
    return values


def make_bench(folder: Path) -> Bench:
    """Write the data set (test only), its registry with hashes, and the truth as
    predictions.
    """
    folder.mkdir(parents=True, exist_ok=True)
    root = folder / "root"
    keys = {
        i: make_key(
            i,
            split="cavity",
            size="tiny",
            subset="test",
        )
        for i in TESTS
    }
    hashes = {
        i: write_scenario(root, k, frames=FRAMES, particles=PARTICLES)[1]
        for i, k in keys.items()
    }
    registry_path = folder / "datasets.yaml"
    _write_registry(registry_path, hashes)
    valid = folder / "valid.nc"
    write(
        valid,
        {i: truth(i) for i in TESTS},
        split="cavity",
        size="tiny",
        method="truth",
        registry=load(registry_path),
        seconds_per_frame=0.25,
        seed=7,
    )
    return Bench(folder, root, registry_path, valid)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A small data set and a valid submission; modules that test submissions call it
    ``bench``.
    """
    return make_bench(tmp_path_factory.mktemp("bench"))


def _write_registry(path: Path, hashes: dict[int, str]) -> None:
    """Write our registry with a smaller cavity tiny and its hashes."""
    path.write_text(described_splits())
    file = read_yaml(path)
    split = file["splits"]["cavity"]
    split["version"] = VERSION
    split["sizes"]["tiny"].pop("version", None)
    size = split["sizes"]["tiny"]
    size["subsets"] = {
        "train": "0-1",
        "valid": 2,
        "test": "3-5",
    }
    size["frames"] = FRAMES
    size["parameters"]["particles"] = PARTICLES
    size["task"] |= {
        "input_frames": GIVEN,
        "horizon": HORIZON,
        "frames_of_interest": [5],
    }
    subsets = {
        "train": "0" * 64,
        "valid": "1" * 64,
        "test": subset_hash(hashes),
    }
    measured = {
        "dataset_sha256": dataset_hash("cavity", "tiny", major_of(VERSION), subsets),
        "subset_sha256": subsets,
        "scenario_sha256": {i: content[:16] for i, content in hashes.items()},
        "statistics": {},
        "twin_floor": [],
    }
    file["measured"] = {"cavity": {"tiny": measured}}
    path.write_text(format_yaml(file))
