"""Make faulty prediction files and say what the validator makes of each.

    python tests/bad_submissions.py [FOLDER]

writes a small data set and one file per fault into FOLDER (a temporary one by default),
validates each in a child process with limits, and prints check, exit code, seconds and the
child's peak memory. Exit code 1 if any file is not recognised, crashes or breaks a limit.
"""

from __future__ import annotations

import gzip
import os
import pickle
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
from numpy.typing import ArrayLike, NDArray
from submission_data import FRAMES, GIVEN, HORIZON, PARTICLES, TESTS, Bench, make_bench

DIMS = ("scenario", "frame", "particle", "space")
SHAPE = (len(TESTS), HORIZON, PARTICLES, 2)


@dataclass(frozen=True)
class Fault:
    """A way to be wrong.

    Attributes:
        make: writes the file and returns its path.
        check: check that must name it.
        exit_code: exit code that it must lead to.
        hostile: whether it must be looked at in a child process only.
        says: a word that the message must contain.
    """

    make: Callable[[Bench], Path]
    check: str
    exit_code: int
    hostile: bool = False
    says: str = ""


FAULTS: dict[str, Fault] = {}


def fault(
    check: str, exit_code: int = 1, *, hostile: bool = False, says: str = ""
) -> Callable[[Callable[[Bench], Path]], Callable[[Bench], Path]]:
    """Register a function that makes a faulty file."""

    def register(make: Callable[[Bench], Path]) -> Callable[[Bench], Path]:
        FAULTS[make.__name__] = Fault(make, check, exit_code, hostile, says)
        return make

    return register


def simple(check: str, name: str, change: Callable[[h5py.File], object], *, says: str = "") -> None:
    """Register a fault that changes an open copy of the valid file."""

    def make(bench: Bench) -> Path:
        path = bench.copy(f"{name}.nc")
        with h5py.File(path, "r+") as file:
            change(file)
        return path

    FAULTS[name] = Fault(make, check, 4 if check == "dataset" else 1, says=says)


def replace(
    file: h5py.File, name: str, dims: tuple[str, ...], data: Any = None, **options: Any
) -> h5py.Dataset:
    """Replace a variable by another of the same name, with dimension scales attached."""
    attributes = {} if name not in file else {k: v for k, v in file[name].attrs.items() if k == "units"}
    if name in file:
        del file[name]
    dataset = file.create_dataset(name, data=data, **options)
    dataset.attrs.update(attributes)
    for axis, dim in enumerate(dims):
        if dim in file and dim != name:
            dataset.dims[axis].attach_scale(file[dim])
    return dataset


def positions(file: h5py.File) -> NDArray[np.float32]:
    """Return the positions of an open file."""
    values: NDArray[np.float32] = file["position"][...]
    return values


def store(file: h5py.File, values: ArrayLike, **options: Any) -> h5py.Dataset:
    """Put other positions in place of those of an open file."""
    return replace(file, "position", DIMS, np.asarray(values), **options)


@contextmanager
def built(
    bench: Bench,
    name: str,
    *,
    scenarios: ArrayLike = TESTS,
    frames: ArrayLike = range(GIVEN, FRAMES),
    particles: int = PARTICLES,
    dims: tuple[str, ...] = DIMS,
    unlimited: bool = False,
) -> Iterator[tuple[Path, netCDF4.Dataset]]:
    """Yield a new file with other coordinates; unwritten frames stand still in the middle."""
    path = bench.folder / f"{name}.nc"
    numbers = {"scenario": np.array(scenarios, np.int64), "frame": np.array(frames, np.int64)}
    lengths = {d: len(n) for d, n in numbers.items()} | {"particle": particles, "space": 2}
    with netCDF4.Dataset(bench.valid) as valid, netCDF4.Dataset(path, "w") as file:
        for dim, length in lengths.items():
            file.createDimension(dim, None if unlimited and dim == "frame" else length)
        for dim, values in numbers.items():
            file.createVariable(dim, "i8", (dim,))[:] = values
        position = file.createVariable("position", "f4", dims, zlib=True)
        position[:] = np.full([lengths[d] for d in dims], 0.5, np.float32)
        file.setncatts({n: valid.getncattr(n) for n in valid.ncattrs()})
        yield path, file


