"""What the names of a dataset mean: a trajectory of particles at even times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lagbench.data import PARTICLE_KINDS, WALL
from lagbench.errors import DataError, UnreadableFileError, UsageError

from .readers import IDS, STEPS, TIMES, reading

DIMENSIONS = {
    "time": ("time", "frame", "step", "t"),
    "particle": ("particle", "particles", "atom", "point", "id"),
    "space": ("space", "axis", "component", "dim", "xyz"),
}
"""Dimensions, and the names that files have for them."""

NAMES = {
    "position": ("position", "positions", "pos"),
    "velocity": ("velocity", "velocities", "vel"),
    "id": IDS,
    "kind": ("material", "particle_type", "type", "types", "kind"),
    "time": (*TIMES, *STEPS),
    "interval": ("dt", "frame_interval"),
    "walls": ("wall_velocity",),
}
"""Variables, and the names that files have for them, in the order of preference."""

COMPONENTS = {
    "position": (
        "{}",
        "position_{}",
        "position {}",
        "pos_{}",
        "points:{}",
        "points_{}",
    ),
    "velocity": ("v{}", "velocity_{}", "vel_{}", "velocity:{}"),
}
"""Names of the components of vectors, with x or, as ParaView has them, 0."""

SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "second": 1.0, "ms": 1e-3, "us": 1e-6}
SECONDS |= {"ns": 1e-9, "ps": 1e-12, "min": 60.0, "minutes": 60.0, "h": 3600.0}
SECONDS |= {"hours": 3600.0, "d": 86400.0, "days": 86400.0, "1": 1.0, "": 1.0}
"""Seconds in a unit of time."""

UNEVEN = 0.01
"""Difference of two intervals that counts as one [interval]."""

DROP = "drop"
"""Stands for the material of particles that are left out."""

BLOCK = 1 << 26
"""Bytes of frames that are read at once."""

OWN_NAMES = ("frame", "time", "particle", "space", "wall", "particle_mass")
"""Names of our own files that say nothing new."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A trajectory whose frames are read when asked for."""

    name: str  # file, and the trajectory in it
    close: Callable[[], None]  # closes the file
    dataset: xr.Dataset  # position, perhaps velocity and id, [time, particle, ...]
    material: NDArray[np.int8]  # of each particle that is kept, [particle]
    is_kept: NDArray[np.bool_]  # of all particles, in the order of their ids
    interval: float | None  # time between two frames [s]
    interval_name: str  # variable or attribute that states it; empty without
    # [length/s], [wall, axis] or [frame, wall, axis]; None without walls
    wall_velocity: NDArray[np.float64] | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)  # options by name
    states_kinds: bool = False  # whether the file says which materials there are
    axes: tuple[int, ...] = ()  # components of the file that are kept
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Recorded frames."""
        return int(self.dataset.sizes["time"])

    def read(
        self,
    ) -> Iterator[tuple[NDArray[np.floating], NDArray[np.floating] | None]]:
        """Yield positions and velocities of the frames, [particle, space].

        Raises:
            DataError: a frame has other particles than the first one.
        """
        position = self.dataset["position"]
        length = max(1, BLOCK // max(1, position.nbytes // self.frames))
        first_ids = None
        for start in range(0, self.frames, length):
            with reading(self.name):
                block = self.dataset.isel(time=slice(start, start + length)).load()
            for row in range(block.sizes["time"]):
                order: Any = slice(None)
                frame = block.isel(time=row)
                if "id" in frame:
                    ids = frame["id"].values
                    order = np.argsort(ids, kind="stable")
                    first_ids = ids[order] if first_ids is None else first_ids
                    self._check_ids(ids[order], first_ids, start + row)
                velocity = None
                if "velocity" in frame:
                    velocity = frame["velocity"].values[order][self.is_kept]
                yield frame["position"].values[order][self.is_kept], velocity

    def _check_ids(
        self, ids: NDArray[Any], first_ids: NDArray[Any], frame: int
    ) -> None:
        if np.array_equal(ids, first_ids):
            if frame == 0 and (ids[1:] == ids[:-1]).any():
                double = ids[1:][ids[1:] == ids[:-1]][0]
                raise DataError(
                    f"{self.name}, frame 0: two particles have the id {double}; give "
                    "each particle its own, or leave ids out"
                )
            return
        new = np.setdiff1d(ids, first_ids)
        gone = np.setdiff1d(first_ids, ids)
        raise DataError(
            f"{self.name}, frame {frame}: {len(gone)} particles of frame 0 are gone "
            f"(ids {gone[:3].tolist()}) and {len(new)} are new: particles enter or "
            "leave, which no model or score of lagbench knows; cut the trajectory "
            "there, or keep the particles that are in all frames"
        )


def name_trajectory(
    dataset: xr.Dataset, name: str, kinds: Mapping[str, str]
) -> Trajectory:
    """Return the trajectory of a dataset, by the names of its dimensions and variables.

    Args:
        dataset: positions [time, particle, space] and what else is known.
        name: file and number of the trajectory, for messages.
        kinds: material, or "drop", of each kind that the user names.

    Raises:
        UnreadableFileError: there are no positions.
        DataError: times are uneven, a component has an unknown name, or the kind of a
            particle is missing.
        UsageError: a kind has no known material.
    """
    close = dataset.close
    dataset = _name_dimensions(dataset, name)
    variables = {}
    for purpose, words in NAMES.items():
        found = _find(dataset, words)
        if found is not None:
            variables[purpose] = found
    for purpose in ("id", "kind"):
        array = dataset[variables[purpose]] if purpose in variables else None
        if array is not None and set(array.dims) - {"time"} != {"particle"}:
            shape = dataset[variables["position"]].shape
            raise UsageError(
                f"{name}: {array.name} has the shape {array.shape} and positions, by "
                f"frame, particle and space, {shape}; give one for each particle, or "
                "state the order of the axes, as in --axes particle,frame,space"
            )
    if "id" in variables and dataset[variables["id"]].dims == ("particle",):
        ids = dataset[variables["id"]].values
        if len(np.unique(ids)) < len(ids):
            raise DataError(f"{name}: two particles have one id; give each its own")
        if (np.diff(ids) < 0).any():
            dataset = dataset.isel(particle=np.argsort(ids))
    position = dataset[variables["position"]]
    if position.dtype.kind not in "fiu":
        raise UnreadableFileError(f"{name}: positions are {position.dtype}, no numbers")
    if position.sizes["time"] < 2 or position.sizes["particle"] < 1:
        raise DataError(
            f"{name} has {position.sizes['time']} frames of "
            f"{position.sizes['particle']} particles; a trajectory has two or more, "
            "which a column time tells apart in a table"
        )
    arrays = {"position": position.astype(np.result_type(position.dtype, np.float32))}
    dims = ("time", "particle", "space")
    notes = _note_units(position, name)
    if "velocity" in variables:
        velocity = dataset[variables["velocity"]]
        if set(velocity.dims) != set(dims):
            raise DataError(
                f"{name}: velocities have the shape {velocity.shape}, positions "
                f"{position.shape}; save both alike, or leave velocities out"
            )
        arrays["velocity"] = velocity
    if "id" in variables and "time" in dataset[variables["id"]].dims:
        arrays["id"] = dataset[variables["id"]]
    ordered = {}
    for key, array in arrays.items():
        wanted = [dim for dim in dims if dim in array.dims]
        ordered[key] = array.transpose(*wanted).drop_vars(array.coords)
    kept = xr.Dataset(ordered)
    space = _order_components(dataset, name)
    if space is not None:
        kept = kept.isel(space=space)

    material, is_kept, kind_note = _find_materials(
        dataset, variables.get("kind"), arrays.get("id"), kinds, name
    )
    known = {*variables.values(), *OWN_NAMES, *DIMENSIONS, "boundary_particles"}
    unused = [str(one) for one in dataset.variables if one not in known]
    if unused:
        notes.append(f"{name}: not used are {', '.join(unused)}")
    if dataset.attrs.get("boundary_particles"):
        count = dataset.attrs["boundary_particles"]
        notes.append(f"{name}: {count} particles of the boundary are left out")
    walls = None
    if "walls" in variables:
        walls = dataset[variables["walls"]].values.astype(np.float64)
    stated = {}
    for key in ("bounds", "periodic"):
        if key in dataset.attrs:
            stated[key] = dataset.attrs[key]
    if isinstance(stated.get("periodic"), str):
        stated["periodic"] = stated["periodic"].split()
    interval, interval_name = _find_interval(dataset, variables, name)
    return Trajectory(
        name=name,
        close=close,
        dataset=kept,
        material=material,
        is_kept=is_kept,
        interval=interval,
        interval_name=interval_name,
        wall_velocity=walls,
        states_kinds="kind" in variables,
        stated=stated,
        notes=(*notes, *kind_note),
    )


def _find(dataset: xr.Dataset, words: Sequence[str]) -> str | None:
    """Return the variable, or coordinate, that has one of some names."""
    by_name = {str(name).lower(): str(name) for name in dataset.variables}
    for word in words:
        if word in by_name:
            return by_name[word]
    return None


def _name_dimensions(dataset: xr.Dataset, name: str) -> xr.Dataset:
    """Return a dataset whose positions have the dimensions time, particle, space."""
    for vector, patterns in COMPONENTS.items():
        for pattern in patterns:
            components: list[str] = []
            for axes in ("xyz", "012"):
                words = [pattern.format(axis) for axis in axes]
                components += filter(None, [_find(dataset, [word]) for word in words])
            if len(components) > 1 and _find(dataset, NAMES[vector]) is None:
                joined = xr.concat([dataset[one] for one in components], dim="space")
                dataset = dataset.drop_vars(components).assign({vector: joined})
    found = _find(dataset, NAMES["position"])
    if found is None:
        names = ", ".join(map(str, dataset.variables))
        raise UnreadableFileError(
            f"{name} has no positions, but {names or 'nothing'}; name them position, "
            "or x, y and z, or say which they are: --positions NAME"
        )
    changed = {}
    missing = []
    for wanted, known in DIMENSIONS.items():
        dims = {str(dim).lower(): str(dim) for dim in dataset[found].dims}
        matches = [dims[word] for word in known if word in dims]
        if not matches:
            missing.append(wanted)
        elif matches[0] != wanted:
            changed[matches[0]] = wanted
    if missing or dataset[found].ndim != len(DIMENSIONS):
        raise UsageError(
            f"{name}: positions have the dimensions {dataset[found].dims}; name them "
            "time, particle and space, or state their order, as in "
            "--axes frame,particle,space"
        )
    taken = [new for new in changed.values() if new in dataset.variables]
    renamed = {new: f"{new}_of_file" for new in taken}
    names_of = {f"{new}_of_file": new for new in taken}
    dataset = dataset.rename_vars(renamed).rename_dims(changed)
    dataset = dataset.rename_vars(names_of)
    if dataset[found].sizes["space"] not in (2, 3):
        raise DataError(
            f"{name}: positions have {dataset[found].sizes['space']} components, of "
            f"shape {dataset[found].shape}; they have two or three: state the order of "
            "the axes, as in --axes frame,space,particle"
        )
    return dataset


def _order_components(dataset: xr.Dataset, name: str) -> list[int] | None:
    """Return the places of x, y, z among the components; None where none are named."""
    if "space" not in dataset.coords or dataset["space"].dtype.kind not in "OUST":
        return None
    words = [str(word).lower() for word in dataset["space"].values]
    if sorted(words) != list("xyz"[: len(words)]):
        raise DataError(
            f"{name}: the components of positions are named {', '.join(words)}; name "
            "them x, y and, in three dimensions, z"
        )
    return [words.index(axis) for axis in "xyz"[: len(words)]]


def _note_units(position: xr.DataArray, name: str) -> list[str]:
    unit = str(position.attrs.get("units", "m"))
    if unit in ("m", "1", "length"):
        return []
    return [f"{name}: positions are in {unit}, so radius, bounds and spacing are too"]


def _find_interval(
    dataset: xr.Dataset, variables: Mapping[str, str], name: str
) -> tuple[float | None, str]:
    """Return the time between two frames [s] and the name of what says it.

    None where no variable says it. Whole numbers without a unit, and variables that are
    named so, are numbers of steps: they must be even.
    """
    interval = None
    source = ""
    for word in NAMES["interval"]:
        if word in dataset.attrs:
            interval = float(dataset.attrs[word])
            source = word
    if "interval" in variables and dataset[variables["interval"]].size == 1:
        source = variables["interval"]
        interval = float(dataset[source])
    if "time" not in variables or dataset[variables["time"]].dims != ("time",):
        return interval, source
    time = dataset[variables["time"]]
    values = time.values
    if values.dtype.kind in "mM":
        values = (values - values[0]) / np.timedelta64(1, "s")
    unit = str(time.attrs.get("units", "")).split(" since ")[0]
    if unit not in SECONDS:
        raise DataError(
            f"{name}: times are in {unit!r}; give them in a unit of "
            f"{', '.join(filter(None, SECONDS))}, or without a unit"
        )
    times = values.astype(np.float64) * SECONDS[unit]
    steps = np.diff(times)
    usual = float(np.median(steps))
    tolerance = UNEVEN * usual + 4.0 * float(np.spacing(np.abs(values).max()))
    is_odd = ~(np.abs(steps - usual) <= tolerance) | (steps <= 0.0)
    if is_odd.any():
        frame = int(np.argmax(is_odd))
        raise DataError(
            f"{name}, frame {frame + 1}: its time is {times[frame + 1]:.6g}, "
            f"{steps[frame]:.4g} after the frame before; steps in the file are "
            f"{steps.min():.4g} to {steps.max():.4g}: give frames in order, at even "
            "times"
        )
    if variables["time"].lower() in STEPS or (time.dtype.kind in "iu" and not unit):
        return interval, source
    if interval is not None and abs(interval - usual) > UNEVEN * usual:
        raise DataError(
            f"{name}: dt is {interval:.6g} and the times are {usual:.6g} apart; "
            "correct one of them"
        )
    return usual, variables["time"]


def _find_materials(
    dataset: xr.Dataset,
    variable: str | None,
    ids: xr.DataArray | None,
    kinds: Mapping[str, str],
    name: str,
) -> tuple[NDArray[np.int8], NDArray[np.bool_], list[str]]:
    """Return the material of each particle that is kept, and a mask over all."""
    count = dataset.sizes["particle"]
    if variable is None:
        if kinds:
            raise UsageError(
                f"{name} has no array of kinds; leave --kinds out, or name the array "
                f"{', '.join(NAMES['kind'])}"
            )
        return np.zeros(count, np.int8), np.ones(count, bool), []
    array = dataset[variable]
    values = array.transpose(..., "particle").values
    if values.ndim == 2:
        if ids is not None:
            order = np.argsort(ids.values, axis=1, kind="stable")
            values = np.take_along_axis(values, order, axis=1)
        if (values != values[:1]).any():
            frame, particle = np.argwhere(values != values[:1])[0]
            raise DataError(
                f"{name}, frame {frame}: {variable} of particle {particle} changes "
                f"from {values[0, particle]} to {values[frame, particle]}; a particle "
                "keeps its material"
            )
        values = values[0]
    if values.dtype.kind == "f":
        if np.isnan(values).any():
            particle = int(np.argmax(np.isnan(values)))
            raise DataError(
                f"{name}: {variable} of particle {particle} is missing, as of "
                f"{np.isnan(values).sum()} of {count}; give each particle a material"
            )
        if (values == np.rint(values)).all():
            values = values.astype(int)

    materials = {
        str(kind): word for kind, word in dataset.attrs.get("kinds", {}).items()
    }
    materials |= {material: material for material in PARTICLE_KINDS}
    if variable.lower() == "material":
        for number, material in enumerate(PARTICLE_KINDS):
            materials.setdefault(str(number), material)
    if "kinds" in dataset.attrs:
        materials["-1"] = DROP  # padding
    materials |= kinds
    codes = np.empty(count, np.int8)
    for value in np.unique(values):
        word = materials.get(str(value))
        if word is None:
            every = ", ".join(map(str, np.unique(values)[:10]))
            raise UsageError(
                f"{name}: {variable} has the kinds {every}, and no material is known "
                f"for {value}; state it, as in --kinds {value}={PARTICLE_KINDS[0]}, or "
                f"{value}={PARTICLE_KINDS[WALL]} for a fixed wall, or leave these "
                f"particles out: --kinds {value}={DROP}"
            )
        code = -1 if word == DROP else PARTICLE_KINDS.index(word)
        codes[values == value] = code
    is_kept = codes >= 0
    if not is_kept.any():
        raise UsageError(f"{name}: --kinds leaves out all particles; keep some")
    notes = []
    if not is_kept.all():
        notes.append(f"{name}: {np.count_nonzero(~is_kept)} particles are left out")
    return codes[is_kept], is_kept, notes


def parse_kinds(kinds: Mapping[Any, str] | str | None) -> dict[str, str]:
    """Return the material, or "drop", of each kind, as ``--kinds`` has them.

    >>> parse_kinds("3=jelly,0=drop")
    {'3': 'jelly', '0': 'drop'}

    Raises:
        UsageError: the text has another form, or names no material.
    """
    if isinstance(kinds, str):
        pairs = [part.partition("=")[::2] for part in kinds.split(",")]
        kinds = {kind.strip(): word.strip() for kind, word in pairs}
    checked = {}
    for kind, word in (kinds or {}).items():
        if word not in (*PARTICLE_KINDS, DROP):
            raise UsageError(
                f"--kinds: {word!r} is no material; write KIND=MATERIAL, as in "
                f"3=jelly,0=drop, where materials are {', '.join(PARTICLE_KINDS)}"
            )
        checked[str(kind)] = word
    return checked
