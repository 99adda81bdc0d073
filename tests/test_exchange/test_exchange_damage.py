"""Imports of what is damaged, made to do harm, or out of range: an error by name, and
nothing left.
"""

from __future__ import annotations

import codecs
import contextlib
import json
import os
import re
import resource
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import h5py
import netCDF4
import numpy as np
import pytest
from command_line import CliRunner
from exchange_readers import straight_runs
from exchange_writers import METADATA, write_gns, write_h5

from lagbench.cli.program import app
from lagbench.errors import DataError, LagbenchError, UnreadableFileError, UsageError
from lagbench.exchange import adopt, import_split, trajectory
from lagbench.exchange.array_files import READABLE
from lagbench.exchange.local_split import LocalSplit
from lagbench.exchange.metadata import parse_kinds

BASIC: dict[str, Any] = {"radius": 0.1, "frame_interval": 0.25}


@pytest.fixture
def gns(tmp_path: Path) -> Path:
    """Three sound runs as npz files, to be damaged."""
    return write_gns(tmp_path / "in", straight_runs(3))


@pytest.fixture
def h5(tmp_path: Path) -> Path:
    """Three sound runs as HDF5 files, to be damaged."""
    return write_h5(tmp_path / "in", straight_runs(3))


def imported(source: Path) -> LocalSplit:
    """Import from the folder of a fixture."""
    form = "gns-npz" if list(source.glob("*.npz")) else "lagrangebench-h5"
    return import_split(source, format=form, output=source.parent / "own")


def adopted(bad: Path, **options: Any) -> LocalSplit:
    """Adopt a file and, before it, two sound ones."""
    for number, run in enumerate(straight_runs(2)):
        np.save(bad.parent / f"{number}.npy", run)
    files = [*sorted(bad.parent.glob("?.npy")), bad]
    return adopt(
        files,
        output=bad.parent / "own",
        **BASIC,
        **options,
    )


def save_parts(folder: Path, *parts: Any) -> None:
    """Write a trajectory of train, its positions and then other parts, as a pickle."""
    item = np.empty(1 + len(parts), dtype=object)
    for number, part in enumerate((straight_runs(1)[0], *parts)):
        item[number] = part
    np.savez(folder / "train.npz", simulation_0=item)


@contextlib.contextmanager
def array_file(
    path: Path, shape: tuple[int, ...], kind: str = "<f4"
) -> Iterator[IO[bytes]]:
    """Yield a .npy file, or its place in an .npz file, after a header that claims a
    shape.
    """
    with contextlib.ExitStack() as stack:
        if path.suffix == ".npy":
            stream = stack.enter_context(path.open("wb"))
        else:
            archive = stack.enter_context(
                zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
            )
            member = "simulation_0.npy" if kind == "|O" else "position.npy"
            stream = stack.enter_context(archive.open(member, "w"))
        header = {
            "descr": kind,
            "fortran_order": False,
            "shape": shape,
        }
        np.lib.format.write_array_header_1_0(stream, header)
        yield stream


@contextlib.contextmanager
def refused(folder: Path, where: str, *others: type[LagbenchError]) -> Iterator[None]:
    """Expect an unreadable file, or another error, named by the file or what is in it,
    and nothing left.
    """
    with pytest.raises((UnreadableFileError, *others)) as caught:
        yield
    assert where in str(caught.value.where)
    assert not (folder / "own").exists()


class _Reduced:
    """Pickles as a call, perhaps with a state."""

    def __init__(self, *reduced: Any) -> None:
        self.reduced = reduced

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


def test_a_malicious_pickle_is_never_run(gns: Path, tmp_path: Path) -> None:
    """A pickle that calls anything but NumPy's constructors is refused."""
    trace = tmp_path / "trace"
    save_parts(gns, _Reduced(Path.write_text, (trace, "run")))
    with refused(tmp_path, "simulation_0"):
        imported(gns)
    assert not trace.exists()
    # NumPy's own reader does run it.
    with np.load(gns / "train.npz", allow_pickle=True) as file:
        file["simulation_0"]
    assert trace.exists()


