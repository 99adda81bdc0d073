"""Open scenario files: header, arrays that are read when asked for, and content hash.

Any damage of a file becomes a DataError that names the file and, where possible, the
variable.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.errors import LIMIT_FIXES, DataError, LagbenchError, WorkFailedError

from .checksums import ContentHasher
from .hdf5 import (
    is_text,
    list_dimensions,
    list_variables,
    read_attribute,
    to_plain,
)
from .layout import ScenarioKey
from .variables import ATTRIBUTES, MAX_VALUES_PER_FRAME, require_known_material

BLOCK_BYTES = 1 << 20
"""Files are streamed in pieces of about this size [bytes]."""

CHUNK_CACHE = 1 << 20
"""Chunk cache of a variable [bytes]; netCDF's 64 MB would keep whole scenarios."""

REPAIR = (
    "lagbench generate writes it anew; a local split is made again by lagbench import"
)
"""What to do about a file that is missing or damaged."""

MOST_LETTERS = 80
"""Letters of a wrong attribute in a message."""

DECODED = ("units", "scale_factor", "add_offset", "_FillValue", "missing_value")
"""Attributes of a variable by which xarray changes the values that it returns."""


@dataclass(frozen=True, kw_only=True)
class ScenarioHeader:
    """What a scenario file says about itself."""

    key: ScenarioKey  # names of the scenario
    seed: str  # how the random numbers were seeded
    # physical parameters by name, those that enter the content hash
    parameters: Mapping[str, object]
    content_sha256: str  # content hash as stored; see rehash for the true one
    frames: int  # recorded frames
    particles: int  # particles in every frame
    device: str  # device that simulated
    generator: str  # dotted path of the split's module
    lagbench_version: str  # version that wrote the file
    # simulation diagnostics by name; no hash covers them
    facts: Mapping[str, float]

    @property
    def viscosity(self) -> float | None:
        """Kinematic viscosity that the file states [length^2/s]; None without one."""
        stated = self.parameters.get("viscosity")
        return parse_viscosity(stated, where=self._place)

    @property
    def friction(self) -> float | None:
        """Coulomb friction of the walls that the file states [1]; None without one."""
        stated = self.parameters.get("friction")
        return _parse_number(stated, "friction", where=self._place)

    @property
    def _place(self) -> str:
        """The scenario in words, for messages."""
        key = self.key
        return f"{key.split} {key.size}, scenario {key.scenario}"


def select_parameters(
    attributes: Mapping[str, object], *, where: str
) -> dict[str, object]:
    """Return those attributes of a file that its content hash covers, by name.

    Args:
        attributes: all attributes of the file.
        where: the file.

    Raises:
        DataError: a parameter is missing that the file names as hashed.
    """
    names = attributes.get("hashed_parameters", "")
    if isinstance(names, bytes):
        names = names.decode("utf-8", "replace")
    parameters = {}
    for name in str(names).split():
        if name not in attributes:
            raise DataError(
                "a parameter is missing: no such attribute; make the file again",
                where=f"{where}, attribute {name}",
            )
        parameters[name] = attributes[name]
    return parameters


def parse_viscosity(stated: object, *, where: str) -> float | None:
    """Return the kinematic viscosity in a file's attribute; None without one.

    Args:
        stated: the attribute ``viscosity``.
        where: the file.

    Raises:
        DataError: it is no finite number from 0.
    """
    return _parse_number(stated, "viscosity", where=where)


def _parse_number(stated: object, name: str, *, where: str) -> float | None:
    """Return a number from 0 that a file states; None without one."""
    if stated is None:
        return None
    values = np.asarray(stated)
    is_number = values.size == 1 and values.dtype.kind in "iuf"
    number = float(values.item()) if is_number else math.nan
    if not 0.0 <= number < math.inf:
        raise DataError(
            f"the {name} has an impossible value: got {str(stated)[:MOST_LETTERS]}, "
            "expected a finite number from 0; mend it, or make the file again",
            where=f"{where}, attribute {name}",
        )
    return number


