"""Open scenario files: header, arrays read when asked for, and their content hash.

Whatever is wrong with a file becomes a DataError that names it and, where one can be
told, the variable. h5py opens one in half the time that netCDF4 takes, and follows a
link only where it is asked to: nothing that leads out of the file is opened. What
netCDF would show of it stands at the end.

:data:`ATTRIBUTES` are the variables of a scenario file, and what their attributes must
say. They do not enter the content hash, yet readers compute with them: ``scale_factor``
or other ``units`` change what xarray returns although no stored value changed. So a
variable has exactly the attributes given here.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError, LagbenchError

from . import MATERIALS
from .checksums import ContentHasher, plain
from .layout import ScenarioKey, generation_of

if TYPE_CHECKING:
    import h5py


AXES = ("x", "y")

ATTRIBUTES: Mapping[str, Mapping[str, object]] = {
    "frame": {
        "long_name": "frame number; 0 is the state when recording starts",
        "units": "1",
    },
    "time": {"long_name": "time since frame 0", "units": "s"},
    "particle": {"long_name": "particle number", "units": "1"},
    "space": {"long_name": "axis of the unit box"},
    "wall": {"long_name": "wall of the box"},
    "position": {
        "long_name": "particle position in lengths of the unit box",
        "units": "1",
    },
    "velocity": {
        "long_name": "particle velocity of the solver in box lengths per second",
        "units": "s-1",
    },
    "material": {
        "long_name": "constitutive model",
        "flag_values": np.arange(len(MATERIALS), dtype=np.int8),
        "flag_meanings": " ".join(MATERIALS),
    },
    "particle_mass": {
        "long_name": "mass of one particle, density times area over particles",
        "units": "1",
    },
    "wall_velocity": {
        "long_name": "velocity of each wall in box lengths per second",
        "units": "s-1",
    },
}
"""Attributes of each variable beside ``coordinates`` and ``content_sha256``."""


def attributes_of(name: str, dims: Sequence[str]) -> dict[str, object]:
    """Return the attributes that a variable is written with."""
    # xarray makes a coordinate only of what the CF attribute `coordinates` names.
    if "frame" in dims and len(dims) > 1:
        extra = {"coordinates": "time"}
    else:
        extra = {}
    return {**ATTRIBUTES[name], **extra}


def _equal(wanted: object, found: object) -> bool:
    if isinstance(wanted, np.ndarray):
        return (
            isinstance(found, np.ndarray)
            and wanted.dtype == found.dtype
            and np.array_equal(wanted, found)
        )
    return isinstance(found, str) and wanted == found


HIDDEN = frozenset(
    (
        *("CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST"),
        *("_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties", "_nc3_strict"),
    )
)
"""Attributes by which netCDF stores dimensions; it shows them to nobody."""

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"

BLOCK_BYTES = 1 << 20
"""Files are streamed in pieces of about this size [bytes]."""

CHUNK_CACHE = 1 << 20
"""Chunk cache of a variable [bytes]; netCDF's default of 64 MB would keep whole
scenarios.
"""

DEFLATE_RATIO = 1032
"""No zlib stream unpacks to more than this many times its length."""

MOST_OF_FACTS = 4096
"""Characters of ``facts``, which no hash covers and the manifest repeats."""

_FACT = re.compile(r"[a-z][a-z0-9_]{0,63}")

MOST_IN_ROW = 20_000_000
"""Values of a variable in one frame, which is read at once: two for each of ten million
particles.
"""


@dataclass(frozen=True, kw_only=True)
class ScenarioHeader:
    """What a scenario file says about itself."""

    key: ScenarioKey  # what names the scenario
    seed: str  # how the random numbers were seeded
    # physical parameters by name, those that enter the content hash
    parameters: Mapping[str, object]
    content_sha256: str  # content hash as stored; see rehash for the true one
    frames: int  # recorded frames
    particles: int  # particles in every frame
    device: str  # device that simulated
    generator: str  # dotted path of the split's module
    lagbench_version: str  # version that wrote the file
    # what the simulation went through, by name; no hash covers it
    facts: Mapping[str, float]


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
        with _damage(path):
            self._variables = variables(file)
            _check_lengths(path, self._variables)
            self.header = _header(file, self._variables)

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
        """Return a variable, or some of its frames (entries along the first
        dimension).
        """
        with _damage(self.path, name):
            variable = self._variables[name]
            part = frames if variable.ndim else ()
            return np.asarray(
                variable.asstr()[part] if is_text(variable) else variable[part]
            )

    def blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield a variable in order, in pieces of at most about 1 MiB."""
        with _damage(self.path, name):
            shape = self._variables[name].shape
            item = np.dtype(np.float64).itemsize * int(
                np.prod(shape[1:], dtype=np.int64)
            )
        step = max(1, BLOCK_BYTES // max(1, item))
        if shape:
            starts = range(0, shape[0], step)
        else:
            starts = range(1)
        for start in starts:
            yield self.read(name, slice(start, start + step))

    def check_attributes(self) -> None:
        """Refuse attributes that make other readers read other values."""
        for name, variable in sorted(self._variables.items()):
            with _damage(self.path, name):
                found = attributes(variable)
                wanted = attributes_of(name, dimensions(variable, name))
            # The hash is checked elsewhere, and prose may be worded anew by a patch
            # release.
            names = (wanted.keys() | found.keys()) - {"content_sha256", "long_name"}
            unlike = sorted(n for n in names if not _equal(wanted.get(n), found.get(n)))
            if unlike:
                raise DataError(
                    "attributes of a variable are not those of the format",
                    where=f"{self.path}, variable {name!r}",
                    expected="those of docs/format.md",
                    got=", ".join(
                        f"{key} = {found.get(key, 'missing')}" for key in unlike
                    ),
                    fix=_repair(self.path),
                )

    def computed_hasher(self) -> ContentHasher:
        """Return a hasher that has read the whole file."""
        header = self.header
        hasher = ContentHasher(header.key.identity(header.seed, header.parameters))
        for name, variable in sorted(self._variables.items()):
            with _damage(self.path, name):
                if is_text(variable):
                    dtype = str
                else:
                    dtype = variable.dtype
                hasher.declare(name, dtype, dimensions(variable, name), variable.shape)
                for block in self.blocks(name):
                    hasher.update(name, block)
        return hasher


def read_scenario(path: Path) -> ScenarioFile:
    """Open a scenario file."""
    import h5py

    if not path.is_file():
        raise DataError(
            "a scenario file is missing", where=str(path), fix=_repair(path)
        )
    with _damage(path), ExitStack() as stack:
        file = h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE)
        stack.callback(file.close)
        opened = ScenarioFile(path, file)
        stack.pop_all()
    return opened