ADDRESSES = b"A" * 16
# NumPy takes the values of a type of objects without flags for addresses of objects.
OBJECTS = _Reduced(np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0))
STATE = (1, (2,), OBJECTS, False, ADDRESSES)
MANY = [np.zeros(1)] * 4


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (
            _Reduced(np.zeros(0).__reduce__()[0], (np.ndarray, (0,), b"b"), STATE),
            "bytes for the objects",
        ),
        (
            _Reduced(np.float64(0).__reduce__()[0], (OBJECTS, ADDRESSES[:8])),
            "wants to call",
        ),
        (
            _Reduced(np.ndarray, ((1 << 45,), np.dtype("f8"))),
            "make an array by itself",
        ),
        (
            _Reduced(codecs.encode, ("x", "punycode")),
            "wants to call",
        ),
        ("text", "holds a str"),
        (MANY, "holds a list"),
    ],
)
def test_no_pickle_gets_at_memory(gns: Path, item: Any, words: str) -> None:
    """Made-up objects, addresses, giant arrays and codecs are refused before NumPy sees
    them.
    """
    save_parts(gns, item)
    with pytest.raises(UnreadableFileError, match=words):
        imported(gns)


@pytest.mark.parametrize(
    "program",
    [
        # remembers nothing, under the number 4294967280
        b"\x80\x04Nr\xf0\xff\xff\xff.",
        b"\x80\x04\x8e"
        + (1 << 40).to_bytes(8, "little")
        + b"short.",  # announces a terabyte
        b"\x80\x04\x8e" + b"\xff" * 8 + b".",
        b"\x80\x04(" * 99 + b".",  # marks that nothing ends
        b"\x80\x04" + b"]" * (1 << 25) + b".",  # lists, 56 bytes for each byte
    ],
)
def test_no_pickle_reserves_memory(gns: Path, program: bytes) -> None:
    """What a pickle announces and does not hold is refused before anything is reserved
    for it.
    """
    with array_file(gns / "train.npz", (2,), "|O") as stream:
        stream.write(program)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    mapped = (
        int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    )
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (1 << 30), hard))
    try:
        with pytest.raises(UnreadableFileError) as caught:
            imported(gns)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert "MemoryError" not in str(caught.value)


def test_filters_upon_filters_are_refused(h5: Path, tmp_path: Path) -> None:
    """Deflated four times, a chunk of a few hundred bytes would fill the memory on its
    way.
    """
    with h5py.File(h5 / "train.h5", "w") as file:
        group = file.create_group("00000")
        group["particle_type"] = np.zeros(40, int)
        created = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        created.set_chunk((1, 40, 2))
        for _ in range(4):
            created.set_deflate(9)
        space = h5py.h5s.create_simple((12, 40, 2))
        stored = h5py.h5d.create(
            group.id, b"position", h5py.h5t.IEEE_F32LE, space, dcpl=created
        )
        h5py.Dataset(stored)[:] = straight_runs(1)[0]
    with refused(tmp_path, "position"):
        imported(h5)


