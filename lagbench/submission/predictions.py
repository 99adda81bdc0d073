"""Read a predictions.nc frame by frame, in memory that does not grow with the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import ContentHasher
from lagbench.data.hdf5 import hdf5_errors, open_hdf5
from lagbench.data.layout import expand_home, format_ids
from lagbench.errors import UsageError

from .format import (
    DIMS,
    IDENTITY,
    WRITE,
    FileInfo,
    check_layout,
    inspect_file,
)
from .headers import estimate_chunk_cache
from .issues import IssueCollector

BLOCK_BYTES = 1 << 20
"""Blocks have about this size [bytes]."""

FLOAT_BYTES = np.dtype(np.float32).itemsize


class Predictions:
    """An open predictions.nc; use it as a context manager."""

    def __init__(
        self, path: Path, info: FileInfo, position: h5py.Dataset, stack: ExitStack
    ) -> None:
        self.path = path
        self.info = info
        self.header = info.header
        self._position = position
        self._stack = stack
        self._row = {}
        for row, scenario in enumerate(self.header.scenarios):
            self._row[scenario] = row

    def __enter__(self) -> Self:
        """Return the predictions themselves."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._stack.close()

    def frames(self, scenario: int, start: int, count: int) -> NDArray[np.float32]:
        """Return consecutive frames of a scenario.

        Args:
            scenario: id of the scenario; the order of scenarios does not matter.
            start: absolute number of the first frame, one of ``header.frames``.
            count: how many stored frames to read from there.

        Returns:
            Positions [length], shape [frame, particle, space], in the machine's byte
            order, without padding.

        Raises:
            UsageError: the file has no such scenario or frames.
            UnreadableFileError: the file is damaged there.
        """
        numbers = self.header.frames
        has_start = scenario in self._row and start in numbers
        first = numbers.index(start) if has_start else 0
        if not has_start or not 0 <= count <= len(numbers) - first:
            raise UsageError(
                f"no {count} frames from {start} of scenario {scenario}; there are "
                f"scenarios {format_ids(self.header.scenarios)}, frames "
                f"{format_ids(numbers)}",
                where=str(self.path),
            )
        row = self._row[scenario]
        particles = self.header.particle_count(scenario)
        with hdf5_errors(self.path, "position"):
            values: NDArray[Any] = self._position[row, first : first + count]
            values = values[:, :particles]
            return np.ascontiguousarray(values, dtype=np.float32)

    def blocks(self, scenario: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield a scenario in pieces of about 1 MiB: absolute first frame, positions.

        Raises:
            UsageError: the file has no such scenario.
            UnreadableFileError: the file is damaged.
        """
        numbers = self.header.frames
        frame_bytes = FLOAT_BYTES * self.header.space * max(1, self.header.particles)
        block_frames = max(1, BLOCK_BYTES // frame_bytes)
        for first in range(0, len(numbers), block_frames):
            count = min(block_frames, len(numbers) - first)
            yield numbers[first], self.frames(scenario, numbers[first], count)

    def content_sha256(self) -> str:
        """Return the hash of the predicted positions, by ascending scenario id.

        It names a submission whatever packed it: see docs/predictions.md.

        Raises:
            UnreadableFileError: the file is damaged.
        """
        hasher = self.start_hash()
        for scenario in sorted(self.header.scenarios):
            for _, block in self.blocks(scenario):
                hasher.update("position", self.pad(block))
        return hasher.hexdigest()

    def pad(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return positions with NaN for the particles that a scenario does not have.

        The shape is [frame, particle, space]; the hash is that of padded positions,
        whatever the file holds there.
        """
        missing = self.header.particles - block.shape[1]
        if not missing:
            return block
        widths = ((0, 0), (0, missing), (0, 0))
        return np.pad(block, widths, constant_values=np.float32(np.nan))

    def start_hash(self) -> ContentHasher:
        """Return a content hash of the header.

        Blocks of positions are to be added by ascending scenario id.
        """
        header = self.header
        scenarios = sorted(header.scenarios)
        identity: dict[str, Any] = {}
        for name in IDENTITY:
            identity[name] = getattr(header, name)
        identity["scenarios"] = scenarios
        identity["frames"] = list(header.frames)
        if header.particle_counts:
            counts = [header.particle_count(scenario) for scenario in scenarios]
            identity["particle_counts"] = counts
        hasher = ContentHasher(identity)
        shape = (len(scenarios), len(header.frames), header.particles, header.space)
        hasher.declare("position", np.dtype(np.float32), DIMS, shape)
        return hasher


def open_predictions(path: str | Path) -> Predictions:
    """Open a predictions.nc without trusting it.

    Only the layout of the file is checked here, not its agreement with a data set: that
    is `lagbench.validate`, which also guards against files that make HDF5 loop or
    crash.

    Raises:
        UnreadableFileError: missing, not netCDF4, or damaged.
        ChecksFailedError: not laid out as docs/predictions.md says.
    """
    path = expand_home(path, "path")
    with ExitStack() as stack:
        file = stack.enter_context(open_hdf5(path, fix=WRITE))
        info = inspect_file(file, path)
        issues = IssueCollector()
        check_layout(info, issues)
        issues.result(path).check()
        return attach(file, path, info, stack)


def attach(
    file: h5py.File, path: Path, info: FileInfo, stack: ExitStack
) -> Predictions:
    """Return the predictions of an open file whose layout has been checked.

    They take over the stack.
    """
    with hdf5_errors(path, "position"):
        # just the chunk cache that reading in order needs
        cache_bytes, chunk_count = estimate_chunk_cache(info.arrays["position"])
        access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
        access.set_chunk_cache(10 * chunk_count + 521, cache_bytes, 1.0)
        position = h5py.Dataset(h5py.h5d.open(file.id, b"position", access))
    return Predictions(path, info, position, stack.pop_all())
