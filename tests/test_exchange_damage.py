"""Imports of what is damaged, made to do harm, or out of range: an error by name, and nothing left."""

from __future__ import annotations

import codecs
import contextlib
import json
import resource
import zipfile
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pytest
from exchange_readers import straight_runs
from exchange_writers import METADATA, write_gns, write_h5
from typer.testing import CliRunner

from lagbench.__main__ import app
from lagbench.errors import DataError, LagbenchError, UnreadableFileError, UsageError
from lagbench.exchange import adopt, import_split, trajectory
from lagbench.exchange.metadata import parse_kinds


class _Trap:
    """Pickles as a call that writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, "run")


@pytest.mark.parametrize("allow", [False, True])
def test_a_malicious_pickle_is_never_run(tmp_path: Path, allow: bool) -> None:
    """A pickle that calls anything but NumPy's constructors is refused even when pickles are allowed.

    Where they are not, nothing of gns-npz is read, and the message names the flag.
    """
    source = write_gns(tmp_path / "in", straight_runs(3))
    pair = np.empty(2, dtype=object)
    pair[0], pair[1] = straight_runs(1)[0], _Trap(tmp_path / "trace")
    np.savez(source / "train.npz", simulation_0=pair)
    with pytest.raises(LagbenchError) as caught:
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=allow)
    assert not (tmp_path / "trace").exists()
    assert isinstance(caught.value, UnreadableFileError if allow else UsageError)
    assert ("wants to call" if allow else "--allow-pickle") in str(caught.value)
    assert not (tmp_path / "own").exists()
    with np.load(source / "train.npz", allow_pickle=True) as file:  # numpy's own reader does run it
        file["simulation_0"]
    assert (tmp_path / "trace").exists()


class _Reduced:
    """Pickles as a call with a state."""

    def __init__(self, *reduced: Any) -> None:
        self.reduced = reduced

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


ADDRESSES = b"A" * 16
OBJECTS_WITHOUT_FLAGS = _Reduced(
    np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0)
)  # NumPy takes the values of such a type for addresses of objects
MANY = [np.zeros(1)] * 4


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (
            _Reduced(
                np.zeros(0).__reduce__()[0],
                (np.ndarray, (0,), b"b"),
                (1, (2,), OBJECTS_WITHOUT_FLAGS, False, ADDRESSES),
            ),
            "bytes for the objects",
        ),
        (_Reduced(np.float64(0).__reduce__()[0], (OBJECTS_WITHOUT_FLAGS, ADDRESSES[:8])), "wants to call"),
        (_Reduced(np.ndarray, ((1 << 45,), np.dtype("f8"))), "make an array by itself"),
        (_Reduced(codecs.encode, ("x", "punycode")), "wants to call"),
        ("text", "holds a str"),
        (MANY, "holds a list"),
    ],
)
def test_no_pickle_gets_at_memory(tmp_path: Path, item: Any, words: str) -> None:
    """Made-up objects, addresses, giant arrays and codecs are refused before NumPy sees them."""
    source = write_gns(tmp_path / "in", straight_runs(3), kinds=5)
    pair = np.empty(2, dtype=object)
    pair[0], pair[1] = straight_runs(1)[0], item
    np.savez(source / "train.npz", simulation_0=pair)
    with pytest.raises(UnreadableFileError, match=words):
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)


@pytest.mark.parametrize(
    "program",
    [
        b"\x80\x04Nr\xf0\xff\xff\xff.",  # remembers nothing, under the number 4294967280
        b"\x80\x04\x8e" + (1 << 40).to_bytes(8, "little") + b"short.",  # announces a terabyte
        b"\x80\x04\x8e" + b"\xff" * 8 + b".",
        b"\x80\x04(" * 99 + b".",  # marks that nothing ends
        b"\x80\x04" + b"]" * (1 << 25) + b".",  # lists, 56 bytes for each byte
    ],
)
def test_no_pickle_reserves_memory(tmp_path: Path, program: bytes) -> None:
    """What a pickle announces and does not hold is refused before anything is reserved for it."""
    source = write_gns(tmp_path / "in", straight_runs(3))
    with (
        zipfile.ZipFile(source / "train.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("simulation_0.npy", "w") as stream,
    ):
        header = {"descr": "|O", "fortran_order": False, "shape": (2,)}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(program)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (1 << 30), hard))
    try:
        with pytest.raises(UnreadableFileError) as caught:
            import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert "MemoryError" not in str(caught.value)


def test_filters_upon_filters_are_refused(tmp_path: Path) -> None:
    """Deflated four times, a chunk of a few hundred bytes would fill the memory on its way."""
    source = write_h5(tmp_path / "in", straight_runs(3))
    with h5py.File(source / "train.h5", "w") as file:
        group = file.create_group("00000")
        group["particle_type"] = np.zeros(40, int)
        created = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        created.set_chunk((1, 40, 2))
        for _ in range(4):
            created.set_deflate(9)
        space = h5py.h5s.create_simple((12, 40, 2))
        stored = h5py.h5d.create(group.id, b"position", h5py.h5t.IEEE_F32LE, space, dcpl=created)
        h5py.Dataset(stored)[:] = straight_runs(1)[0]
    with pytest.raises(UnreadableFileError) as caught:
        import_split(source, format="lagrangebench-h5", output=tmp_path / "own")
    assert "position" in str(caught.value.where)


def test_a_file_that_unpacks_to_far_more_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A member of 8 MB of zeros in 8 kB of npz, and arrays of 10^11 particles in an empty HDF5 file."""
    monkeypatch.setattr(trajectory, "HARMLESS", 1 << 20)
    source = write_gns(tmp_path / "in", straight_runs(3))
    with (
        zipfile.ZipFile(source / "train.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("simulation_0.npy", "w") as stream,
    ):
        stream.write(bytes(1 << 23))
    with pytest.raises(UnreadableFileError, match="far more than it holds"):
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)
    write_h5(source, straight_runs(3))
    with h5py.File(source / "train.h5", "w") as file:
        file.create_dataset("00000/position", shape=(12, 10**11, 2), dtype="f4", chunks=(1, 1000, 2))
        file.create_dataset("00000/particle_type", shape=(10**11,), dtype="i8", chunks=(1000,))
    with pytest.raises(UnreadableFileError) as caught:
        import_split(source, format="lagrangebench-h5", output=tmp_path / "own")
    assert "00000/" in str(caught.value.where)