def test_an_npz_file_that_unpacks_to_far_more_is_refused(
    gns: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A member of 8 MB of zeros in some 30 kB."""
    monkeypatch.setattr(trajectory, "HARMLESS_BYTES", 1 << 20)
    with array_file(gns / "train.npz", (2,), "|O") as stream:
        stream.write(bytes(1 << 23))
    with pytest.raises(UnreadableFileError) as caught:
        imported(gns)
    assert caught.value.where.endswith("in/train.npz, key 'simulation_0'")


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_the_message_names_only_formats_that_are_adopted(
    tmp_path: Path, suffix: str
) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    for number in range(3):
        (folder / f"{number}{suffix}").write_bytes(b"no array")
    with pytest.raises(UnreadableFileError) as caught:
        adopt(folder, output=tmp_path / "own", **BASIC)
    suffixes = re.findall(r"\.[a-z]\w*", str(caught.value.fix))
    assert suffixes
    assert set(suffixes) <= set(READABLE)


def test_the_message_has_the_bound_of_an_array_that_unpacks_to_more() -> None:
    bound = trajectory.HARMLESS_BYTES
    trajectory.check_inflation("a small one", packed=10, unpacked=bound)
    with pytest.raises(UnreadableFileError) as caught:
        trajectory.check_inflation("a small one", packed=10, unpacked=bound + 1)
    assert str(bound) in str(caught.value.expected)


def test_an_array_that_is_not_read_may_unpack_to_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Adopting reads four arrays by their names; others take no memory."""
    monkeypatch.setattr(trajectory, "HARMLESS_BYTES", 1 << 20)
    source = tmp_path / "more.npz"
    arrays = {"position": straight_runs(1)[0], "unrelated": np.zeros(1 << 21)}
    np.savez_compressed(source, **arrays)  # type: ignore[arg-type]
    split = adopted(source)
    assert sum(split.scenarios.values()) == 3


def test_an_array_is_not_given_under_two_names(tmp_path: Path) -> None:
    """NumPy reads position.npy and position as the same array."""
    bad = tmp_path / "bad.npz"
    with array_file(bad, (12, 40, 2)) as stream:
        stream.write(straight_runs(1)[0].tobytes())
    with zipfile.ZipFile(bad, "a") as archive:
        archive.writestr("position", archive.read("position.npy"))
    with refused(tmp_path, bad.name):
        adopted(bad)


def test_an_empty_hdf5_file_of_many_particles_is_refused(
    h5: Path, tmp_path: Path
) -> None:
    """Arrays of 10^11 particles without a chunk."""
    with h5py.File(h5 / "train.h5", "w") as file:
        file.create_dataset(
            "00000/position",
            shape=(12, 10**11, 2),
            dtype="f4",
            chunks=(1, 1000, 2),
        )
        file.create_dataset(
            "00000/particle_type",
            shape=(10**11,),
            dtype="i8",
            chunks=(1000,),
        )
    with refused(tmp_path, "00000/"):
        imported(h5)


@pytest.mark.parametrize("place", [5, 6, 7])
def test_damaged_bytes_of_hdf5_raise_errors_of_ours(h5: Path, place: int) -> None:
    """Any error of HDF5 for overwritten structures becomes one of lagbench."""
    whole = (h5 / "train.h5").read_bytes()
    start = 96 + 100 * place  # past the superblock: headers, heaps and trees
    (h5 / "train.h5").write_bytes(whole[:start] + b"\xad" * 100 + whole[start + 100 :])
    with contextlib.suppress(UnreadableFileError, DataError):
        imported(h5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"lagbench": {"frames_of_interest": [99]}},
            "frame of interest",
        ),
        (
            {"lagbench": {"frames_of_interest": [-1]}},
            "frame of interest",
        ),
        (
            {"lagbench": {"cells": 10**9}},
            "--cells",
        ),
        (
            {"bounds": [[-1e308, 1e308], [0, 1]]},
            "--bounds",
        ),
        (
            {"default_connectivity_radius": 1e300},
            "--radius",
        ),
        (
            {"default_connectivity_radius": 1e-20},
            "have no neighbours",
        ),
        (
            {"dt": 1e-320},
            "--frame-interval",
        ),
    ],
)
def test_numbers_that_do_not_compute(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    """Metadata out of range are usage errors that name the option which overrules
    them.
    """
    with pytest.raises(UsageError, match=words):
        imported(write_gns(tmp_path / "in", straight_runs(3), **changes))
    assert not (tmp_path / "own").exists()


def test_metadata_that_are_a_pipe(tmp_path: Path) -> None:
    """A pipe waits for ever."""
    folder = write_gns(tmp_path / "in", straight_runs(3))
    (folder / "metadata.json").unlink()
    os.mkfifo(folder / "metadata.json")
    with pytest.raises(UnreadableFileError) as caught:
        imported(folder)
    assert "metadata.json" in str(caught.value.where)


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        (
            "no metadata",
            UnreadableFileError,
            "metadata.json",
        ),
        (
            "no json",
            UnreadableFileError,
            "metadata.json",
        ),
        (
            "no radius",
            UnreadableFileError,
            "key default_connectivity_radius",
        ),
        (
            "array for a group",
            UnreadableFileError,
            "no trajectory",
        ),
        (
            "nothing in an array",
            UnreadableFileError,
            "no values",
        ),
        (
            "3D",
            UnreadableFileError,
            "dimension",
        ),
        (
            "no test",
            UnreadableFileError,
            "files are missing",
        ),
        (
            "half a file",
            UnreadableFileError,
            "test.h5",
        ),
        (
            "no positions",
            UnreadableFileError,
            "no trajectory",
        ),
        (
            "too few kinds",
            UnreadableFileError,
            "no kinds of particles",
        ),
        (
            "empty",
            DataError,
            "a subset is empty",
        ),
        (
            "no time",
            UsageError,
            "no time between frames",
        ),
    ],
)
def test_damaged_sources_leave_nothing(
    h5: Path, fault: str, error: type[LagbenchError], words: str
) -> None:
    """Each error names its fault, and no folder appears."""
    target = h5 / "test.h5"
    metadata = h5 / "metadata.json"
    changes = {
        "no radius": {"default_connectivity_radius": None},
        "3D": {"dim": 3},
        "no time": {"dt": 0},
    }
    match fault:
        case "no metadata":
            metadata.unlink()
        case "no json":
            metadata.write_text("<html>")
        case "no radius" | "3D" | "no time":
            metadata.write_text(json.dumps({**METADATA, **changes[fault]}))
        case "no test":
            target.unlink()
        case "half a file":
            target.write_bytes(target.read_bytes()[:1000])
        case _:
            kinds = np.zeros(40, int)
            run = straight_runs(1)[0]
            held: dict[str, dict[str, Any]] = {
                "array for a group": {"00000": np.zeros(3)},
                "nothing in an array": {
                    "00000/position": h5py.Empty("f4"),
                    "00000/particle_type": kinds,
                },
                "no positions": {"00000/particle_type": kinds},
                "too few kinds": {
                    "00000/position": run,
                    "00000/particle_type": kinds[:39],
                },
                "empty": {},
            }
            with h5py.File(target, "w") as file:
                for name, values in held[fault].items():
                    file[name] = values
    with pytest.raises(error, match=words):
        imported(h5)
    assert [path.name for path in h5.parent.iterdir()] == ["in"]