class ScenarioFile:
    """An open scenario file: its header, and arrays that are read when asked for.

    Use it as a context manager. Every method raises DataError naming file and variable
    where the file is damaged.

    Attributes:
        path: path of the file.
        header: what the file says about itself.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self._file = file
        with _damage_errors(path):
            self._variables = list_variables(file)
            _check_lengths(path, self._variables)
            self.header = _read_header(file, self._variables)

    def __enter__(self) -> Self:
        """Return the file itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of all variables, sorted."""
        return tuple(sorted(self._variables))

    def read(self, name: str, frames: slice | int = slice(None)) -> NDArray[Any]:
        """Return the values of a variable, of all frames or of some.

        Args:
            name: name of the variable in the file.
            frames: entries along the first dimension; a variable without dimensions is
                read whole.

        Raises:
            DataError: the file is damaged.
        """
        with _damage_errors(self.path, name):
            variable = self._variables[name]
            selection = frames if variable.ndim else ()
            if is_text(variable):
                return np.asarray(variable.asstr()[selection])
            return np.asarray(variable[selection])

    def read_particle_mass(self) -> float:
        """Return the mass of one particle [mass].

        Raises:
            DataError: the file is damaged, or the mass is no finite number above 0.
        """
        values = self.read("particle_mass")
        is_number = values.size == 1 and values.dtype.kind in "iuf"
        mass = float(values.item()) if is_number else math.nan
        if not 0.0 < mass < math.inf:
            got = f"no finite number above 0: {values!r}"[:200]
            raise damage_error(self.path, got, "particle_mass")
        return mass

    def blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield a variable in order, in pieces of at most about 1 MiB.

        An entry of the first dimension that is longer is a piece of its own.
        """
        with _damage_errors(self.path, name):
            shape = self._variables[name].shape
        length = 1
        if shape:
            length = shape[0]
        # Any value takes at most 8 bytes.
        step = max(1, BLOCK_BYTES // max(1, 8 * math.prod(shape[1:])))
        for start in range(0, length, step):
            yield self.read(name, slice(start, start + step))

    def check_material(self) -> None:
        """Refuse numbers that stand for no material.

        Raises:
            DataError: there is such a number, or the file is damaged.
        """
        if "material" not in self._variables:
            return
        for block in self.blocks("material"):
            require_known_material(block, where=str(self.path), fix=REPAIR)

    def check_units(self) -> None:
        """Refuse attributes that make other readers see other values than are hashed.

        Raises:
            DataError: a unit is not that of the format, or values are packed.
        """
        for name, variable in self._variables.items():
            for key in DECODED:
                with _damage_errors(self.path, name):
                    value = str(read_attribute(variable, key))
                if value != str(ATTRIBUTES[name].get(key)):
                    raise DataError(
                        f"{key} is {value[:40]}, and no hash covers it; {REPAIR}",
                        where=f"{self.path}, variable {name!r}",
                    )

    def stored_hashes(self) -> dict[str, object]:
        """Return the hash of each variable as the file states it."""
        hashes = {}
        with _damage_errors(self.path):
            for name, variable in self._variables.items():
                hashes[name] = read_attribute(variable, "content_sha256")
        return hashes

    def computed_hasher(self) -> ContentHasher:
        """Return a hasher that has read the whole file."""
        header = self.header
        hasher = ContentHasher(header.key.identity(header.seed, header.parameters))
        for name, variable in sorted(self._variables.items()):
            with _damage_errors(self.path, name):
                dtype = str if is_text(variable) else variable.dtype
                dims = list_dimensions(variable, name)
                hasher.declare(name, dtype, dims, variable.shape)
                for block in self.blocks(name):
                    hasher.update(name, block)
        return hasher


def read_scenario(path: Path) -> ScenarioFile:
    """Open a scenario file.

    Raises:
        DataError: the file is missing, damaged, or no scenario, or it may not be read.
    """
    if not path.is_file():
        raise DataError(f"a scenario file is missing; {REPAIR}", where=str(path))
    with _damage_errors(path), ExitStack() as stack:
        file = h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE)
        stack.callback(file.close)
        scenario = ScenarioFile(path, file)
        stack.pop_all()
    return scenario


def rehash(path: Path) -> str:
    """Return the content hash computed from a file's values."""
    with read_scenario(path) as file:
        return file.computed_hasher().hexdigest()


def check_scenario(path: Path, expected: str | None = None) -> str:
    """Recompute a file's content hash, compare it, and check materials and units.

    Args:
        path: the scenario file.
        expected: content hash, or its first digits; that in the file when None.

    Returns:
        The content hash.

    Raises:
        DataError: a hash differs, a material is unknown, or a unit is not that of the
            format.
    """
    with read_scenario(path) as file:
        stored_hashes = file.stored_hashes()
        hasher = file.computed_hasher()
        content_hash = hasher.hexdigest()
        comparisons: list[tuple[str, str, object, str]] = []
        for name, variable_hash in hasher.digests().items():
            where = f"{path}, variable {name!r}"
            stored = stored_hashes.get(name)
            comparisons.append(("values", where, stored, variable_hash))
        stored = file.header.content_sha256
        comparisons.append(("attributes", f"{path}, attributes", stored, content_hash))
        if expected is not None:
            digits = content_hash[: len(expected)]
            comparisons.append(("values or attributes", str(path), expected, digits))
        for what, where, known_hash, computed_hash in comparisons:
            if known_hash != computed_hash:
                raise DataError(
                    f"{what} differ from their hash: got {computed_hash}, expected "
                    f"{str(known_hash or 'a stored hash')[:MOST_LETTERS]}; {REPAIR}",
                    where=where,
                )
        file.check_material()
        file.check_units()
    return content_hash


