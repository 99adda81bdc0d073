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
from lagbench.data.registry import format_ids
from lagbench.data.structure import estimate_chunk_cache
from lagbench.errors import UsageError

from .findings import Findings
from .format import (
    DIMS,
    REQUIRED,
    SPACE,
    WRITE,
    Anatomy,
    Header,
    check_dims,
    check_dtype,
    check_format,
    check_marks,
    dissect,
    header_of,
)

BLOCK_BYTES = 1 << 20
"""Blocks have about this size [bytes]."""


class Predictions:
    """An open predictions.nc; use it as a context manager."""

    def __init__(
        self, path: Path, anatomy: Anatomy, position: h5py.Dataset, stack: ExitStack
    ) -> None:
        self.path = path
        self.anatomy = anatomy
        self.header: Header = header_of(anatomy)
        self._position = position
        self._stack = stack
        self._row = {
            scenario: row for row, scenario in enumerate(self.header.scenarios)
        }

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
        """Return consecutive frames of a scenario; the order of scenarios does not
        matter.

        Args:
            scenario: id of the scenario.
            start: absolute number of the first frame, one of ``header.frames``.
            count: how many stored frames to read from there.

        Returns:
            Positions [length], shape [frame, particle, space], in the machine's byte
            order.

        Raises:
            UsageError: the file has no such scenario or frames.
            UnreadableFileError: the file is damaged there.
        """
        numbers = self.header.frames
        if start in numbers:
            first = numbers.index(start)
        else:
            first = -1
        if (
            scenario not in self._row
            or first < 0
            or count < 0
            or first + count > len(numbers)
        ):
            what = "the file has no such frames"
            got = f"scenario {scenario}, {count} frames from {start}"
            expected = f"scenarios {format_ids(self.header.scenarios)}, frames {format_ids(numbers)}"
            raise UsageError(what, where=str(self.path), expected=expected, got=got)
        with hdf5_errors(self.path, "position"):
            values: NDArray[Any] = self._position[
                self._row[scenario], first : first + count
            ]
            return np.ascontiguousarray(values, dtype=np.float32)

    def blocks(self, scenario: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield a scenario in pieces of about 1 MiB: absolute first frame, positions.

        Raises:
            UsageError: the file has no such scenario.
            UnreadableFileError: the file is damaged.
        """
        numbers = self.header.frames
        step = max(1, BLOCK_BYTES // (4 * SPACE * max(1, self.header.particles)))
        for first in range(0, len(numbers), step):
            count = min(step, len(numbers) - first)
            yield numbers[first], self.frames(scenario, numbers[first], count)

    def content_sha256(self) -> str:
        """Return the hash of the predicted positions, by ascending scenario id.

        It names a submission whatever packed it: see docs/predictions.md.

        Raises:
            UnreadableFileError: the file is damaged.
        """
        hasher = self.hasher()
        for scenario in sorted(self.header.scenarios):
            for _, block in self.blocks(scenario):
                hasher.update("position", block)
        return hasher.hexdigest()

    def hasher(self) -> ContentHasher:
        """Return the content hash as far as the header goes; blocks follow by ascending
        scenario id.
        """
        header = self.header
        ids = sorted(header.scenarios)
        identity = {name: getattr(header, name) for name in REQUIRED}
        hasher = ContentHasher(
            {**identity, "scenarios": ids, "frames": list(header.frames)}
        )
        shape = (len(ids), len(header.frames), header.particles, SPACE)
        hasher.declare("position", np.dtype(np.float32), DIMS, shape)
        return hasher


def open_predictions(
    path: str | Path, *, checked: Anatomy | None = None
) -> Predictions:
    """Open a predictions.nc without trusting it.

    Only the layout of the file is checked here, not its agreement with a data set: that
    is `lagbench.validate`, which also guards against files that make HDF5 loop or
    crash.

    Args:
        path: the file.
        checked: the anatomy of this very file when it was opened before: one as long is
            not checked again.

    Raises:
        UnreadableFileError: missing, not netCDF4, or damaged.
        ChecksFailedError: not laid out as docs/predictions.md says.
    """
    path = Path(path)
    with ExitStack() as stack:
        file = stack.enter_context(open_hdf5(path, fix=WRITE))
        if checked is None or checked.length != path.stat().st_size:
            checked = dissect(file, path)
            out = Findings()
            for check in (check_format, check_dims, check_dtype, check_marks):
                check(checked, out)
            out.result(path).check()
        return attach(file, path, checked, stack)


def attach(
    file: h5py.File, path: Path, anatomy: Anatomy, stack: ExitStack
) -> Predictions:
    """Return the predictions of an open file whose layout has been checked; they take
    over the stack.
    """
    with hdf5_errors(path, "position"):
        # just the chunk cache that reading in order needs
        size, kept = estimate_chunk_cache(anatomy.arrays["position"])
        plist = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
        plist.set_chunk_cache(10 * kept + 521, size, 1.0)
        position = h5py.Dataset(h5py.h5d.open(file.id, b"position", plist))
    return Predictions(path, anatomy, position, stack.pop_all())