@pytest.mark.parametrize(
    "arrays", [None, {"note": np.array("no trajectory")}, {"run": np.zeros((4, 3))}]
)
def test_a_damaged_npz_is_unreadable(
    gns: Path, tmp_path: Path, arrays: dict[str, Any] | None
) -> None:
    """Half an npz file, and a member that is no array or no trajectory, are unreadable
    files.
    """
    target = gns / "test.npz"
    if arrays is None:
        target.write_bytes(target.read_bytes()[: target.stat().st_size // 2])
    else:
        np.savez(target, **arrays)
    with refused(tmp_path, "npz"):
        imported(gns)


@pytest.mark.parametrize("fault", ["version", "name"])
def test_a_damaged_directory_of_an_npz_file_is_unreadable(
    gns: Path, tmp_path: Path, fault: str
) -> None:
    """A version that no program writes, and a name that is no text."""
    target = gns / "test.npz"
    raw = bytearray(target.read_bytes())
    central = raw.index(b"PK\x01\x02")
    if fault == "version":
        raw[central + 6] = 200
    else:
        raw[central + 9] |= 8  # the name is in UTF-8
        raw[central + 46] = 0xFF
    target.write_bytes(raw)
    with refused(tmp_path, target.name):
        imported(gns)


def test_two_trajectories_of_one_name_are_refused(gns: Path, tmp_path: Path) -> None:
    """A reader by names would take the last one twice and lose the first one."""
    target = gns / "train.npz"
    with zipfile.ZipFile(target, "a") as archive:
        (member,) = archive.namelist()
        archive.writestr(member.removesuffix(".npy"), archive.read(member))
    with refused(tmp_path, target.name):
        imported(gns)


@pytest.mark.parametrize("name", ["00000/position", "position"])
@pytest.mark.parametrize("way", ["soft", "external", "beside", "virtual", "raw"])
def test_a_file_that_leads_elsewhere_is_refused(
    h5: Path, tmp_path: Path, name: str, way: str
) -> None:
    """HDF5 and netCDF would take positions from wherever a stranger's file points to,
    imported or adopted.
    """
    bad = h5 / "train.h5"
    other = tmp_path / "other"
    run = straight_runs(1)[0]
    with h5py.File(other, "w") as file:
        file["there"] = run
    if name == "position":
        bad = tmp_path / "bad.nc"
    with h5py.File(bad, "w") as file:
        if name != "position":
            file["00000/particle_type"] = np.zeros(40, int)
        match way:
            case "soft":
                file["there"] = run
                file[name] = h5py.SoftLink("/there")
            case "external":
                file[name] = h5py.ExternalLink(str(other), "there")
            case "beside":
                file[name] = run
                file["a/wall_velocity"] = h5py.ExternalLink(str(other), "there")
            case "virtual":
                layout = h5py.VirtualLayout(shape=run.shape, dtype="f4")
                layout[:] = h5py.VirtualSource(str(other), "there", shape=run.shape)
                file.create_virtual_dataset(name, layout)
            case _:
                other.write_bytes(run.tobytes())
                file.create_dataset(
                    name, run.shape, "f4", external=[(str(other), 0, run.nbytes)]
                )
    led = "a/wall_velocity" if way == "beside" else name
    with refused(tmp_path, f"{bad.name}, {led!r}"):
        adopted(bad) if name == "position" else imported(h5)


@pytest.mark.parametrize("kind", ["empty chunks", "a hole", "classic", "npy", "rows"])
def test_a_sparse_file_fills_no_memory(tmp_path: Path, kind: str) -> None:
    """A few bytes on disk that claim 10^9 particles, or 10^12 trajectories, are refused
    by their header.
    """
    bad = tmp_path / ("bad.npy" if kind in ("npy", "rows") else "bad.nc")
    shape = (12, 10**9, 2)
    if kind == "classic":
        with netCDF4.Dataset(bad, "w", format="NETCDF3_64BIT_DATA") as file:
            file.set_fill_off()
            names = [file.createDimension(f"n{n}", n).name for n in shape]
            file.createVariable("position", "f4", names)
    elif kind in ("npy", "rows"):
        claimed = shape if kind == "npy" else (10**12, 0, 2, 2)
        with array_file(bad, claimed) as stream:
            stream.truncate(stream.tell() + 4 * int(np.prod(claimed)))
    else:
        with h5py.File(bad, "w") as file:
            if kind == "a hole":
                created = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
                created.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
                created.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
                space = h5py.h5s.create_simple(shape)
                h5py.h5d.create(
                    file.id, b"position", h5py.h5t.IEEE_F32LE, space, dcpl=created
                )
            else:
                file.create_dataset("position", shape, "f4", chunks=(1, 10**6, 2))
    assert bad.stat().st_blocks * 512 < 1 << 20
    with refused(tmp_path, bad.name, DataError):
        adopted(bad)


@pytest.mark.parametrize("form", ["NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF4"])
def test_every_netcdf_format_is_adopted(tmp_path: Path, form: Any) -> None:
    """Older formats too, and files with texts, a group and dimensions without values
    beside positions.
    """
    path = tmp_path / "own.nc"
    run = straight_runs(1)[0]
    with netCDF4.Dataset(path, "w", format=form) as file:
        names = [
            file.createDimension(name, n).name
            for name, n in zip("fps", run.shape, strict=True)
        ]
        file.createVariable("position", "f4", names)[:] = run
        file.createVariable("letters", "S1", names[-1:])
        if form == "NETCDF4":
            file.createVariable("names", str, names[-1:])[:] = np.array(
                ["x", "y"], object
            )
            file.createGroup("more").createVariable("note", "i4", ())
    assert adopted(path).scenarios == {
        "train": 1,
        "valid": 1,
        "test": 1,
    }


WALLS = np.zeros((4, 2))


@pytest.mark.parametrize("ending", ["npz", "nc"])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        (
            "wall_velocity",
            np.where(np.arange(8).reshape(4, 2) == 3, np.nan, WALLS),
        ),
        (
            "wall_velocity",
            WALLS + np.inf,
        ),
        (
            "wall_velocity",
            WALLS + 1e300,
        ),  # beyond float32, as which it is stored
        (
            "wall_velocity",
            WALLS + 1j,
        ),
        (
            "wall_velocity",
            WALLS.astype(str),
        ),
        (
            "wall_velocity",
            WALLS > 1,
        ),
        (
            "wall_velocity",
            WALLS[:3],
        ),
        (
            "velocity",
            np.zeros((12, 40, 2), complex),
        ),
        (
            "velocity",
            np.full((12, 40, 2), "fast"),
        ),
        (
            "velocity",
            np.full((12, 40, 2), np.nan),
        ),
        (
            "material",
            np.full(40, "liquid"),
        ),
        (
            "position",
            np.full((12, 40, 2), "here"),
        ),
    ],
)
def test_arrays_that_are_no_numbers_are_refused(
    tmp_path: Path, ending: str, name: str, values: np.ndarray
) -> None:
    """Texts, complex and missing numbers would fail halfway, or enter the hashes."""
    bad = tmp_path / f"bad.{ending}"
    arrays = {"position": straight_runs(1)[0], name: values}
    if ending == "npz":
        np.savez(bad, **arrays)  # type: ignore[arg-type]
    else:
        with h5py.File(bad, "w") as file:
            for key, array in arrays.items():
                file[key] = array.astype(object) if array.dtype.kind == "U" else array
    with refused(tmp_path, bad.name, DataError):
        adopted(bad)


