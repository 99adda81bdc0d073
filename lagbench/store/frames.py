"""Frames of many scenario files, read when asked for and kept in bounded memory.

Scenario files of a data set's subsets, as the registry names them.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.layout import ScenarioKey, major_of, scenario_path
from lagbench.data.local import remedy
from lagbench.data.registry import Size, spell_ids
from lagbench.errors import DataError, LagbenchError, UsageError, nearest

from .copy import bring

if TYPE_CHECKING:
    import h5py

__all__ = [
    "Source",
    "sources_of",
    "CACHE_BYTES",
    "FrameStore",
]


@dataclass(frozen=True, kw_only=True)
class Source:
    """A scenario file and what the registry says that it is."""

    path: Path  # path of the file
    key: ScenarioKey  # what names the scenario
    frames: int  # frames that it holds
    digest: str = ""  # first digits of its content hash; empty when none is known
    remedy: str = ""  # what writes the file anew, in words


def sources_of(size: Size, subsets: Sequence[str], root: Path) -> dict[int, Source]:
    """Return the scenario files of subsets by id; say which are missing."""
    digests = size.measured.scenario_sha256 if size.measured else {}
    sources: dict[int, Source] = {}
    for subset in subsets:
        if subset not in size.subsets:
            raise UsageError(
                f"no subset {subset!r}", where=f"{size.split} {size.name}", fix=nearest(subset, size.subsets)
            )
        for i in size.subsets[subset]:
            key = ScenarioKey(
                split=size.split, size=size.name, version=size.version, scenario=i, subset=subset
            )
            sources[i] = Source(
                path=scenario_path(root, key),
                key=key,
                frames=size.frame_count(i),
                digest=digests.get(i, ""),
                remedy=remedy(size, f"--subset {subset}"),
            )
    bring(size, root, sources)
    missing = [i for i, source in sources.items() if not source.path.is_file()]
    if missing:
        raise DataError(
            f"{len(missing)} of {len(sources)} scenarios are not there",
            where=str(root / size.split / size.name),
            got=f"missing: {spell_ids(missing)}",
            fix=remedy(size, root=root),
        )
    return sources


Floats = NDArray[np.float32]

CACHE_BYTES = 256 << 20
"""Frames kept decompressed, by default [bytes]."""

OPEN_FILES = 32
"""Files kept open in one process, about 0.6 MB each."""


@dataclass(frozen=True)
class _Open:
    """An open file with what is the same in all its windows."""

    file: h5py.File
    position: h5py.Dataset
    material: NDArray[np.int8]
    wall_velocity: Floats | None


class FrameStore:
    """Read frames of scenarios; those used last stay in memory, up to a fixed number of bytes.

    Files are opened by the process that reads them and never written, so a store may be sent to
    worker processes: each has a cache of its own.

    Args:
        sources: scenario files by id.
        cache_bytes: frames kept decompressed [bytes].
    """

    def __init__(self, sources: Mapping[int, Source], *, cache_bytes: int = CACHE_BYTES) -> None:
        self.sources = dict(sources)
        self.cache_bytes = cache_bytes
        self._forget()

    def _forget(self) -> None:
        self._process = os.getpid()
        self._open: OrderedDict[int, _Open] = OrderedDict()
        self._frames: OrderedDict[tuple[int, int], Floats] = OrderedDict()
        self.cached_bytes = 0

    def __getstate__(self) -> dict[str, Any]:
        """Leave open files and cached frames behind when sent to another process."""
        return {"sources": self.sources, "cache_bytes": self.cache_bytes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start with nothing open and nothing cached."""
        self.__init__(state["sources"], cache_bytes=state["cache_bytes"])  # type: ignore[misc]

    def frames(self, scenario: int, start: int, stop: int) -> list[Floats]:
        """Return positions of consecutive frames [length], each of shape [particle, 2].

        The arrays are those of the cache: copy them, never write to them.
        """
        self._own()
        found = {frame: self._frames.get((scenario, frame)) for frame in range(start, stop)}
        for first, last in _runs([frame for frame, values in found.items() if values is None]):
            found.update(self._read(scenario, first, last))
        for frame, values in found.items():
            if values is not None:
                self._keep((scenario, frame), values)
        self._shrink()
        return [values for values in found.values() if values is not None]

    def constants(self, scenario: int) -> tuple[NDArray[np.int8], Floats | None]:
        """Return material, shape [particle], and wall velocity [length/s], [frame, wall, 2].

        Material is 0, liquid, in files without it; wall velocity is None where no wall moves.
        """
        self._own()
        opened = self._opened(scenario)
        return opened.material, opened.wall_velocity

    def _own(self) -> None:
        """Reopen files after a fork: HDF5 handles do not survive one."""
        if os.getpid() != self._process:
            self._forget()

    def _read(self, scenario: int, first: int, last: int) -> Iterator[tuple[int, Floats]]:
        with _damage(self.sources[scenario]):
            values = self._opened(scenario).position[first:last]
        # Copies, so that each frame's memory is free when it leaves the cache.
        return ((first + i, frame.copy()) for i, frame in enumerate(values))

    def _keep(self, place: tuple[int, int], values: Floats) -> None:
        if place not in self._frames:
            self._frames[place] = values
            self.cached_bytes += values.nbytes
        self._frames.move_to_end(place)

    def _shrink(self) -> None:
        while self.cached_bytes > self.cache_bytes:
            _, values = self._frames.popitem(last=False)
            self.cached_bytes -= values.nbytes

    def _opened(self, scenario: int) -> _Open:
        """Return an open file; close the one that was used longest ago when there are too many."""
        if scenario not in self._open:
            self._open[scenario] = _open(self.sources[scenario])
            if len(self._open) > OPEN_FILES:
                self._open.popitem(last=False)[1].file.close()
        self._open.move_to_end(scenario)
        return self._open[scenario]


