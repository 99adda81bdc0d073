"""Scenario files: one netCDF4 file per trajectory that any netCDF or HDF5 reader opens.

Dimensions are frame, particle, space and, in a closed box, wall; docs/format.md has
every variable and attribute. Writing needs netCDF4 only, so that generation workers
stay small.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import DataError, LagbenchError, WorkFailedError

from . import WALLS
from .checksums import ContentHasher, plain
from .layout import ScenarioKey as ScenarioKey
from .layout import scenario_path as scenario_path
from .scenario import AXES, MOST_IN_ROW, attributes_of
from .scenario import ScenarioFile as ScenarioFile
from .scenario import check_scenario as check_scenario
from .scenario import read_scenario as read_scenario
from .scenario import rehash as rehash

FORMAT = 1
"""Number of the file layout; stored as attribute ``lagbench_format``."""

CHUNK_CACHE = 1 << 20
"""Chunk cache of a variable while writing [bytes]; frames are written once, in order.
"""

PARTICLES_PER_CHUNK = 1 << 17
"""Particles in a chunk at the most: 1 MiB, the default chunk cache of HDF5. Frames of
more have several.
"""

_RESERVED = {
    *(
        "Conventions",
        "title",
        "source",
        "license",
        "lagbench_format",
        "lagbench_version",
    ),
    *("split", "size", "version", "scenario", "subset", "seed", "generator", "device"),
    *("hashed_parameters", "content_sha256", "facts"),
}


class ScenarioWriter:
    """Write one scenario file frame by frame; it appears whole or not at all.

    Use it as a context manager. The file has a temporary name until the clean exit,
    where it is checked for completeness, flushed to disk and renamed; on an error it is
    removed.

    Args:
        path: target, see :func:`scenario_path`.
        key: what names the scenario.
        particles: particles in every frame.
        frames: frames that will be appended.
        frame_interval: time between frames [s].
        material: value of :data:`lagbench.data.MATERIALS` for each particle, shape
            [particle].
        particle_mass: mass of a particle, rho L^2 / n.
        wall_velocity: [length/s], shape [wall, 2] (constant) or [frame, wall, 2], entry
            f being what acts from frame f-1 to f; walls left, right, bottom, top; None
            where there are no moving walls (free surface).
        parameters: physical parameters by name: finite numbers and strings. Each
            becomes an attribute and enters the content hash. ``start_frame`` is one of
            them.
        seed: how the random numbers were seeded.
        device: device that simulated; not hashed.
        generator: dotted path of the split's module; not hashed.
        reynolds: Reynolds number, the parameter ``reynolds_number``; None where there
            is none.
        licence: licence of the data; not hashed.
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
        parameters: Mapping[str, object],
        seed: str,
        device: str,
        generator: str,
        reynolds: float | None = None,
        licence: str = "CC-BY-4.0",
    ) -> None:
        if particles * len(AXES) > MOST_IN_ROW:
            expected = f"at most {MOST_IN_ROW // len(AXES)}"
            raise DataError(
                "too many particles", where=str(path), expected=expected, got=particles
            )
        self.path = path
        self.key = key
        self.content_sha256 = ""  # content hash, set by the clean exit
        if reynolds is None:
            extra = {}
        else:
            extra = {"reynolds_number": reynolds}
        self._parameters = _checked({**parameters, **extra}, path)
        self._labels = {
            "seed": seed,
            "device": device,
            "generator": generator,
            "license": licence,
        }
        self._shape = {"frame": frames, "particle": particles, "space": len(AXES)}
        self._constants: dict[str, tuple[tuple[str, ...], NDArray[Any]]] = {
            "frame": (("frame",), np.arange(frames, dtype=np.int32)),
            "time": (("frame",), np.arange(frames, dtype=np.float64) * frame_interval),
            "particle": (("particle",), np.arange(particles, dtype=np.int32)),
            "space": (("space",), np.array(AXES, dtype=object)),
            "material": (("particle",), np.asarray(material, dtype=np.int8)),
            "particle_mass": ((), np.asarray(particle_mass, dtype=np.float64)),
        }
        if wall_velocity is not None:
            walls = np.broadcast_to(
                np.asarray(wall_velocity, np.float32), (frames, len(WALLS), len(AXES))
            )
            self._shape["wall"] = len(WALLS)
            self._constants["wall"] = (("wall",), np.array(WALLS, dtype=object))
            self._constants["wall_velocity"] = (("frame", "wall", "space"), walls)
        self._hasher = ContentHasher(key.identity(seed, self._parameters))
        self._written = 0

    def __enter__(self) -> Self:
        """Create the temporary file with everything but the frames."""
        from importlib.metadata import version

        import netCDF4

        with ExitStack() as stack:
            stack.enter_context(_write_errors(self.path))
            temporary = stack.enter_context(atomic_path(self.path))
            self._file = netCDF4.Dataset(temporary, "w", format="NETCDF4")
            stack.callback(self._file.close)
            for name, length in self._shape.items():
                self._file.createDimension(name, length)
            for name, (dims, values) in self._constants.items():
                self._create(name, values.dtype, dims)
                self._hasher.update(name, values)
                self._file[name][...] = values
            for name in ("position", "velocity"):
                self._create(name, np.dtype(np.float32), ("frame", "particle", "space"))
            key = self.key
            program = version("lagbench")
            attributes = {
                "Conventions": "CF-1.11",
                "title": f"lagbench {key.split} {key.size}, scenario {key.scenario}",
                "source": f"lagbench {program}, {self._labels['generator']}",
                "lagbench_format": FORMAT,
                "lagbench_version": program,
                "split": key.split,
                "size": key.size,
                "version": key.version,
                "scenario": key.scenario,
                "subset": key.subset,
                **self._labels,
            }
            self._file.setncatts(attributes | self._parameter_attributes())
            self._stack = stack.pop_all()
        return self

    def append(
        self, position: NDArray[np.float32], velocity: NDArray[np.float32]
    ) -> None:
        """Add the next frame.

        Args:
            position: particle positions [length], shape [particle, 2].
            velocity: particle velocities of the solver [length/s], shape [particle, 2].

        Raises:
            DataError: the arrays have the wrong shape or type, or all frames are
                written.
            WorkFailedError: the disk is full or not writable.
        """
        shape = (self._shape["particle"], len(AXES))
        for name, values in (("position", position), ("velocity", velocity)):
            if values.shape != shape:
                where = f"{self.path}, variable {name!r}"
                raise DataError(
                    "a frame has the wrong shape",
                    where=where,
                    expected=shape,
                    got=values.shape,
                )
            self._hasher.update(name, values)
            with _write_errors(self.path):
                self._file[name][self._written] = values
        self._written += 1

    def state(self, **parameters: object) -> None:
        """State further parameters, known only after the last frame; they are hashed
        like the others.
        """
        self._parameters |= _checked(parameters, self.path)
        self._hasher.identity = self.key.identity(
            str(self._labels["seed"]), self._parameters
        )
        with _write_errors(self.path):
            self._file.setncatts(self._parameter_attributes())

    def _parameter_attributes(self) -> dict[str, object]:
        return {
            **self._parameters,
            "hashed_parameters": " ".join(sorted(self._parameters)),
        }

    def state_facts(self, facts: Mapping[str, float]) -> None:
        """State what the scenario went through: finite numbers by name, which no hash
        covers.
        """
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
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            digests = self._hasher.digests()
            self.content_sha256 = self._hasher.hexdigest()
            for name, digest in digests.items():
                self._file[name].content_sha256 = digest
            self._file.content_sha256 = self.content_sha256

    def _create(self, name: str, dtype: np.dtype[Any], dims: tuple[str, ...]) -> None:
        shape = tuple(self._shape[dim] for dim in dims)
        if dtype.kind == "O":
            variable = self._file.createVariable(name, str, dims)
        else:
            moving = "particle" in dims and "frame" in dims
            chunks = (
                (1, min(shape[1], PARTICLES_PER_CHUNK), *shape[2:])
                if moving
                else shape or None
            )
            variable = self._file.createVariable(
                name,
                dtype,
                dims,
                compression="zlib" if dims else None,
                complevel=1,
                shuffle=True,
                chunksizes=chunks,
                endian="little",
                fill_value=False,
                chunk_cache=CHUNK_CACHE,
            )
        variable.setncatts(attributes_of(name, dims))
        self._hasher.declare(name, dtype, dims, shape)


