"""The scenarios that predictions are compared with, and what a data set asks for.

Scenarios are hashed before use, and read a few frames at a time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.layout import format_ids
from lagbench.data.local import check_contents, suggest_repair
from lagbench.data.manifest import read_or_empty
from lagbench.data.registry import Size
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.errors import DataError

BLOCK = 16
"""Frames that are read at a time."""


def frames_to_predict(size: Size) -> range:
    """Return the absolute numbers of the frames that a model must predict."""
    task = size.task
    return range(task.input_frames, task.input_frames + task.horizon)


def max_test_particles(size: Size) -> int:
    """Return the most particles of a test scenario."""
    return max(size.particle_count(scenario) for scenario in size.scored_scenarios)


def dataset_hash_of(size: Size, root: Path) -> str | None:
    """Return the recorded hash of a data set.

    It is the registry's, else that of a complete local data set; None without either.
    """
    if size.measured is not None:
        return size.measured.dataset_sha256
    return read_or_empty(size, root).dataset_sha256


class Truth:
    """The scored subset of a data set under a root folder.

    It is test, or what the size says; while a model is trained it is valid.
    """

    def __init__(self, size: Size, root: Path, subset: str | None = None) -> None:
        self.size = size
        self.root = root
        self.subset = subset or size.scored_subset

    @property
    def folder(self) -> Path:
        """The folder of the data set."""
        return self.size.folder(self.root)

    def path(self, scenario: int) -> Path:
        """Return where a scenario lies."""
        return self.size.path(self.root, scenario)

    def require(self) -> None:
        """Check that every scenario is there.

        Raises:
            DataError: scenarios are missing.
        """
        scenarios = self.size.subsets[self.subset]
        missing = [i for i in scenarios if not self.path(i).is_file()]
        if missing:
            raise DataError(
                f"{len(missing)} of {len(scenarios)} {self.subset} scenarios are not "
                f"generated ({format_ids(missing)}); {self._repair}",
                where=str(self.path(missing[0]).parent),
            )

    def check(self) -> None:
        """Compare the content hash of every scenario with the recorded one.

        Values are hashed, unless this machine has hashed the same file before.

        Raises:
            DataError: a scenario is damaged or not the recorded one.
        """
        check_contents(self.size, self.root, self.size.subsets[self.subset])

    @property
    def _repair(self) -> str:
        return suggest_repair(self.size, f"--subset {self.subset}", root=self.root)

    def open(self, scenario: int) -> ScenarioFile:
        """Open a scenario, and check that it is the one that the registry means.

        Raises:
            DataError: the file says that it is another scenario.
        """
        path = self.path(scenario)
        file = read_scenario(path)
        stated = file.header.key
        key = self.size.key(scenario)
        is_same = (stated.split, stated.size, stated.major, stated.scenario) == (
            key.split,
            key.size,
            key.major,
            scenario,
        )
        recorded_hash = self.size.registered_hash(scenario)
        if is_same and file.header.content_sha256.startswith(recorded_hash):
            return file
        file.close()
        raise DataError(
            f"not the {self.subset} scenario {scenario} of the registry; "
            f"{self._repair}",
            where=str(path),
        )

    def given_frames(self, scenario: int) -> NDArray[np.float32]:
        """Return the positions that a model is given.

        Positions [length], shape [frame, particle, space].
        """
        return self.frames(scenario, 0, self.size.task.input_frames)

    def frames(self, scenario: int, start: int, stop: int) -> NDArray[np.float32]:
        """Return some positions [length], shape [frame, particle, space]."""
        with self.open(scenario) as file:
            frames: NDArray[np.float32] = file.read("position", slice(start, stop))
        particles = self.size.particle_count(scenario)
        expected = (stop - start, particles, self.size.dimension)
        if frames.shape != expected:
            raise DataError(
                f"frames {start} to {stop - 1} have shape {frames.shape}, not "
                f"{expected}; make the data again",
                where=str(self.path(scenario)),
            )
        return frames

    def largest_displacement(self, scenario: int, *, enough: float) -> float:
        """Return the largest distance that a particle moves in a frame [length].

        Reading stops as soon as a distance of at least ``enough`` [length] is seen,
        which is then returned.
        """
        largest = 0.0
        with self.open(scenario) as file:
            frame_count = min(file.header.frames, frames_to_predict(self.size).stop)
            for start in range(0, frame_count - 1, BLOCK):
                stop = min(start + BLOCK + 1, frame_count)
                frames = file.read("position", slice(start, stop))
                largest_square = np.max(squared_steps(frames, self.size.box))
                largest = max(largest, float(np.sqrt(largest_square)))
                if largest >= enough:
                    break
        return largest


def squared_steps(frames: NDArray[np.floating], box: Box) -> NDArray[np.float64]:
    """Return the squared distances that particles move from frame to frame [length^2].

    Args:
        frames: positions [length], shape [frame, particle, space].
        box: box that holds the particles.

    Returns:
        Shape [frame - 1, particle].
    """
    exact_frames = frames.astype(np.float64)
    return squared_lengths(box.displacement(exact_frames[:-1], exact_frames[1:]))


def squared_lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared lengths of vectors, shape [..., particle].

    The vectors are overwritten.
    """
    vectors *= vectors
    # ten times as fast as a sum over the axis
    squares: NDArray[np.float64] = vectors[..., 0] + vectors[..., 1]
    for axis in range(2, vectors.shape[-1]):
        squares += vectors[..., axis]
    return squares
