"""Mutations of files: bytes, places in the file system, YAML and HDF5.

Every mutation changes a valid file in place. What it changes follows from the random
generator that it is given.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[Any]

Plain = Any
"""A value of YAML or JSON, or a key of one."""

Mutation = Callable[[Path, np.random.Generator], None]

HUGE_BYTES = 3 << 30
"""Length of a sparse file [bytes]."""

WRONG_VALUES: tuple[Any, ...] = (
    None,
    float("nan"),
    float("inf"),
    -1,
    0,
    10**40,
    1e300,
    "",
    "nan",
    "../../outside",
    "\u202egnp.exe",
    "a\x00b",
    "x" * 100_000,
    [],
    {},
    [[[[[[[[]]]]]]]],
    True,
)
"""Values of other types, signs and sizes than a record holds."""


# --- bytes ----------------------------------------------------------------------------


def flip_a_byte(path: Path, rng: np.random.Generator) -> None:
    """Change one byte."""
    content = bytearray(path.read_bytes())
    content[rng.integers(len(content))] ^= int(rng.integers(1, 256))
    path.write_bytes(content)


def flip_many_bytes(path: Path, rng: np.random.Generator) -> None:
    """Change a byte of two hundred."""
    content = bytearray(path.read_bytes())
    for _ in range(1 + len(content) // 200):
        content[rng.integers(len(content))] = int(rng.integers(256))
    path.write_bytes(content)


def truncate(path: Path, rng: np.random.Generator) -> None:
    """Keep the first bytes."""
    content = path.read_bytes()
    path.write_bytes(content[: rng.integers(len(content))])


def zero_a_block(path: Path, rng: np.random.Generator) -> None:
    """Overwrite a tenth of the bytes by zeros."""
    content = bytearray(path.read_bytes())
    length = 1 + len(content) // 10
    start = int(rng.integers(len(content) - length + 1))
    content[start : start + length] = bytes(length)
    path.write_bytes(content)


def insert_bytes(path: Path, rng: np.random.Generator) -> None:
    """Insert random bytes."""
    content = path.read_bytes()
    place = int(rng.integers(len(content)))
    path.write_bytes(content[:place] + rng.bytes(64) + content[place:])


def repeat(path: Path, rng: np.random.Generator) -> None:
    """Write the content twice."""
    path.write_bytes(path.read_bytes() * 2)


def empty(path: Path, rng: np.random.Generator) -> None:
    """Keep nothing."""
    path.write_bytes(b"")


def make_huge(path: Path, rng: np.random.Generator) -> None:
    """Add zeros until the file has three gigabytes, without using disk."""
    os.truncate(path, HUGE_BYTES)


BYTES: tuple[Mutation, ...] = (
    flip_a_byte,
    flip_many_bytes,
    truncate,
    zero_a_block,
    insert_bytes,
    repeat,
    empty,
    make_huge,
)


# --- places ---------------------------------------------------------------------------


def link_outside(path: Path, rng: np.random.Generator) -> None:
    """Be a link to a file that does not belong there."""
    path.unlink()
    path.symlink_to("/etc/passwd")


def link_to_nothing(path: Path, rng: np.random.Generator) -> None:
    """Be a link to a file that does not exist."""
    path.unlink()
    path.symlink_to("nothing")


def link_to_itself(path: Path, rng: np.random.Generator) -> None:
    """Be a link to itself."""
    path.unlink()
    path.symlink_to(path.name)


def be_a_folder(path: Path, rng: np.random.Generator) -> None:
    """Be a folder with a file."""
    path.unlink()
    path.mkdir()
    (path / "file").write_text("text")


def be_a_pipe(path: Path, rng: np.random.Generator) -> None:
    """Be a pipe that nobody writes to."""
    path.unlink()
    os.mkfifo(path)


def be_a_device(path: Path, rng: np.random.Generator) -> None:
    """Be a link to a device that never ends."""
    path.unlink()
    path.symlink_to("/dev/zero")


def be_missing(path: Path, rng: np.random.Generator) -> None:
    """Be gone."""
    path.unlink()


def forbid_reading(path: Path, rng: np.random.Generator) -> None:
    """Have no permissions; root may read it all the same."""
    path.chmod(0)


PLACES: tuple[Mutation, ...] = (
    link_outside,
    link_to_nothing,
    link_to_itself,
    be_a_folder,
    be_a_pipe,
    be_a_device,
    be_missing,
    forbid_reading,
)


def copy_tree(source: Path, target: Path) -> None:
    """Copy a folder or a file; links stay links."""
    if source.is_dir():
        shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target)


def allow_removal(folder: Path) -> None:
    """Give permissions back, so that a folder can be removed."""
    for path in folder.rglob("*"):
        if not path.is_symlink() and stat.S_IMODE(path.lstat().st_mode) == 0:
            path.chmod(0o600)


# --- YAML and JSON --------------------------------------------------------------------


def _leaves(value: Plain, place: tuple[Plain, ...] = ()) -> list[tuple[Plain, ...]]:
    """Return the places of all values below a value, of mappings and lists too."""
    places = []
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, list):
        items = list(enumerate(value))
    else:
        items = []
    for key, item in items:
        places.append((*place, key))
        places.extend(_leaves(item, (*place, key)))
    return places


def _holder(content: Plain, place: tuple[Plain, ...]) -> Plain:
    """Return the mapping or list that holds the value at a place."""
    for key in place[:-1]:
        content = content[key]
    return content


def _edit_yaml(
    path: Path, rng: np.random.Generator, edit: Callable[[Plain, Any], None]
) -> None:
    """Change the value at a random place."""
    content = yaml.safe_load(path.read_text())
    places = _leaves(content)
    place = places[rng.integers(len(places))]
    edit(_holder(content, place), place[-1])
    if path.suffix == ".json":
        text = json.dumps(content, ensure_ascii=False, default=str)
    else:
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    path.write_text(text)


def remove_a_key(path: Path, rng: np.random.Generator) -> None:
    """Remove a key or an item."""

    def edit(holder: Plain, key: Plain) -> None:
        del holder[key]

    _edit_yaml(path, rng, edit)


def wrong_value(path: Path, rng: np.random.Generator) -> None:
    """Give a key a value of another type, sign or size."""
    value = WRONG_VALUES[rng.integers(len(WRONG_VALUES))]

    def edit(holder: Plain, key: Plain) -> None:
        holder[key] = value

    _edit_yaml(path, rng, edit)


def unknown_key(path: Path, rng: np.random.Generator) -> None:
    """Add a key that nobody knows beside a random one."""

    def edit(holder: Plain, key: Plain) -> None:
        if isinstance(holder, dict):
            holder["../\u202eunknown"] = 1
        else:
            holder.append({"unknown": 1})

    _edit_yaml(path, rng, edit)


def repeat_an_item(path: Path, rng: np.random.Generator) -> None:
    """Repeat an item of a list, or nest a mapping in itself."""

    def edit(holder: Plain, key: Plain) -> None:
        if isinstance(holder, list):
            holder.append(holder[key])
        else:
            holder[key] = dict(holder)

    _edit_yaml(path, rng, edit)


def rename_a_key(path: Path, rng: np.random.Generator) -> None:
    """Give a value the name of a path outside."""

    def edit(holder: Plain, key: Plain) -> None:
        if isinstance(holder, dict):
            holder["submissions/../../outside.yaml"] = holder.pop(key)
        else:
            holder[key] = "submissions/../../outside.yaml"

    _edit_yaml(path, rng, edit)


def duplicate_the_first_key(path: Path, rng: np.random.Generator) -> None:
    """Write the first line of the file once more at its end."""
    text = path.read_text()
    first = text.split("\n", 1)[0]
    path.write_text(f"{text.rstrip()}\n{first}\n")


def alias_bomb(path: Path, rng: np.random.Generator) -> None:
    """Be a small text that grows to gigabytes."""
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for before, name in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]")
    path.write_text("\n".join(lines) + "\n")


def python_object(path: Path, rng: np.random.Generator) -> None:
    """Ask the reader to call a function."""
    path.write_text("!!python/object/apply:os.mkdir ['hostile-yaml-ran']\n")


def deep_nesting(path: Path, rng: np.random.Generator) -> None:
    """Nest lists deeper than a stack."""
    path.write_text("[" * 50_000)


YAML: tuple[Mutation, ...] = (
    remove_a_key,
    wrong_value,
    wrong_value,
    unknown_key,
    repeat_an_item,
    rename_a_key,
    duplicate_the_first_key,
    alias_bomb,
    python_object,
    deep_nesting,
)


# --- predictions ----------------------------------------------------------------------


def _change_positions(
    path: Path, rng: np.random.Generator, change: Callable[[Array], Array]
) -> None:
    """Write changed positions in the place of the old ones."""
    with h5py.File(path, "r+") as file:
        file["position"][...] = change(file["position"][...])


def nan_positions(path: Path, rng: np.random.Generator) -> None:
    """Make one position not a number."""
    index = tuple(rng.integers(_shape(path)))

    def change(position: Array) -> Array:
        position[index] = np.nan
        return position

    _change_positions(path, rng, change)


def infinite_positions(path: Path, rng: np.random.Generator) -> None:
    """Send one particle to infinity."""
    index = tuple(rng.integers(_shape(path)))

    def change(position: Array) -> Array:
        position[index] = np.inf
        return position

    _change_positions(path, rng, change)


def huge_positions(path: Path, rng: np.random.Generator) -> None:
    """Send the particles of a frame far away."""
    scenario, frame = rng.integers(_shape(path)[:2])

    def change(position: Array) -> Array:
        position[scenario, frame] *= 1e30
        return position

    _change_positions(path, rng, change)


def negative_positions(path: Path, rng: np.random.Generator) -> None:
    """Mirror all positions at the origin."""
    _change_positions(path, rng, np.negative)


def other_motion(path: Path, rng: np.random.Generator) -> None:
    """Move every particle a little, differently in every frame."""
    noise = 1e-3 * rng.standard_normal(_shape(path)).astype(np.float32)
    _change_positions(path, rng, lambda position: position + noise)


def stop_a_frame(path: Path, rng: np.random.Generator) -> None:
    """Repeat a frame in the place of the next one."""
    frame = int(rng.integers(_shape(path)[1] - 1))

    def change(position: Array) -> Array:
        position[:, frame + 1] = position[:, frame]
        return position

    _change_positions(path, rng, change)


def exchange_scenarios(path: Path, rng: np.random.Generator) -> None:
    """Write the scenarios in another order under the old ids."""
    _change_positions(path, rng, lambda position: position[::-1])


def exchange_axes(path: Path, rng: np.random.Generator) -> None:
    """Exchange the components of positions."""
    _change_positions(path, rng, lambda position: position[..., ::-1])


def one_particle_everywhere(path: Path, rng: np.random.Generator) -> None:
    """Put all particles of all frames but the first into one point."""

    def change(position: Array) -> Array:
        position[:, 1:] = position[:, 1:, :1]
        return position

    _change_positions(path, rng, change)


def other_type(path: Path, rng: np.random.Generator) -> None:
    """Store positions as another type."""
    types = ("f8", "f2", "i4", "S8", "c8", "?")
    kind = types[rng.integers(len(types))]

    def change(position: Array) -> Array:
        return position.astype(kind)

    _replace_positions(path, change)


def other_shape(path: Path, rng: np.random.Generator) -> None:
    """Leave out a scenario, a frame, a particle or a component, or add an axis."""
    axis = int(rng.integers(5))

    def change(position: Array) -> Array:
        if axis == 4:
            return position[None]
        return np.delete(position, -1, axis=axis % position.ndim)

    _replace_positions(path, change)


def external_positions(path: Path, rng: np.random.Generator) -> None:
    """Be a link to a variable of another file, or of the same one."""
    with h5py.File(path, "r+") as file:
        del file["position"]
        if rng.random() < 0.5:
            file["position"] = h5py.ExternalLink("/etc/passwd", "position")
        else:
            file["position"] = h5py.SoftLink("/position")


def remove_a_variable(path: Path, rng: np.random.Generator) -> None:
    """Remove a variable."""
    with h5py.File(path, "r+") as file:
        names = sorted(file)
        del file[names[rng.integers(len(names))]]


def remove_an_attribute(path: Path, rng: np.random.Generator) -> None:
    """Remove an attribute."""
    with h5py.File(path, "r+") as file:
        names = sorted(file.attrs)
        del file.attrs[names[rng.integers(len(names))]]


def wrong_attribute(path: Path, rng: np.random.Generator) -> None:
    """Give an attribute another value."""
    values: tuple[Any, ...] = (
        "",
        "../../outside",
        "\u202egnp",
        -1,
        2**62,
        np.nan,
        np.inf,
        np.zeros(1000),
        "x" * 60_000,
    )
    with h5py.File(path, "r+") as file:
        names = sorted(file.attrs)
        name = names[rng.integers(len(names))]
        del file.attrs[name]
        file.attrs[name] = values[rng.integers(len(values))]


def repeated_ids(path: Path, rng: np.random.Generator) -> None:
    """State one scenario, or one frame, twice."""
    name = ("scenario", "frame")[rng.integers(2)]
    with h5py.File(path, "r+") as file:
        file[name][1] = file[name][0]


def _shape(path: Path) -> tuple[int, ...]:
    with h5py.File(path) as file:
        shape: tuple[int, ...] = file["position"].shape
    return shape


def _replace_positions(path: Path, change: Callable[[Array], Array]) -> None:
    """Store changed positions as a new variable with the old attributes."""
    with h5py.File(path, "r+") as file:
        old = file["position"]
        attributes = {}
        for name, value in old.attrs.items():
            if name not in ("DIMENSION_LIST", "_Netcdf4Coordinates"):
                attributes[name] = value
        position = change(old[...])
        del file["position"]
        file["position"] = position
        for name, value in attributes.items():
            file["position"].attrs[name] = value


PREDICTIONS: tuple[Mutation, ...] = (
    nan_positions,
    infinite_positions,
    huge_positions,
    negative_positions,
    other_motion,
    stop_a_frame,
    exchange_scenarios,
    exchange_axes,
    one_particle_everywhere,
    other_type,
    other_shape,
    external_positions,
    remove_a_variable,
    remove_an_attribute,
    wrong_attribute,
    repeated_ids,
)


# --- score files ----------------------------------------------------------------------


def wrong_numbers(path: Path, rng: np.random.Generator) -> None:
    """Write an impossible number into one place, or everywhere, of a variable."""
    numbers = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e30)
    number = numbers[rng.integers(len(numbers))]
    with h5py.File(path, "r+") as file:
        names = _numeric_variables(file)
        variable = file[names[rng.integers(len(names))]]
        values = variable[...]
        if not np.issubdtype(values.dtype, np.floating):
            limits = np.iinfo(values.dtype)
            number = (limits.min, 0, limits.max)[rng.integers(3)]
        if rng.random() < 0.5:
            values[...] = number
        elif values.size:
            values.flat[rng.integers(values.size)] = number
        variable[...] = values


def _numeric_variables(file: h5py.File) -> list[str]:
    """Return the names of all variables of numbers, those of groups included."""
    names: list[str] = []

    def add(name: str, member: object) -> None:
        if isinstance(member, h5py.Dataset) and member.dtype.kind in "fiu":
            names.append(name)

    file.visititems(add)
    return sorted(names)


SCORE_FILE: tuple[Mutation, ...] = (
    *[wrong_numbers] * 8,
    remove_a_variable,
    remove_an_attribute,
    wrong_attribute,
)
"""Changes of what a score file contains."""