def _checked(parameters: Mapping[str, object], path: Path) -> dict[str, object]:
    """Return parameters as plain values; refuse names that the format needs itself."""
    stored = {}
    for name, value in parameters.items():
        if name in _RESERVED or not name.isidentifier():
            expected = f"an identifier other than {', '.join(sorted(_RESERVED))}"
            raise DataError(
                f"a parameter cannot be named {name!r}",
                where=str(path),
                expected=expected,
            )
        stored[name] = plain(value)
        if stored[name] == "" or not isinstance(stored[name], (int, float, str)):
            raise DataError(
                f"the parameter {name!r} cannot be stored",
                where=str(path),
                expected="a finite number or a string that is not empty",
                got=repr(value),
            )
    return stored


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Turn what netCDF4 raises on a full or read-only disk into a lagbench error."""
    try:
        yield
    except LagbenchError:
        raise
    except (OSError, RuntimeError, UnicodeError) as error:  # a name that is no UTF-8
        if path.parent.is_dir():
            free = shutil.disk_usage(path.parent).free
        else:
            free = 0
        raise WorkFailedError(
            "cannot write a scenario file",
            where=str(path),
            got=f"{error}; {free:,} bytes free",
            fix="free disk space, or name a folder that you may write to: --root or "
            "LAGBENCH_ROOT",
        ) from error