def _check_lengths(path: Path, variables: Mapping[str, h5py.Dataset]) -> None:
    """Refuse other variables than a scenario has, and too long frames."""
    for name, variable in variables.items():
        if name not in ATTRIBUTES:
            raise damage_error(path, "no scenario has that variable", name)
        shape = variable.shape
        if math.prod(shape[1:]) > MAX_VALUES_PER_FRAME:
            message = (
                f"more than {MAX_VALUES_PER_FRAME} values in a frame: shape {shape}"
            )
            raise damage_error(path, message, name)


def _read_header(
    file: h5py.File, variables: Mapping[str, h5py.Dataset]
) -> ScenarioHeader:
    key = ScenarioKey(
        split=_require_text(file, "split"),
        size=_require_text(file, "size"),
        version=_require_text(file, "version"),
        scenario=_require_integer(file, "scenario"),
        subset=_require_text(file, "subset"),
    )
    parameters = {}
    for name in _require_text(file, "hashed_parameters").split():
        parameters[name] = to_plain(_require_attribute(file, name))
    return ScenarioHeader(
        key=key,
        seed=_require_text(file, "seed"),
        parameters=parameters,
        content_sha256=_require_text(file, "content_sha256"),
        frames=variables["frame"].shape[0],
        particles=variables["particle"].shape[0],
        device=_require_text(file, "device"),
        generator=_require_text(file, "generator"),
        lagbench_version=_require_text(file, "lagbench_version"),
        facts=_read_facts(file),
    )


def _require_attribute(file: h5py.File, name: str) -> Any:  # noqa: ANN401 (text or number)
    value = read_attribute(file, name)
    if value is None:
        raise DataError(f"the attribute {name!r} is missing")
    return value


def _require_integer(file: h5py.File, name: str) -> int:
    value = _require_attribute(file, name)
    if not isinstance(value, int | np.integer):
        raise DataError(f"the attribute {name!r} is {value!a}, and no integer")
    return int(value)


def _require_text(file: h5py.File, name: str) -> str:
    return str(_require_attribute(file, name))


def _read_facts(file: h5py.File) -> dict[str, float]:
    """Return the simulation diagnostics of a file: numbers by name."""
    facts = json.loads(str(read_attribute(file, "facts") or "{}"))
    for name, value in facts.items():
        if not (name.isidentifier() and name.isascii() and math.isfinite(value)):
            raise DataError("the attribute 'facts' is no table of finite numbers")
    return dict(facts)


@contextmanager
def _damage_errors(path: Path, variable: str | None = None) -> Iterator[None]:
    """Turn whatever HDF5 raises on damaged bytes into a DataError naming the place."""
    try:
        yield
    except LagbenchError as error:
        if str(path) in (error.where or ""):
            raise
        raise damage_error(path, error.text, variable) from error
    except Exception as error:
        raise reading_error(path, error, variable) from error


def reading_error(
    path: Path,
    error: Exception,
    variable: str | None = None,
    *,
    fix: str = REPAIR,
) -> LagbenchError:
    """Return our error for one that a library raised on reading a scenario file.

    Damage surfaces as nearly any type. A system that opens no more files is no damage.
    """
    limits = (errno.EMFILE, errno.ENFILE)
    if isinstance(error, OSError) and error.errno in limits:
        return WorkFailedError(
            f"the system opens no more files: {os.strerror(error.errno)}; "
            f"{LIMIT_FIXES[error.errno]}; or open fewer data sets at a time",
            where=str(path),
        )
    got = f"{type(error).__name__}: {error}"
    return damage_error(path, got, variable, fix=fix)


def damage_error(
    path: Path, got: str, variable: str | None = None, *, fix: str = REPAIR
) -> DataError:
    """Return the error that a file, or one of its variables, is damaged.

    A file that vanished while it was read is not called damaged.
    """
    if not path.exists():
        return DataError(f"a scenario file is missing; {fix}", where=str(path))
    where = str(path)
    if variable is not None:
        where = f"{path}, variable {variable!r}"
    return DataError(
        f"a scenario file is damaged or not one of lagbench: {got}; {fix}", where=where
    )