@pytest.mark.parametrize("place", [5, 6, 7])
def test_damaged_bytes_of_hdf5_are_told(tmp_path: Path, place: int) -> None:
    """Whatever HDF5 raises where its structures are overwritten, it becomes an error of ours."""
    source = write_h5(tmp_path / "in", straight_runs(3))
    whole = (source / "train.h5").read_bytes()
    start = 96 + 100 * place  # past the superblock: headers, heaps and trees
    (source / "train.h5").write_bytes(whole[:start] + b"\xad" * 100 + whole[start + 100 :])
    with contextlib.suppress(UnreadableFileError, DataError):
        import_split(source, format="lagrangebench-h5", output=tmp_path / "own")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lagbench": {"frames_of_interest": [99]}}, "frame of interest is not predicted"),
        ({"lagbench": {"frames_of_interest": [-1]}}, "frame of interest is not predicted"),
        ({"lagbench": {"cells": 10**9}}, "--cells"),
        ({"bounds": [[-1e308, 1e308], [0, 1]]}, "--bounds"),
        ({"default_connectivity_radius": 1e300}, "--radius"),
        ({"default_connectivity_radius": 1e-20}, "have no neighbours"),
        ({"dt": 1e-320}, "--frame-interval"),
    ],
)
def test_numbers_that_do_not_compute(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    """Metadata out of range are usage errors that name the option which overrules them."""
    source = write_gns(tmp_path / "in", straight_runs(3), **changes)
    with pytest.raises(UsageError, match=words):
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ("no metadata", UnreadableFileError, "cannot read the metadata"),
        ("no json", UnreadableFileError, "cannot read the metadata"),
        ("no radius", UnreadableFileError, "key default_connectivity_radius"),
        ("array for a group", UnreadableFileError, "no trajectory"),
        ("nothing in an array", UnreadableFileError, "no values"),
        ("3D", UnreadableFileError, "not plane"),
        ("no test", UnreadableFileError, "files are missing"),
        ("half a file", UnreadableFileError, "cannot read the file"),
        ("no positions", UnreadableFileError, "no trajectory"),
        ("too few kinds", UnreadableFileError, "no kinds of particles"),
        ("empty", DataError, "a subset is empty"),
        ("no time", UsageError, "no time between frames"),
    ],
)
def test_damaged_sources_leave_nothing(
    tmp_path: Path, fault: str, error: type[LagbenchError], words: str
) -> None:
    """Each fault is told by name, and no folder is made."""
    source = write_h5(tmp_path / "in", straight_runs(3))
    target = source / "test.h5"
    metadata = source / "metadata.json"
    match fault:
        case "no metadata":
            metadata.unlink()
        case "no json":
            metadata.write_text("<html>")
        case "no radius":
            metadata.write_text(json.dumps({**METADATA, "default_connectivity_radius": None}))
        case "3D":
            metadata.write_text(json.dumps({**METADATA, "dim": 3}))
        case "no time":
            metadata.write_text(json.dumps({**METADATA, "dt": 0}))
        case "no test":
            target.unlink()
        case "half a file":
            target.write_bytes(target.read_bytes()[:1000])
        case _:
            with h5py.File(target, "w") as file:
                if fault == "array for a group":
                    file["00000"] = np.zeros(3)
                elif fault == "nothing in an array":
                    file["00000/position"] = h5py.Empty("f4")
                    file["00000/particle_type"] = np.zeros(40, int)
                elif fault == "no positions":
                    file["00000/particle_type"] = np.zeros(40, int)
                elif fault == "too few kinds":
                    file["00000/position"] = straight_runs(1)[0]
                    file["00000/particle_type"] = np.zeros(39, int)
    with pytest.raises(error, match=words):
        import_split(source, format="lagrangebench-h5", output=tmp_path / "own")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("arrays", [None, {"note": np.array("no trajectory")}, {"run": np.zeros((4, 3))}])