def rows(bench: Bench, name: str, scenarios: list[int], frames: list[int], pick: Any) -> Path:
    """Write a selection of the valid positions under other coordinates."""
    with h5py.File(bench.valid) as valid:
        values = positions(valid)[pick]
    with built(bench, name, scenarios=scenarios, frames=frames) as (path, file):
        file["position"][:] = values
    return path


# --- files that are no netCDF4 -------------------------------------------------------------


@fault("readable", 3, says="cannot open")
def missing_file(bench: Bench) -> Path:
    """No such file."""
    return bench.folder / "nowhere.nc"


@fault("readable", 3, says="folder")
def folder(bench: Bench) -> Path:
    """A folder of that name."""
    path = bench.folder / "folder.nc"
    path.mkdir(exist_ok=True)
    return path


@fault("readable", 3, says="pipe")
def fifo(bench: Bench) -> Path:
    """A named pipe that nobody writes to: opening it would wait for ever."""
    path = bench.folder / "fifo.nc"
    if not path.exists():
        os.mkfifo(path)
    return path


@fault("readable", 3, says="device")
def endless_device(bench: Bench) -> Path:
    """A link to a device that never ends."""
    path = bench.folder / "zero.nc"
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")
    return path


@fault("readable", 3)
def broken_symlink(bench: Bench) -> Path:
    """A link to nowhere."""
    path = bench.folder / "broken.nc"
    path.unlink(missing_ok=True)
    path.symlink_to(bench.folder / "nowhere.nc")
    return path


@fault("readable", 3)
def symlink_to_itself(bench: Bench) -> Path:
    """A link that leads to itself."""
    path = bench.folder / "circle.nc"
    path.unlink(missing_ok=True)
    path.symlink_to(path)
    return path


def _bytes(name: str, content: Callable[[bytes], bytes], says: str = "") -> None:
    def make(bench: Bench) -> Path:
        path = bench.folder / f"{name}.nc"
        path.write_bytes(content(bench.valid.read_bytes()))
        return path

    FAULTS[name] = Fault(make, "readable", 3, says=says)


def _with_byte(data: bytes, place: int, value: int) -> bytes:
    return data[:place] + bytes([value]) + data[place + 1 :]


