"""Write scenario files: one netCDF4 file per trajectory, for any netCDF or HDF5 reader.

Dimensions are frame, particle, space and, in a full box with walls, wall;
docs/format.md has every variable and attribute. Writing needs netCDF4 only, so that
generation workers stay small.
"""

from __future__ import annotations

import errno
import itertools
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import (
    LIMIT_FIXES,
    DataError,
    LagbenchError,
    WorkFailedError,
)

from . import WALL
from .box import AXES, WALL_NAMES, parse_periodic
from .checksums import ContentHasher
from .hdf5 import open_netcdf, to_plain
from .layout import ScenarioKey
from .variables import (
    MAX_VALUES_PER_FRAME,
    RESERVED,
    expected_attributes,
    require_known_material,
)

FORMAT = 1
"""Number of the file layout; stored as attribute ``lagbench_format``."""

CHUNK_CACHE = 1 << 20
"""Chunk cache of a variable [bytes]; frames are written once, in order."""

PARTICLES_PER_CHUNK = 1 << 17
"""Most particles in a chunk: in two dimensions 1 MiB, the default chunk cache of HDF5.

Larger frames have several chunks.
"""


class ScenarioWriter:
    """Write one scenario file frame by frame; it appears whole or not at all.

    Use it as a context manager. The file has a temporary name until the clean exit,
    where it is checked for completeness, flushed to disk and renamed; on an error it is
    removed.

    Args:
        path: target, see :func:`lagbench.data.layout.scenario_path`.
        key: names of the scenario.
        particles: particles in every frame.
        frames: frames that will be appended.
        frame_interval: time between frames [s].
        material: value of :data:`lagbench.data.PARTICLE_KINDS` for each particle, shape
            [particle].
        particle_mass: mass of a particle, rho L^d / n.
        wall_velocity: [length/s], shape [wall, axis] (constant) or [frame, wall, axis],
            entry f acting from frame f-1 to f; walls left, right, bottom, top and, in
            three dimensions, front, back, those of periodic axes too; None where there
            are no moving walls (free surface).
        body_force: acceleration of the fluid in layers of equal height along y, lowest
            first [length/s^2], shape [frame, layer, axis], entry f acting from frame
            f-1 to f; None without a force.
        parameters: physical parameters by name: finite numbers and strings. Each
            becomes an attribute and enters the content hash. ``start_frame`` is one of
            them.
        seed: how the random numbers were seeded.
        device: device that simulated; not hashed.
        generator: dotted path of the split's module; not hashed.
        reynolds: Reynolds number, the parameter ``reynolds_number``; None where there
            is none.
        licence: licence of the data; not hashed.
        dimension: number of axes of the box, 2 or 3.
        periodic: names of the axes without walls, in any order. They are the hashed
            attribute ``periodic``, which files without such axes do not have.
        has_velocity: whether velocities of the solver are stored.

    Raises:
        DataError: there are too many particles, their material is unknown, or a
            parameter cannot be stored.
        UsageError: a periodic axis is that of no box, or named twice.
    """

    def __init__(
        self,
        path: Path,
        key: ScenarioKey,
        *,
        particles: int,
        frames: int,
        frame_interval: float,
        material: ArrayLike,
        particle_mass: float,
        wall_velocity: ArrayLike | None = None,
        body_force: ArrayLike | None = None,
        parameters: Mapping[str, object],
        seed: str,
        device: str,
        generator: str,
        reynolds: float | None = None,
        licence: str = "CC-BY-4.0",
        dimension: int = 2,
        periodic: Sequence[str] = (),
        has_velocity: bool = True,
    ) -> None:
        most_particles = MAX_VALUES_PER_FRAME // dimension
        if particles > most_particles:
            raise DataError(
                f"too many particles: got {particles}, expected at most "
                f"{most_particles}",
                where=str(path),
            )
        self.path = path
        self.key = key
        self.content_sha256 = ""  # content hash, set by the clean exit
        all_parameters = dict(parameters)
        if reynolds is not None:
            all_parameters["reynolds_number"] = reynolds
        self._parameters = _check_parameters(all_parameters, path)
        if periodic:
            is_periodic = parse_periodic(periodic, dimension)
            names = itertools.compress(AXES, is_periodic)
            self._parameters["periodic"] = " ".join(names)
        self._labels = {
            "seed": seed,
            "device": device,
            "generator": generator,
            "license": licence,
        }

        self._moving_names = ("position", "velocity") if has_velocity else ("position",)
        self._lengths = {"frame": frames, "particle": particles, "space": dimension}
        # dimensions and values by name of the variable
        self._constants: dict[str, tuple[tuple[str, ...], NDArray[Any]]] = {}
        materials = np.asarray(material)
        if materials.shape != (particles,):
            raise DataError(
                f"the materials have the wrong shape: got {materials.shape}, expected "
                f"{(particles,)}; give one number for each particle",
                where=f"{path}, variable 'material'",
            )
        # before the cast, which wraps
        fix = "give the numbers of lagbench.data.PARTICLE_KINDS"
        require_known_material(materials, where=str(path), fix=fix)
        numbers = np.arange(frames, dtype=np.int32)
        self._constants |= {
            "frame": (("frame",), numbers),
            "time": (("frame",), numbers.astype(np.float64) * frame_interval),
            "particle": (("particle",), np.arange(particles, dtype=np.int32)),
            "space": (("space",), np.array(AXES[:dimension], dtype=object)),
            "material": (("particle",), materials.astype(np.int8)),
            "particle_mass": ((), np.asarray(particle_mass, dtype=np.float64)),
        }
        if wall_velocity is not None:
            wall_names = np.array(WALL_NAMES[: 2 * dimension], dtype=object)
            self._lengths["wall"] = len(wall_names)
            self._constants["wall"] = (("wall",), wall_names)
            self._add_vectors("wall_velocity", "wall", wall_velocity)
        if body_force is not None:
            self._lengths["layer"] = np.shape(body_force)[1]
            self._add_vectors("body_force", "layer", body_force)

        self._hasher = ContentHasher(key.identity(seed, self._parameters))
        self._written_frames = 0

    def _add_vectors(self, name: str, place: str, vectors: ArrayLike) -> None:
        """Add constants of each frame and wall or layer."""
        dims = ("frame", place, "space")
        shape = [self._lengths[dim] for dim in dims]
        values = np.broadcast_to(np.asarray(vectors, np.float32), shape)
        self._constants[name] = (dims, values)

    def __enter__(self) -> Self:
        """Create the temporary file with everything but the frames."""
        with ExitStack() as stack:
            stack.enter_context(_write_errors(self.path))
            temporary = stack.enter_context(atomic_path(self.path))
            self._file = open_netcdf(temporary, "w")
            stack.callback(self._file.close)
            for dimension, length in self._lengths.items():
                self._file.createDimension(dimension, length)
            for name, (dims, values) in self._constants.items():
                self._create(name, values.dtype, dims)
                self._hasher.update(name, values)
                self._file[name][...] = values
            for name in self._moving_names:
                self._create(name, np.dtype(np.float32), ("frame", "particle", "space"))
            attributes = self._file_attributes(version("lagbench"))
            self._file.setncatts(attributes | self._parameter_attributes())
            self._stack = stack.pop_all()
        return self

    def _file_attributes(self, program_version: str) -> dict[str, object]:
        key = self.key
        return {
            "Conventions": "CF-1.11",
            "title": f"lagbench {key.split} {key.size}, scenario {key.scenario}",
            "source": f"lagbench {program_version}, {self._labels['generator']}",
            "lagbench_format": FORMAT,
            "lagbench_version": program_version,
            "split": key.split,
            "size": key.size,
            "version": key.version,
            "scenario": key.scenario,
            "subset": key.subset,
            **self._labels,
        }

    def append(
        self,
        position: NDArray[np.float32],
        velocity: NDArray[np.float32] | None = None,
    ) -> None:
        """Add the next frame.

        Args:
            position: particle positions [length], shape [particle, axis].
            velocity: particle velocities of the solver [length/s], of the same shape;
                None in a file without velocities.

        Raises:
            DataError: the arrays have the wrong shape or type, all frames are written,
                or there are velocities against what the writer was told.
            WorkFailedError: the disk is full or not writable.
        """
        arrays = {"position": position}
        if velocity is not None:
            arrays["velocity"] = velocity
        if len(arrays) != len(self._moving_names):
            raise DataError(
                "velocities come with every frame or with none: got "
                f"{', '.join(arrays)}, expected {', '.join(self._moving_names)}",
                where=str(self.path),
            )
        shape = (self._lengths["particle"], self._lengths["space"])
        for name, values in arrays.items():
            if values.shape != shape:
                raise DataError(
                    f"a frame has the wrong shape: got {values.shape}, expected "
                    f"{shape}",
                    where=f"{self.path}, variable {name!r}",
                )
            self._hasher.update(name, values)
            with _write_errors(self.path):
                self._file[name][self._written_frames] = values
        self._written_frames += 1

    def state(self, **parameters: object) -> None:
        """State further parameters after the last frame; they are hashed too."""
        self._parameters |= _check_parameters(parameters, self.path)
        seed = self._labels["seed"]
        self._hasher.identity = self.key.identity(seed, self._parameters)
        with _write_errors(self.path):
            self._file.setncatts(self._parameter_attributes())

    def _parameter_attributes(self) -> dict[str, object]:
        names = " ".join(sorted(self._parameters))
        return {**self._parameters, "hashed_parameters": names}

    def state_facts(self, facts: Mapping[str, float]) -> None:
        """State simulation diagnostics: finite numbers by name, without a hash."""
        with _write_errors(self.path):
            self._file.facts = json.dumps(dict(facts), allow_nan=False)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish and rename the file, or remove it when the body raised."""
        if error is not None:
            # the error of the body goes on as it is, whatever its kind
            with suppress(WorkFailedError):
                self._stack.__exit__(kind, error, trace)
            return
        with self._stack:  # its exit closes and renames the file
            digests = self._hasher.digests()
            self.content_sha256 = self._hasher.hexdigest()
            for name, digest in digests.items():
                self._file[name].content_sha256 = digest
            self._file.content_sha256 = self.content_sha256

    def _create(self, name: str, dtype: np.dtype[Any], dims: tuple[str, ...]) -> None:
        shape = tuple(self._lengths[dimension] for dimension in dims)
        if dtype.kind == "O":
            variable = self._file.createVariable(name, str, dims)
        else:
            variable = self._file.createVariable(
                name,
                dtype,
                dims,
                compression="zlib" if dims else None,
                complevel=1,
                shuffle=True,
                chunksizes=_chunk_shape(dims, shape),
                endian="little",
                fill_value=False,
                chunk_cache=CHUNK_CACHE,
            )
        has_wall = bool((self._constants["material"][1] == WALL).any())
        variable.setncatts(expected_attributes(name, dims, has_wall_particles=has_wall))
        self._hasher.declare(name, dtype, dims, shape)


def _chunk_shape(
    dims: tuple[str, ...], shape: tuple[int, ...]
) -> tuple[int, ...] | None:
    """Return the shape of a chunk; None for a single value."""
    if "particle" in dims and "frame" in dims:
        return (1, min(shape[1], PARTICLES_PER_CHUNK), *shape[2:])
    return shape or None


def _check_parameters(
    parameters: Mapping[str, object], path: Path
) -> dict[str, object]:
    """Return parameters as plain values; refuse reserved names and other values."""
    plain_values: dict[str, object] = {}
    for name, value in parameters.items():
        if not name.isidentifier() or name in RESERVED:
            raise DataError(
                f"no parameter can be named {name!r}; take letters, digits and _, and "
                "no name that files use",
                where=str(path),
            )
        plain_values[name] = to_plain(value)
    return plain_values


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Turn what netCDF4 raises on a full or read-only disk into a lagbench error."""
    try:
        yield
    except LagbenchError:
        raise
    except (OSError, RuntimeError, UnicodeError) as error:  # a path that is no UTF-8
        free_bytes = 0
        if path.parent.is_dir():
            free_bytes = shutil.disk_usage(path.parent).free
        raise WorkFailedError(
            f"cannot write a scenario file: {error}; {free_bytes:,} bytes free; free "
            "disk space, or name a folder that you may write to: --root or "
            f"LAGBENCH_ROOT; if there is space, {LIMIT_FIXES[errno.EFBIG]}",
            where=str(path),
        ) from error