@pytest.mark.parametrize("ending", ["npz", "npy"])
@pytest.mark.parametrize(
    "shape", [(99999999999, 4, 2), (2**40, 2**40, 2**40), (-12, -40, 2)]
)
def test_a_header_that_claims_other_values(
    tmp_path: Path, ending: str, shape: tuple[int, ...]
) -> None:
    """Far more than follow it, more than any memory holds, or fewer than none."""
    bad = tmp_path / f"bad.{ending}"
    with array_file(bad, shape) as stream:
        stream.write(straight_runs(1)[0].tobytes())
    with refused(tmp_path, bad.name):
        adopted(bad)


@pytest.mark.parametrize("fault", ["stream", "encrypted", "method", "version"])
def test_a_damaged_zip_is_refused_when_adopted(tmp_path: Path, fault: str) -> None:
    """Zip files that are wrong in themselves."""
    bad = tmp_path / "bad.npz"
    with array_file(bad, (12, 40, 2)) as stream:
        stream.write(straight_runs(1)[0].tobytes())
    raw = bytearray(bad.read_bytes())
    start = 30 + len("position.npy")
    central = raw.index(b"PK\x01\x02")
    match fault:
        case "stream":
            raw[start + 5 : start + 90] = b"\xff" * 85
        case "encrypted":
            raw[6] |= 1
            raw[central + 8] |= 1
        case "method":
            raw[8] = raw[central + 10] = 97
        case "version":
            raw[central + 6] = 99
    bad.write_bytes(raw)
    with refused(tmp_path, bad.name):
        adopted(bad)


