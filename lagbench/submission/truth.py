"""The scenarios that predictions are held against: hashed before use, read a few frames
at a time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.layout import quote_root
from lagbench.data.local import suggest_repair
from lagbench.data.manifest import load_recorded_hashes, read_or_empty, record_hashes
from lagbench.data.registry import Size, format_ids
from lagbench.data.scenario import ScenarioFile, check_scenario, read_scenario
from lagbench.errors import DataError

BLOCK = 16
"""Frames that are read at a time."""


class Truth:
    """The test subset of a data set under a root folder; while a model is trained, its
    valid subset.
    """

    def __init__(self, size: Size, root: Path, subset: str = "test") -> None:
        self.size = size
        self.root = root
        self.subset = subset

    @property
    def folder(self) -> Path:
        """The folder of the data set."""
        return self.size.folder(self.root)

    def require(self) -> None:
        """Check that every scenario is there."""
        ids = self.size.subsets[self.subset]
        missing = [i for i in ids if not self.path(i).is_file()]
        if missing:
            raise DataError(
                f"{len(missing)} of {len(ids)} {self.subset} scenarios are not "
                f"generated",
                where=str(self.path(ids[0]).parent),
                expected=f"scenarios {format_ids(ids)}",
                got=f"missing: {format_ids(missing)}",
                fix=self._remedy(),
            )

    def check(self) -> None:
        """Hash the values of every scenario, or find that this machine has done so."""
        known = load_recorded_hashes(self.folder)
        new = {}
        verify = f"lagbench verify --split {self.size.split} --size {self.size.name}"
        fix = (
            f"{self._remedy()}; {verify} --root {quote_root(self.root)} says what is wrong"
        )
        if self.size.measured:
            recorded = None
        else:
            recorded = read_or_empty(self.size, self.root)
        for scenario in sorted(self.size.subsets[self.subset]):
            path = self.path(scenario)
            if recorded:
                entry = recorded.entry(scenario)
            else:
                entry = None
            # what is known of the content hash: its first digits, all, or nothing
            if entry:
                expected = entry.content_sha256
            else:
                expected = self._hash(scenario)
            try:
                found = known(path)
                if found is None:
                    new[path] = check_scenario(path)
                if found:
                    content = found[0]
                else:
                    content = new[path]
            except OSError as error:
                what = f"cannot read a {self.subset} scenario"
                raise DataError(
                    what, where=str(path), got=error.strerror, fix=fix
                ) from error
            except DataError as error:
                where = error.where or str(path)
                wanted = error.expected
                raise DataError(
                    error.what, where=where, expected=wanted, got=error.got, fix=fix
                ) from error
            if not content.startswith(expected):
                what = f"a {self.subset} scenario has another content hash"
                raise DataError(
                    what, where=str(path), expected=expected, got=content, fix=fix
                )
        record_hashes(self.folder, new)

    def _remedy(self) -> str:
        return suggest_repair(self.size, f"--subset {self.subset}", root=self.root)

    def path(self, scenario: int) -> Path:
        """Return where a scenario lies."""
        return self.size.path(self.root, scenario)

    def open(self, scenario: int) -> ScenarioFile:
        """Open a scenario; check that it is the one that the registry means."""
        path = self.path(scenario)
        key = self.size.key(scenario)
        file = read_scenario(path)
        header = file.header
        found = (
            header.key.split,
            header.key.size,
            header.key.major,
            header.key.scenario,
        )
        expected = (key.split, key.size, key.major, scenario)
        short = self._hash(scenario)
        if found == expected and header.content_sha256.startswith(short):
            return file
        file.close()
        raise DataError(
            f"a {self.subset} scenario is not that of the registry",
            where=str(path),
            expected=f"{expected}, content hash {short or 'any'}",
            got=f"{found}, content hash {header.content_sha256[:16]}",
            fix=self._remedy(),
        )

    def given(self, scenario: int) -> NDArray[np.float32]:
        """Return the frames given to a model [length], shape [frame, particle,
        space].
        """
        return self._frames(scenario, 0, self.size.task.input_frames)

    def around_start(self, scenario: int) -> NDArray[np.float32]:
        """Return the last given frame and the first two to be predicted, or the only
        one.

        Positions [length], shape [2 or 3, particle, space].
        """
        task = self.size.task
        last = task.input_frames - 1
        return self._frames(scenario, last, last + 1 + min(2, task.horizon))

    def _frames(self, scenario: int, start: int, stop: int) -> NDArray[np.float32]:
        with self.open(scenario) as file:
            frames: NDArray[np.float32] = file.read("position", slice(start, stop))
            if len(frames) == stop - start and frames.shape[1] == self.size.particles:
                return frames
            what = f"a {self.subset} scenario has other frames or particles than the registry says"
            expected = f"at least {stop} frames of {self.size.particles} particles"
            raise DataError(
                what,
                where=str(self.path(scenario)),
                expected=expected,
                got=frames.shape,
            )

    def largest_displacement(self, scenario: int, *, enough: float) -> float:
        """Return the largest distance that a particle moves from one frame to the next
        [length].

        Reading stops as soon as one of at least ``enough`` [length] is found, which is
        then returned.
        """
        task = self.size.task
        largest = 0.0
        with self.open(scenario) as file:
            last = min(file.header.frames, task.input_frames + task.horizon)
            for start in range(0, last - 1, BLOCK):
                frames = file.read(
                    "position", slice(start, min(start + BLOCK + 1, last))
                )
                largest = max(largest, float(np.sqrt(np.max(squared_steps(frames)))))
                if largest >= enough:
                    break
        return largest

    def _hash(self, scenario: int) -> str:
        measured = self.size.measured
        if measured:
            return measured.scenario_sha256.get(scenario, "")
        return ""


def squared_steps(frames: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the squared distances of particles between frames [length^2], shape [frame
    - 1, particle].
    """
    return squared_lengths(np.diff(frames.astype(np.float64), axis=0))


def squared_lengths(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared lengths of vectors, shape [..., particle]; the vectors are
    overwritten.
    """
    steps *= steps
    # ten times as fast as a sum over the axis
    squares: NDArray[np.float64] = steps[..., 0] + steps[..., 1]
    return squares