def test_a_damaged_npz_is_told(tmp_path: Path, arrays: dict[str, Any] | None) -> None:
    """Half an npz file, and a member that is no array or no trajectory, are unreadable files."""
    source = write_gns(tmp_path / "in", straight_runs(3))
    target = source / "test.npz"
    if arrays is None:
        target.write_bytes(target.read_bytes()[: target.stat().st_size // 2])
    else:
        np.savez(target, **arrays)
    with pytest.raises(UnreadableFileError, match="npz"):
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize("way", ["soft", "external", "virtual"])
def test_a_file_that_leads_elsewhere_is_refused(tmp_path: Path, way: str) -> None:
    """Links, virtual data sets and external storage would let a stranger's file read others."""
    source = write_h5(tmp_path / "in", straight_runs(3))
    other = tmp_path / "other.h5"
    (source / "train.h5").rename(other)
    with h5py.File(source / "train.h5", "w") as file:
        if way == "soft":
            file["there"] = straight_runs(1)[0]
            file["00000/position"] = h5py.SoftLink("/there")
        elif way == "external":
            file["00000"] = h5py.ExternalLink(str(other), "00000")
        else:
            layout = h5py.VirtualLayout(shape=(12, 40, 2), dtype="f4")
            layout[:] = h5py.VirtualSource(str(other), "00000/position", shape=(12, 40, 2))
            file.create_virtual_dataset("00000/position", layout)
            file["00000/particle_type"] = np.zeros(40, int)
    with pytest.raises(UnreadableFileError) as caught:
        import_split(source, format="lagrangebench-h5", output=tmp_path / "own")
    assert "00000" in str(caught.value.where)


BASIC: dict[str, Any] = {"radius": 0.1, "frame_interval": 0.25}


def with_good(tmp_path: Path, bad: Path) -> list[Path]:
    """Return two files with a trajectory each, then a bad one."""
    (tmp_path / "in").mkdir(exist_ok=True)
    for number, run in enumerate(straight_runs(2)):
        np.save(tmp_path / "in" / f"{number}.npy", run)
    return [*sorted((tmp_path / "in").glob("?.npy")), bad]


@pytest.mark.parametrize("way", ["link", "group", "virtual", "raw"])
def test_adopted_netcdf_reads_no_other_file(tmp_path: Path, way: str) -> None:
    """NetCDF's own reader would take positions from wherever a stranger's file points to."""
    (tmp_path / "in").mkdir()
    bad, other, run = tmp_path / "in" / "bad.nc", tmp_path / "in" / "other", straight_runs(1)[0]
    with h5py.File(other, "w") as file:
        file["position"] = run
    with h5py.File(bad, "w") as file:
        if way == "link":
            file["position"] = h5py.ExternalLink(str(other), "position")
        elif way == "group":
            file["position"] = run
            file["a/wall_velocity"] = h5py.ExternalLink(str(other), "position")
        elif way == "virtual":
            layout = h5py.VirtualLayout(shape=run.shape, dtype="f4")
            layout[:] = h5py.VirtualSource(str(other), "position", shape=run.shape)
            file.create_virtual_dataset("position", layout)
        else:
            other.write_bytes(run.tobytes())
            file.create_dataset("position", run.shape, "f4", external=[(str(other), 0, run.nbytes)])
    with pytest.raises(UnreadableFileError) as caught:
        adopt(with_good(tmp_path, bad), output=tmp_path / "own", **BASIC)
    assert "bad.nc" in str(caught.value.where)
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize("kind", ["empty chunks", "a hole", "classic", "npy", "rows"])
def test_a_sparse_file_fills_no_memory(tmp_path: Path, kind: str) -> None:
    """A few bytes on disk that claim 10^9 particles, or 10^12 trajectories, are refused by their header."""
    (tmp_path / "in").mkdir()
    bad = tmp_path / "in" / ("bad.npy" if kind in ("npy", "rows") else "bad.nc")
    shape = (12, 10**9, 2)
    if kind == "classic":
        with netCDF4.Dataset(bad, "w", format="NETCDF3_64BIT_DATA") as file:
            file.set_fill_off()
            names = [file.createDimension(f"n{n}", n).name for n in shape]
            file.createVariable("position", "f4", names)
    elif kind in ("npy", "rows"):
        claimed = shape if kind == "npy" else (10**12, 0, 2, 2)
        with bad.open("wb") as stream:
            header = {"descr": "<f4", "fortran_order": False, "shape": claimed}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.truncate(stream.tell() + 4 * int(np.prod(claimed)))
    else:
        with h5py.File(bad, "w") as file:
            if kind == "a hole":
                created = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
                created.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
                created.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
                space = h5py.h5s.create_simple(shape)
                h5py.h5d.create(file.id, b"position", h5py.h5t.IEEE_F32LE, space, dcpl=created)
            else:
                file.create_dataset("position", shape, "f4", chunks=(1, 10**6, 2))
    assert bad.stat().st_blocks * 512 < 1 << 20
    with pytest.raises((UnreadableFileError, DataError)) as caught:
        adopt(with_good(tmp_path, bad), output=tmp_path / "own", **BASIC)
    assert bad.name in str(caught.value.where)
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize("form", ["NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF4"])
def test_every_netcdf_format_is_adopted(tmp_path: Path, form: Any) -> None:
    """Older formats too, and files with texts, a group and dimensions without values beside positions."""
    (tmp_path / "in").mkdir()
    path, run = tmp_path / "in" / "own.nc", straight_runs(1)[0]
    with netCDF4.Dataset(path, "w", format=form) as file:
        names = [file.createDimension(name, n).name for name, n in zip("fps", run.shape, strict=True)]
        file.createVariable("position", "f4", names)[:] = run
        file.createVariable("letters", "S1", names[-1:])
        if form == "NETCDF4":
            file.createVariable("names", str, names[-1:])[:] = np.array(["x", "y"], object)
            file.createGroup("more").createVariable("note", "i4", ())
    made = adopt(with_good(tmp_path, path), output=tmp_path / "own", **BASIC)
    assert made.scenarios == {"train": 1, "valid": 1, "test": 1}


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write named arrays to an .npz file, or as netCDF's reader takes them."""
    if path.suffix == ".npz":
        np.savez(path, **arrays)  # type: ignore[arg-type]
        return
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values.astype(object) if values.dtype.kind == "U" else values


WALLS = np.zeros((4, 2))


@pytest.mark.parametrize("ending", ["npz", "nc"])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("wall_velocity", np.where(np.arange(8).reshape(4, 2) == 3, np.nan, WALLS)),
        ("wall_velocity", WALLS + np.inf),
        ("wall_velocity", WALLS + 1e300),  # beyond float32, as which it is stored
        ("wall_velocity", WALLS + 1j),
        ("wall_velocity", WALLS.astype(str)),
        ("wall_velocity", WALLS > 1),
        ("wall_velocity", WALLS[:3]),
        ("velocity", np.zeros((12, 40, 2), complex)),
        ("velocity", np.full((12, 40, 2), "fast")),
        ("velocity", np.full((12, 40, 2), np.nan)),
        ("material", np.full(40, "liquid")),
        ("position", np.full((12, 40, 2), "here")),
    ],
)
def test_arrays_that_are_no_numbers_are_refused(
    tmp_path: Path, ending: str, name: str, values: np.ndarray
) -> None:
    """Texts, complex and missing numbers would fail halfway, or enter the hashes."""
    (tmp_path / "in").mkdir()
    bad = tmp_path / "in" / f"bad.{ending}"
    write_arrays(bad, {"position": straight_runs(1)[0], name: values})
    with pytest.raises((UnreadableFileError, DataError)) as caught:
        adopt(with_good(tmp_path, bad), output=tmp_path / "own", as_is=True, **BASIC)
    assert bad.name in str(caught.value.where)
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize(
    "fault", ["stream", "encrypted", "method", "claim", "product", "negative", "version"]
)
def test_a_damaged_npz_is_told_when_adopted(tmp_path: Path, fault: str) -> None:
    """Zip files and headers of arrays that are wrong in themselves, or want more memory than they fill."""
    (tmp_path / "in").mkdir()
    bad = tmp_path / "in" / "bad.npz"
    shapes = {"claim": (99999999999, 4, 2), "product": (2**40, 2**40, 2**40), "negative": (-12, -40, 2)}
    with (
        zipfile.ZipFile(bad, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("position.npy", "w") as stream,
    ):
        header = {"descr": "<f4", "fortran_order": False, "shape": shapes.get(fault, (12, 40, 2))}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(straight_runs(1)[0].tobytes())
    raw = bytearray(bad.read_bytes())
    start, central = 30 + len("position.npy"), raw.index(b"PK\x01\x02")
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
    with pytest.raises(UnreadableFileError) as caught:
        adopt(with_good(tmp_path, bad), output=tmp_path / "own", **BASIC)
    assert bad.name in str(caught.value.where)
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize("shape", [(99999999999, 4, 2), (2**40, 2**40, 2**40), (-12, -40, 2)])
def test_a_damaged_npy_is_told_when_adopted(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """A header that claims other values than follow it."""
    (tmp_path / "in").mkdir()
    bad = tmp_path / "in" / "bad.npy"
    with bad.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
        stream.write(straight_runs(1)[0].tobytes())
    with pytest.raises(UnreadableFileError) as caught:
        adopt(with_good(tmp_path, bad), output=tmp_path / "own", **BASIC)
    assert bad.name in str(caught.value.where)


ESCAPES = "\x1b]0;pwned\x07\x1b[2J\x9b2J\u202e\r\udc9bx"


@pytest.mark.parametrize("place", ["metadata", "pickle", "describe"])
def test_no_file_reaches_the_terminal(tmp_path: Path, place: str) -> None:
    """What a stranger's file says is shown with its control characters spelled out."""
    source = write_gns(
        tmp_path / "in", straight_runs(3), **({"bounds": ESCAPES} if place == "metadata" else {})
    )
    words = ["import", str(source), "--format", "gns-npz", "--allow-pickle", "-o", str(tmp_path / "own")]
    if place == "pickle":
        with (
            zipfile.ZipFile(source / "train.npz", "w") as archive,
            archive.open("simulation_0.npy", "w") as stream,
        ):
            header = {"descr": "|O", "fortran_order": False, "shape": (2,)}
            np.lib.format.write_array_header_1_0(stream, header)
            name = ESCAPES[:-2].encode()
            stream.write(b"\x80\x04\x8c" + bytes([len(name)]) + name + b"\x8c\x01x\x93.")
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
        (5, (1, np.array([1.0, 2.0]))),  # ragged
        ((1, np.array([1, 2])), 0.5),
        (5, 10**400),  # beyond any float
        (10**5000, 0.5),  # beyond what Python spells
        (5, float("nan")),
        (5, np.array([np.inf])),
    ],
)
def test_odd_parts_of_a_pickled_trajectory(tmp_path: Path, parts: tuple[Any, Any]) -> None:
    """Kinds and a material property that are no numbers are told by the key they stand at."""
    source = write_gns(tmp_path / "in", straight_runs(3))
    item = np.empty(3, dtype=object)
    item[0], item[1], item[2] = straight_runs(1)[0], *parts
    np.savez(source / "train.npz", simulation_0=item)
    with pytest.raises((UnreadableFileError, DataError)) as caught:
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)
    assert "simulation_0" in str(caught.value.where)
    assert not (tmp_path / "own").exists()


def test_a_number_for_a_trajectory(tmp_path: Path) -> None:
    """A joint array may hold numbers of more digits than Python spells."""
    source = write_gns(tmp_path / "in", straight_runs(3))
    np.savez(source / "train.npz", gns_data=np.array([10**5000, None], dtype=object)[:1])
    with pytest.raises(UnreadableFileError, match="no trajectory"):
        import_split(source, format="gns-npz", output=tmp_path / "own", allow_pickle=True)


@pytest.mark.parametrize(
    "text", ["--5=drop", f"{'9' * 5000}=drop", "5-=drop", "\u0663=drop", "=drop", "-=drop"]
)
def test_kinds_that_are_no_numbers(text: str) -> None:
    """Only plain digits with one sign are numbers of kinds."""
    with pytest.raises(UsageError) as caught:
        parse_kinds(text)
    assert caught.value.where == "--kinds"