def rehash(path: Path) -> str:
    """Return the content hash computed from a file's values."""
    with read_scenario(path) as file:
        return file.computed_hasher().hexdigest()


def check_scenario(path: Path, expected: str | None = None) -> str:
    """Recompute a file's content hash, compare it, and check what is not hashed."""
    with read_scenario(path) as file:
        with _damage(path):
            digests = {
                name: attribute(held, "content_sha256")
                for name, held in file._variables.items()
            }
        hasher = file.computed_hasher()
        file.check_attributes()
    for name, digest in hasher.digests().items():
        if digests.get(name) != digest:
            where = f"{path}, variable {name!r}"
            raise _mismatch(
                path, "values differ from their hash", where, digests.get(name), digest
            )
    content = hasher.hexdigest()
    stored = file.header.content_sha256
    if content != stored:
        raise _mismatch(
            path,
            "attributes differ from their hash",
            f"{path}, attributes",
            stored,
            content,
        )
    if expected is not None and not content.startswith(expected):
        raise _mismatch(
            path, "the file has another content hash", str(path), expected, content
        )
    return content


def _mismatch(
    path: Path, what: str, where: str, expected: object, got: str
) -> DataError:
    return DataError(
        what,
        where=where,
        expected=expected or "a stored hash",
        got=got,
        fix=_repair(path),
    )


def _check_lengths(path: Path, variables: Mapping[str, h5py.Dataset]) -> None:
    """Refuse lengths that no file of this size can hold, before memory is asked for
    them.
    """
    import h5py

    largest = DEFLATE_RATIO * path.stat().st_size
    for name, variable in variables.items():
        if name not in ATTRIBUTES:
            raise damaged(path, "no scenario has that variable", name)
        if math.prod(variable.shape[1:]) > MOST_IN_ROW:
            raise damaged(
                path,
                f"more than {MOST_IN_ROW} values in a frame: shape {variable.shape}",
                name,
            )
        text = h5py.check_string_dtype(variable.dtype)
        # how long its values are, they say themselves
        free = text is not None and text.length is None
        held = variable.size * (1 if free else variable.dtype.itemsize)
        if held > largest:
            what = "a variable is larger than its file can hold"
            where = f"{path}, variable {name!r}"
            expected = f"at most {largest} bytes"
            got = f"shape {variable.shape}"
            raise DataError(
                what, where=where, expected=expected, got=got, fix=_repair(path)
            )