_bytes("empty_file", lambda _: b"", "empty")
_bytes("text_renamed", lambda _: b"scenario,frame,x,y\n3,6,0.1,0.2\n", "text")
_bytes("zip_renamed", lambda _: b"PK\x03\x04" + bytes(100), "npz")
_bytes("numpy_renamed", lambda _: b"\x93NUMPY\x01\x00" + bytes(100), ".npy")
_bytes("pickle_renamed", lambda _: pickle.dumps([1.0] * 100), "pickle")
_bytes("gzipped", gzip.compress, "gzip")
_bytes("truncated_half", lambda data: data[: len(data) // 2])
_bytes("truncated_last_byte", lambda data: data[:-1])
_bytes("signature_only", lambda data: data[:8])
_bytes("superblock_zeroed", lambda data: data[:8] + bytes(88) + data[96:])
_bytes("superblock_of_the_future", lambda data: _with_byte(data, 8, 77))
_bytes("user_block_before", lambda data: bytes(512) + data, "bytes of another format")
_bytes("windows_newlines", lambda data: data.replace(b"\n", b"\r\n"))


@fault("readable", 3, says="netCDF-3")
def netcdf3(bench: Bench) -> Path:
    """The format before HDF5."""
    path = bench.folder / "netcdf3.nc"
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
        file.split = "cavity"
    return path


@fault("readable", 3, says="HDF5 cannot read")
def chunk_damaged(bench: Bench) -> Path:
    """A compressed chunk with eight bytes overwritten."""
    path = bench.copy("chunk_damaged.nc")
    with h5py.File(path) as file:
        info = file["position"].id.get_chunk_info(7)
    data = bytearray(path.read_bytes())
    data[info.byte_offset : info.byte_offset + 8] = b"\xff" * 8
    path.write_bytes(data)
    return path


def _stream(gibibytes: int) -> bytes:
    """Return a zlib stream that unpacks to so much nothing."""
    packer, zeros = zlib.compressobj(9), bytes(1 << 24)
    blocks = [packer.compress(zeros) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2)]
    return blocks[0] + (64 * gibibytes - 1) * blocks[1]


@fault("format", says="longer packed")
def small_chunk_bomb(bench: Bench) -> Path:
    """A chunk of 768 bytes whose zlib stream unpacks to 2 GiB."""
    path = bench.copy("small_chunk_bomb.nc")
    with h5py.File(path, "r+") as file:
        file["position"].id.write_direct_chunk((1, 1, 0, 0), _stream(2))
    return path


@fault("readable", 3, hostile=True)
def large_chunk_bomb(bench: Bench) -> Path:
    """A chunk of 8 MiB, allowed as such, whose stream of 2 MiB unpacks to 2 GiB."""
    path = bench.copy("large_chunk_bomb.nc")
    options = {"maxshape": (None,) * 4, "chunks": (1, 8, 1 << 17, 2), "dtype": "f4", "compression": 1}
    with h5py.File(path, "r+") as file:
        dataset = replace(file, "position", DIMS, shape=SHAPE, **options)
        dataset.id.write_direct_chunk((1, 0, 0, 0), _stream(2))
    return path


# --- format --------------------------------------------------------------------------------


def _attribute(name: str, attribute: str, value: Any, *, check: str = "format", says: str = "") -> None:
    def change(file: h5py.File) -> None:
        if value is None:
            del file.attrs[attribute]
        else:
            file.attrs[attribute] = value

    simple(check, name, change, says=says or attribute)


_attribute("no_format_number", "lagbench_format", None, says="missing")
_attribute("another_format_number", "lagbench_format", 2)
_attribute("format_number_as_text", "lagbench_format", "1")
_attribute("no_method", "method", None, says="missing")
_attribute("blank_method", "method", "  ")
_attribute("method_with_escape_codes", "method", "best\x1b[2Jmethod", says="\\x1b")
_attribute("method_is_a_number", "method", 5)
_attribute("method_is_a_list", "method", np.array(["a", "b"], dtype=h5py.string_dtype()), says="single")
_attribute("long_method", "method", "x" * 10_000)
_attribute("method_as_bad_utf8", "method", np.bytes_(b"\xff\xfe"))
_attribute("method_is_empty", "method", h5py.Empty("S1"), says="single")
_attribute("seconds_negative", "seconds_per_frame", -1.0)
_attribute("seconds_nan", "seconds_per_frame", np.nan)
_attribute("seed_as_text", "seed", "seven")
_attribute("no_split", "split", None, says="missing")
_attribute("attribute_is_compound", "training", np.zeros(1, [("a", "i4")]), says="neither")


@fault("format", says="single")
def huge_attribute(bench: Bench) -> Path:
    """An attribute of 64 MiB."""
    path = bench.copy("huge_attribute.nc")
    with h5py.File(path, "r+", libver="latest") as file:
        file.attrs.create("training", np.zeros(64 << 20, np.int8))
    return path


@fault("format", says="characters")
def huge_text(bench: Bench) -> Path:
    """A text of 8 MiB."""
    path = bench.copy("huge_text.nc")
    with h5py.File(path, "r+") as file:
        file.attrs["training"] = "x" * (8 << 20)
    return path


def _rename(file: h5py.File) -> None:
    file.move("position", "positions")


def _group(file: h5py.File) -> None:
    del file["position"]
    file.create_group("position")


def _named_type(file: h5py.File) -> None:
    del file["position"]
    file["position"] = np.dtype("f4")


def _soft_circle(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.SoftLink("/other")
    file["other"] = h5py.SoftLink("/position")


def _soft_alias(file: h5py.File) -> None:
    _rename(file)
    file["position"] = h5py.SoftLink("/positions")


def _external_link(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.ExternalLink("/etc/passwd", "/x")


def _stray_link(file: h5py.File) -> None:
    file["notes"] = h5py.ExternalLink("elsewhere.nc", "/position")


def _crowd(file: h5py.File) -> None:
    for number in range(1200):
        file.create_group(f"g{number}")


def _null(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.Empty("f4")


simple("format", "variable_misspelt", _rename, says="positions")
simple("format", "position_is_a_group", _group, says="group")
simple("format", "position_is_a_type", _named_type, says="type")
simple("format", "soft_links_in_a_circle", _soft_circle, says="soft link")
simple("format", "soft_link", _soft_alias, says="soft link")
simple("format", "external_link", _external_link, says="external link")
simple("format", "stray_external_link", _stray_link, says="external link")
simple("format", "too_many_groups", _crowd, says="too many")
simple("format", "position_without_values", _null)
simple("format", "lzf_filter", lambda f: store(f, positions(f), compression="lzf"), says="lzf")
simple("format", "scale_offset_filter", lambda f: store(f, positions(f), scaleoffset=6), says="filter")
simple("format", "no_scenario_ids", lambda f: f.pop("scenario"), says="scenario")
simple("format", "ids_as_text", lambda f: replace(f, "scenario", (), np.array([b"3", b"4", b"5"])))
simple("format", "ids_as_floats", lambda f: replace(f, "scenario", (), np.array([3.0, 4.0, 5.0])))
simple("format", "ids_in_two_dimensions", lambda f: replace(f, "scenario", (), np.array([[3, 4, 5]])))
simple(
    "format",
    "tiny_chunks",
    lambda f: replace(f, "position", DIMS, shape=(3, 8, 5000, 2), chunks=(1, 1, 1, 1), dtype="f4"),
    says="too many chunks",
)
simple(
    "format",
    "huge_chunk",
    lambda f: replace(
        f, "position", DIMS, shape=SHAPE, maxshape=(None,) * 4, chunks=(3, 8, 1 << 20, 8), dtype="f4"
    ),
    says="unpack",
)
simple(
    "format",
    "huge_chunk_of_ids",
    lambda f: replace(
        f, "scenario", (), shape=(3,), maxshape=(None,), chunks=(1 << 28,), dtype="i4", compression=1
    ),
)


@fault("format", says="other files")
def virtual_dataset(bench: Bench) -> Path:
    """A virtual data set whose source is another file."""
    path = bench.copy("virtual_dataset.nc")
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[...] = h5py.VirtualSource(str(bench.valid), "position", SHAPE)
    with h5py.File(path, "r+") as file:
        del file["position"]
        file.create_virtual_dataset("position", layout)
    return path


@fault("format", says="other files")
def external_storage(bench: Bench) -> Path:
    """Raw values in a file that is not ours to read."""
    path = bench.copy("external_storage.nc")
    with h5py.File(path, "r+") as file:
        outside = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
        replace(file, "position", DIMS, shape=SHAPE, dtype="f4", external=outside)
    return path


@fault("format", says="filter")
def unknown_filter(bench: Bench) -> Path:
    """A filter number that no library has."""
    path = bench.copy("unknown_filter.nc")
    with h5py.File(path, "r+") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((1, 1, PARTICLES, 2))
        plist.set_filter(511, h5py.h5z.FLAG_OPTIONAL, (1,))
        del file["position"]
        space = h5py.h5s.create_simple(SHAPE)
        h5py.h5d.create(file.id, b"position", h5py.h5t.IEEE_F32LE, space, plist)
    return path


# --- split and data set --------------------------------------------------------------------

_attribute("unknown_split", "split", "cavty", check="split", says="cavity")
_attribute("unknown_size", "size", "huge", check="split", says="full")
_attribute("path_as_split", "split", "../../etc", check="split")
_attribute("wrong_split", "split", "curl-noise", check="particles", says="506")
_attribute("stale_hash", "dataset_sha256", "ab" * 32, check="dataset", says="another data set")
_attribute("shortened_hash", "dataset_sha256", "abcdef", check="dataset")
_attribute("another_major_version", "dataset_version", "2.0.0", check="dataset", says="version")
_attribute("version_in_words", "dataset_version", "latest", check="dataset", says="version")

# --- dimensions ----------------------------------------------------------------------------


def _transposed(name: str, order: tuple[int, ...], says: str) -> None:
    dims = tuple(DIMS[axis] for axis in order)

    def change(file: h5py.File) -> None:
        replace(file, "position", dims, positions(file).transpose(order))

    simple("dims", name, change, says=says)


_transposed("space_before_particle", (0, 1, 3, 2), "transpose")
_transposed("frame_before_scenario", (1, 0, 2, 3), "transpose")
simple(
    "dims", "axes_swapped_names_kept", lambda f: _unchecked(f, positions(f).swapaxes(2, 3)), says="swapped"
)
simple(
    "dims", "one_scenario_only", lambda f: replace(f, "position", DIMS[1:], positions(f)[0]), says="leading"
)
simple("dims", "dimensions_without_names", lambda f: _bare(f, positions(f)), says="scales")
simple("dims", "flattened", lambda f: _bare(f, positions(f).reshape(3, -1)))
simple("dims", "three_components", lambda f: _unchecked(f, np.zeros((3, 8, PARTICLES, 3), "f4")))
simple("dims", "fewer_frames_than_numbers", lambda f: _unchecked(f, positions(f)[:, :5]))
simple("format", "scalar_position", lambda f: replace(f, "position", (), np.float32(1)))


def _bare(file: h5py.File, values: NDArray[np.float32]) -> None:
    del file["position"]
    file["position"] = values


def _unchecked(file: h5py.File, values: NDArray[np.float32]) -> None:
    """Attach scales whatever their lengths."""
    store(file, values)


@fault("dims", says="'odd_name'")
def dimension_misnamed(bench: Bench) -> Path:
    """Particles under another name."""
    path = bench.folder / "dimension_misnamed.nc"
    with h5py.File(bench.copy(path.name), "r+") as file:
        values = positions(file)
        file.move("particle", "odd_name")
        replace(file, "position", ("scenario", "frame", "odd_name", "space"), values)
    return path


@fault("particles", says="2147483648")
def two_billion_particles(bench: Bench) -> Path:
    """2^31 particles that take no room in the file: 412 GB of zeros."""
    path = bench.copy("two_billion_particles.nc")
    with h5py.File(path, "r+") as file:
        shape, chunks = (3, 8, 1 << 31, 2), (1, 1, 1 << 22, 2)
        replace(file, "position", DIMS, shape=shape, chunks=chunks, dtype="f4", compression=1)
    return path


@fault("format", says="coordinate")
def two_billion_frames(bench: Bench) -> Path:
    """2^31 frame numbers and as many frames, all of them zero."""
    path = bench.copy("two_billion_frames.nc")
    count = 1 << 31
    with h5py.File(path, "r+") as file:
        replace(file, "frame", (), shape=(count,), chunks=(1 << 16,), dtype="i4", compression=1)
        file["frame"].make_scale("frame")
        shape, chunks = (3, count, PARTICLES, 2), (1, 1 << 16, PARTICLES, 2)
        replace(file, "position", DIMS, shape=shape, chunks=chunks, dtype="f4", compression=1)
    return path


@fault("frames", says="goes on too long")
def twenty_thousand_frames(bench: Bench) -> Path:
    """Readable coordinates, positions of 23 GB that take no room."""
    path = bench.copy("twenty_thousand_frames.nc")
    with h5py.File(path, "r+") as file:
        replace(file, "frame", (), np.arange(GIVEN, 20_000)).make_scale("frame")
        shape, chunks = (3, 20_000 - GIVEN, PARTICLES, 2), (1, 100, PARTICLES, 2)
        replace(file, "position", DIMS, shape=shape, chunks=chunks, dtype="f4", compression=1)
    return path


# --- scenarios and frames ------------------------------------------------------------------

ALL = list(range(GIVEN, FRAMES))


def _rows(
    name: str, check: str, scenarios: list[int], frames: list[int], pick: Any = slice(None), *, says: str
) -> None:
    FAULTS[name] = Fault(lambda bench: rows(bench, name, scenarios, frames, pick), check, 1, says=says)


_rows("scenario_missing", "scenarios", [3, 5], ALL, [0, 2], says="missing: 4")
_rows("scenario_unknown", "scenarios", [3, 4, 5, 77], ALL, [0, 1, 2, 0], says="unknown: 77")
_rows("scenario_twice", "scenarios", [3, 4, 5, 4], ALL, [0, 1, 2, 1], says="duplicate: 4")
_rows("scenarios_counted", "scenarios", [0, 1, 2], ALL, says="count")
_rows("scenarios_of_train", "scenarios", [0, 1], ALL, [0, 1], says="train")
_rows("scenario_negative", "scenarios", [-3, 4, 5], ALL, says="-3")
_rows("scenario_enormous", "scenarios", [3, 4, 1 << 62], ALL, says="unknown")
_rows("no_scenarios", "scenarios", [], ALL, slice(0), says="missing")
_rows("every_second_frame", "frames", [3, 4, 5], ALL[::2], np.s_[:, ::2], says="every 2nd")
_rows("every_third_frame", "frames", [3, 4, 5], ALL[::3], np.s_[:, ::3], says="every 3rd")
_rows(
    "input_frames_included",
    "frames",
    [3, 4, 5],
    [0, 1, 2, *ALL],
    np.s_[:, [0] * 3 + [*range(8)]],
    says="input",
)
_rows("frames_counted_from_0", "frames", [3, 4, 5], list(range(8)), says="absolute number is 3")
_rows("frames_shifted", "frames", [3, 4, 5], [n + 2 for n in ALL], says="shifted by 2")
_rows("frames_stop_early", "frames", [3, 4, 5], ALL[:5], np.s_[:, :5], says="too early")
_rows("frames_reversed", "frames", [3, 4, 5], ALL[::-1], np.s_[:, ::-1], says="order")
_rows(
    "frame_twice", "frames", [3, 4, 5], [3, 4, 5, 5, 6, 7, 8, 9, 10], np.s_[:, [*range(8), 0]], says="twice"
)
_rows("frame_left_out", "frames", [3, 4, 5], [3, 4, 6, 7, 8, 9, 10], np.s_[:, :7], says="lacks the frames 5")
_rows("no_frames", "frames", [3, 4, 5], [], np.s_[:, :0], says="no frames")
_rows("frames_enormous", "frames", [3, 4, 5], [3, 1 << 61], np.s_[:, :2], says="every")


# --- particles and types -------------------------------------------------------------------


@fault("particles", says="47")
def particle_missing(bench: Bench) -> Path:
    """One particle too few."""
    with built(bench, "particle_missing", particles=47) as (path, _):
        return path


@fault("particles", says="96")
def particles_doubled(bench: Bench) -> Path:
    """Twice as many particles."""
    with built(bench, "particles_doubled", particles=96) as (path, _):
        return path


for _name, _type in {"float64": "f8", "float16": "f2", "int32": "i4", "uint8": "u1"}.items():
    simple("dtype", f"positions_{_name}", lambda f, t=_type: store(f, positions(f).astype(t)), says=_name)
simple("dtype", "positions_complex", lambda f: store(f, positions(f).astype("c8")), says="compound")
simple("dtype", "positions_bool", lambda f: store(f, positions(f) > 0.5), says="enum")
simple("dtype", "positions_opaque", lambda f: store(f, np.zeros(SHAPE, "V4")), says="opaque")
simple("dtype", "positions_text", lambda f: store(f, positions(f).astype("S8")), says="string")
_TEXT, _RAGGED = h5py.string_dtype(), h5py.vlen_dtype(np.float32)
simple(
    "dtype",
    "positions_vlen",
    lambda f: replace(f, "position", DIMS, shape=SHAPE, dtype=_RAGGED),
    says="length",
)
simple("dtype", "positions_vlen_text", lambda f: replace(f, "position", DIMS, shape=SHAPE, dtype=_TEXT))
simple(
    "dtype", "positions_references", lambda f: replace(f, "position", DIMS, shape=SHAPE, dtype=h5py.ref_dtype)
)
simple("dtype", "scale_factor", lambda f: f["position"].attrs.update(scale_factor=0.5), says="scale_factor")
simple("dtype", "add_offset", lambda f: f["position"].attrs.update(add_offset=1.0), says="add_offset")


@fault("dtype", says="not IEEE")
def float_of_another_kind(bench: Bench) -> Path:
    """Four bytes with an exponent of another bias."""
    path = bench.copy("float_of_another_kind.nc")
    with h5py.File(path, "r+") as file:
        kind = h5py.h5t.IEEE_F32LE.copy()
        kind.set_ebias(100)
        del file["position"]
        h5py.h5d.create(file.id, b"position", kind, h5py.h5s.create_simple(SHAPE))
        for axis, dim in enumerate(DIMS):
            file["position"].dims[axis].attach_scale(file[dim])
    return path


# --- values --------------------------------------------------------------------------------


def _value(check: str, name: str, edit: Callable[[NDArray[np.float32]], ArrayLike], says: str) -> None:
    simple(check, name, lambda f: store(f, np.asarray(edit(positions(f)), np.float32)), says=says)


def _put(place: Any, value: float) -> Callable[[NDArray[np.float32]], ArrayLike]:
    def edit(values: NDArray[np.float32]) -> ArrayLike:
        values[place] = value
        return values

    return edit


def _permuted(values: NDArray[np.float32]) -> ArrayLike:
    return values[:, :, np.random.Generator(np.random.PCG64(1)).permutation(PARTICLES)]


def _displacements(values: NDArray[np.float32]) -> ArrayLike:
    return np.diff(values, axis=1, prepend=values[:, :1])


_value("finite", "one_nan", _put((1, 2, 3, 1), np.nan), "scenario 4, frame 5, particle 3, y")
_value("finite", "one_infinity", _put((2, 7, 0, 0), np.inf), "scenario 5, frame 10, particle 0, x")
_value("finite", "last_frames_nan", _put((slice(None), slice(5, None)), np.nan), "finite")
_value("finite", "all_nan", _put(..., np.nan), "finite")
_value("finite", "all_infinite", _put(..., -np.inf), "finite")
_value("start", "particles_permuted", _permuted, "another order")
_value("start", "x_and_y_swapped", lambda v: v[..., ::-1], "swapped")
_value(
    "start",
    "standardised",
    lambda v: (v - v.mean((1, 2), keepdims=True)) / v.std((1, 2), keepdims=True),
    "standardised",
)
_value("start", "displacements", _displacements, "displacements")
_value("start", "all_zero", np.zeros_like, "displacements")
_value("start", "huge_values", lambda v: v + np.float32(1e30), "follow")
_value("start", "scenarios_mixed_up", lambda v: v[[1, 2, 0]], "follow")


@fault("finite", says="never written")
def frame_never_written(bench: Bench) -> Path:
    """What netCDF leaves where a frame was skipped while writing."""
    path = bench.folder / "frame_never_written.nc"
    with netCDF4.Dataset(bench.valid) as valid, built(bench, path.stem) as (_, file):
        file.renameVariable("position", "old")
        file.createVariable("position", "f4", DIMS)
        for frame in (0, 1, 2, 3, 5, 6, 7):
            file["position"][:, frame] = valid["position"][:, frame]
    return path


@fault("readable", 3, hostile=True)
def heap_loops(bench: Bench) -> Path:
    """A global heap that leads HDF5 to an object of length 0, which it passes for ever."""
    path = bench.copy("heap_loops.nc")
    data = bytearray(path.read_bytes())
    start = data.index(b"GCOL")
    struct.pack_into("<Q", data, start + 24, 2000)
    path.write_bytes(data)
    return path


def main() -> int:
    """Make and validate all of them."""
    import resource

    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
    bench = make_bench(target)
    failures = 0
    for name, entry in list(FAULTS.items()):
        path = entry.make(bench)
        started = time.perf_counter()
        result = bench.validate(path, isolated=True)
        seconds = time.perf_counter() - started
        checks = sorted({finding.check for finding in result.errors})
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        entry = FAULTS[name]
        good = entry.check in checks and result.exit_code == entry.exit_code and seconds < 10 and peak < 1000
        failures += not good
        text = f"{name:28} {','.join(checks):24} exit {result.exit_code} {seconds:5.1f} s {peak:5.0f} MiB"
        print(f"{text} {'ok' if good else 'NOT RECOGNISED'}")  # noqa: T201
    print(f"{len(FAULTS)} faulty files, {failures} not recognised; they lie in {target}")  # noqa: T201
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