ESCAPES = "\x1b]0;pwned\x07\x1b[2J\x9b2J\u202e\r\udc9bx"


@pytest.mark.parametrize("place", ["metadata", "pickle", "describe"])
def test_no_file_reaches_the_terminal(tmp_path: Path, place: str) -> None:
    """What a stranger's file says is shown with its control characters spelled out."""
    changes = {"bounds": ESCAPES} if place == "metadata" else {}
    source = write_gns(tmp_path / "in", straight_runs(3), **changes)
    words = [
        "import",
        str(source),
        "--format",
        "gns-npz",
        "-o",
        str(tmp_path / "own"),
    ]
    if place == "pickle":
        with array_file(source / "train.npz", (2,), "|O") as stream:
            name = ESCAPES[:-2].encode()
            stream.write(
                b"\x80\x04\x8c" + bytes([len(name)]) + name + b"\x8c\x01x\x93."
            )
    elif place == "describe":
        (tmp_path / "data.yaml").write_text(json.dumps({"radius": ESCAPES[:-2]}))
        words += ["--describe", str(tmp_path / "data.yaml")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code in (2, 3)
    assert r"\x1b]0;pwned\x07\x1b[2J\x9b2J\u202e\r" in done.output
    assert all(line.isprintable() for line in done.output.split("\n"))


@pytest.mark.parametrize(
    "parts",
    [
        (
            5,
            (1, np.array([1.0, 2.0])),
        ),  # ragged
        (
            (1, np.array([1, 2])),
            0.5,
        ),
        (5, 10**400),  # beyond any float
        (10**5000, 0.5),  # beyond what Python spells
        (5, float("nan")),
        (5, np.array([np.inf])),
    ],
)
def test_odd_parts_of_a_pickled_trajectory(
    gns: Path, tmp_path: Path, parts: tuple[Any, Any]
) -> None:
    """The errors of kinds and a material property that are not numbers name their
    key.
    """
    save_parts(gns, *parts)
    with refused(tmp_path, "simulation_0", DataError):
        imported(gns)


def test_a_number_for_a_trajectory(gns: Path) -> None:
    """A joint array may hold numbers of more digits than Python spells."""
    np.savez(gns / "train.npz", gns_data=np.array([10**5000, None], dtype=object)[:1])
    with pytest.raises(UnreadableFileError) as caught:
        imported(gns)
    assert caught.value.where.endswith("in/train.npz, key 'gns_data', item 0")


@pytest.mark.parametrize(
    "text",
    ["--5=drop", f"{'9' * 5000}=drop", "5-=drop", "\u0663=drop", "=drop", "-=drop"],
)
def test_kinds_that_are_no_numbers(text: str) -> None:
    """Only plain digits with one sign are numbers of kinds."""
    with pytest.raises(UsageError) as caught:
        parse_kinds(text)
    assert caught.value.where == "--kinds"


@pytest.mark.parametrize("text", ["3=jelly,3=snow", "0=drop,-0=snow"])
def test_a_kind_has_one_material(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_kinds(text)
    assert caught.value.where == "--kinds"
    assert "twice" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"position, velocity\n0.5, 0.25\n", "text"),
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "HDF5"),
        (b"\x80\x04]\x94.", "pickle"),
    ],
)
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_a_file_of_another_format_is_named(
    tmp_path: Path, ending: str, content: bytes, words: str
) -> None:
    """The name of its suffix does not hide what it is, nor does an error of Python."""
    paths = []
    for number in range(3):
        path = tmp_path / f"own{number}.{ending}"
        path.write_bytes(content)
        paths.append(path)
    with pytest.raises(UnreadableFileError) as caught:
        adopt(paths, output=tmp_path / "mine", **BASIC)
    assert "own" in str(caught.value.where)
    assert words in str(caught.value.got)
    assert "Error" not in str(caught.value.got)
    assert "BadZip" not in str(caught.value.got)


def test_a_text_in_place_of_an_imported_npz_file_is_named(gns: Path) -> None:
    """So the user sees that the download was a page."""
    (gns / "train.npz").write_text("<html>not found</html>")
    with pytest.raises(UnreadableFileError) as caught:
        imported(gns)
    assert "text" in str(caught.value.got)


def test_a_cut_npz_file_is_called_cut(tmp_path: Path) -> None:
    """Its first bytes are those of a zip archive."""
    paths = []
    for number, run in enumerate(straight_runs(3)):
        path = tmp_path / f"run{number}.npz"
        np.savez(path, position=run)
        paths.append(path)
    whole = paths[1].read_bytes()
    paths[1].write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UnreadableFileError) as caught:
        adopt(paths, output=tmp_path / "mine", **BASIC)
    assert "cut" in str(caught.value.got)