def _header(file: h5py.File, variables: Mapping[str, h5py.Dataset]) -> ScenarioHeader:
    def said(name: str) -> Any:  # noqa: ANN401 - a text or a number
        value = attribute(file, name)
        if value is None:
            raise DataError(f"the attribute {name!r} is missing")
        return value

    names = ("split", "size", "version", "subset")
    labels = ("seed", "content_sha256", "device", "generator", "lagbench_version")
    key = ScenarioKey(
        scenario=int(said("scenario")), **{name: str(said(name)) for name in names}
    )
    text = attribute(file, "facts")
    if len(str(text)) > MOST_OF_FACTS:
        raise DataError("the attribute 'facts' is too long")
    if text is None:
        stated = {}
    else:
        stated = json.loads(str(text))
    facts = {str(name): float(value) for name, value in stated.items()}
    if not all(
        _FACT.fullmatch(name) and math.isfinite(value) for name, value in facts.items()
    ):
        raise DataError(
            "the attribute 'facts' holds something else than finite numbers by name"
        )
    return ScenarioHeader(
        key=key,
        parameters={
            name: plain(said(name)) for name in str(said("hashed_parameters")).split()
        },
        frames=variables["frame"].shape[0],
        particles=variables["particle"].shape[0],
        facts=facts,
        **{name: str(said(name)) for name in labels},
    )


@contextmanager
def _damage(path: Path, variable: str | None = None) -> Iterator[None]:
    """Turn whatever HDF5 raises on damaged bytes into a DataError naming the place."""
    try:
        yield
    except LagbenchError as error:
        if str(path) in (error.where or ""):
            raise
        raise damaged(path, error.what, variable) from error
    except (
        Exception
    ) as error:  # no list of types holds: damage surfaces as nearly any of them
        raise damaged(path, f"{type(error).__name__}: {error}", variable) from error


def damaged(
    path: Path, got: str, variable: str | None = None, *, fix: str | None = None
) -> DataError:
    """Return the error that a file is damaged, or one of its variables."""
    if variable is None:
        where = str(path)
    else:
        where = f"{path}, variable {variable!r}"
    what = "a scenario file is damaged or not one of lagbench"
    return DataError(what, where=where, got=got, fix=fix or _repair(path))


def _repair(path: Path) -> str:
    command = generation_of(path) or "lagbench generate"
    return f"{command} writes it anew; a local split is made again by lagbench adopt or import"


# --- what netCDF sees in an HDF5 file -------------------------------------------------


def variables(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return the variables beside each other in a file; refuse links and what lies in
    other files.
    """
    from .hdf5 import INSIDE, layout_of, members_of

    members, count = members_of(file)
    if count > len(members):
        raise DataError(f"{count} members, of which {len(members)} are looked at")
    found = {}
    for name, kind in members.items():
        if kind.endswith("link"):
            raise DataError(f"{name!r} is a {kind}")
        if kind != "variable":
            continue
        variable = file[name]
        layout = layout_of(variable)
        if layout not in INSIDE:
            raise DataError(f"the values of {name!r} lie elsewhere: {layout}")
        scale = attribute(variable, "CLASS") == "DIMENSION_SCALE"
        if not (scale and str(attribute(variable, "NAME")).startswith(NO_VARIABLE)):
            found[name] = variable
    return found


def dimensions(variable: h5py.Dataset, name: str) -> tuple[str, ...]:
    """Return the names of a variable's dimensions; one that is a dimension itself has
    its own.
    """
    if attribute(variable, "CLASS") == "DIMENSION_SCALE":
        return (name,) if variable.ndim == 1 else ("",) * variable.ndim
    from .hdf5 import dims_of

    return dims_of(variable)


def is_text(variable: h5py.Dataset) -> bool:
    """Tell whether the values are texts, which single characters are not."""
    import h5py

    kind = h5py.check_string_dtype(variable.dtype)
    return kind is not None and kind.length != 1


def attributes(owner: h5py.HLObject) -> dict[str, object]:
    """Return all attributes by name."""
    return {name: attribute(owner, name) for name in owner.attrs if name not in HIDDEN}


def attribute(owner: h5py.HLObject, name: str) -> object:
    """Return a text or number, an array where there are several; None where there is
    none.
    """
    import h5py

    if not h5py.h5a.exists(owner.id, name.encode()):
        return None
    value = owner.attrs[name]
    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind in "SO" else np.empty(0, value.dtype)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(
        value, str
    ):  # damaged bytes of texts of no set length come as lone surrogates
        value = value.encode("utf-8", "surrogateescape")
    return (
        value.decode("utf-8", "replace").replace("\0", "")
        if isinstance(value, bytes)
        else value
    )