def _runs(frames: list[int]) -> Iterator[tuple[int, int]]:
    """Yield first and one past the last of each run of consecutive numbers."""
    first = 0
    for i, frame in enumerate(frames):
        if i + 1 == len(frames) or frames[i + 1] != frame + 1:
            yield frames[first], frame + 1
            first = i + 1


def _open(source: Source) -> _Open:
    """Open a file and check that it is what the registry says."""
    import h5py

    if not source.path.is_file():
        raise DataError("a scenario file is missing", where=str(source.path), fix=source.remedy)
    with _damage(source):
        # Frames are cached by the store: HDF5 need not keep chunks too.
        file = h5py.File(source.path, "r", rdcc_nbytes=0)
        _check(file, source)
        position = file["position"]
        found = file.get("material")
        material = np.zeros(position.shape[1], np.int8) if found is None else found[...]
        walls = file.get("wall_velocity")
        return _Open(file, position, material, None if walls is None else walls[...])


def _check(file: h5py.File, source: Source) -> None:
    """Refuse a file of another scenario, version or content."""
    held, key = file.attrs, source.key
    split, size, version, content = (
        _text(held[name]) for name in ("split", "size", "version", "content_sha256")
    )
    found = (split, size, major_of(version), int(np.asarray(held["scenario"]).item()), len(file["position"]))
    expected = (key.split, key.size, key.major, key.scenario, source.frames)
    if found == expected and content.startswith(source.digest):
        return
    file.close()
    raise DataError(
        "a scenario file is not that of the registry",
        where=str(source.path),
        expected=f"(split, size, version, id, frames) = {expected}, content hash {source.digest or 'any'}",
        got=f"{found}, content hash {content[:16]}",
        fix=source.remedy,
    )


@contextmanager
def _damage(source: Source) -> Iterator[None]:
    """Turn whatever HDF5 raises on damaged bytes into a DataError naming the file."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # no list of types holds: damage surfaces as nearly any of them
        raise DataError(
            "a scenario file is damaged or not one of lagbench",
            where=str(source.path),
            got=f"{type(error).__name__}: {error}",
            fix=source.remedy,
        ) from error


def _text(value: str | bytes) -> str:
    """Return an attribute as text; netCDF4 stores ASCII text as bytes."""
    return value.decode() if isinstance(value, bytes) else str(value)
