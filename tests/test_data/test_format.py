"""Scenario files open anywhere, hash alike whoever wrote them, and tell when they are
damaged.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import independent_hash
import netCDF4
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenario_factory import DIMS, PARAMETERS, frames_of, make_key, write_scenario

from lagbench.data import MATERIALS
from lagbench.data.checksums import ContentHasher, file_sha256
from lagbench.data.scenario import check_scenario, read_scenario, rehash
from lagbench.data.writer import ScenarioWriter
from lagbench.errors import DataError, WorkFailedError
from lagbench.generators.split import Material

KEY = make_key()
TYPES = {
    **dict.fromkeys(("frame", "particle"), "int32"),
    **dict.fromkeys(("time", "particle_mass"), "float64"),
    **dict.fromkeys(("position", "velocity", "wall_velocity"), "float32"),
    "material": "int8",
}


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, str]:
    """A small cavity scenario and its content hash."""
    return write_scenario(tmp_path, KEY)


def damaged(
    path: Path, *parts: str, check: Callable[[Path], object] = check_scenario
) -> None:
    """Assert that a file is refused with its name and these parts, in this order or
    another.
    """
    with pytest.raises(DataError) as caught:
        check(path)
    text = str(caught.value)
    assert all(part in text for part in (path.name, *parts)), text


@pytest.mark.parametrize("engine", ["netcdf4", "h5netcdf"])
def test_xarray_opens_it_unaided(written: tuple[Path, str], engine: str) -> None:
    """Plain open_dataset gives the documented dims, types and coordinates."""
    if engine == "h5netcdf":
        pytest.importorskip("h5netcdf")
    path, _ = written
    with xr.open_dataset(path, engine=engine) as scenario:
        dims = {str(name): item.dims for name, item in scenario.variables.items()}
        assert dims == DIMS
        types = {name: str(scenario[name].dtype) for name in TYPES}
        assert types == TYPES
        assert set(scenario.coords) == {"frame", "time", "particle", "space", "wall"}
        assert list(scenario["space"].values) == ["x", "y"]
        assert list(scenario["wall"].values) == ["left", "right", "bottom", "top"]
        np.testing.assert_array_equal(scenario["position"], frames_of(3, 4, 8))
        np.testing.assert_array_equal(scenario["time"], np.arange(4) * 0.1)
        top_velocity = scenario["wall_velocity"][:, 3, 0]
        np.testing.assert_array_equal(top_velocity, 0.125)
        attributes = scenario.attrs
        assert attributes["Conventions"] == "CF-1.11"
        assert {name: attributes[name] for name in PARAMETERS} == PARAMETERS
        assert attributes["reynolds_number"] == 100.0
        assert scenario["material"].attrs["flag_meanings"].split() == list(MATERIALS)
    assert tuple(material.name.lower() for material in Material) == MATERIALS


def test_plain_h5py_opens_it(written: tuple[Path, str], tmp_path: Path) -> None:
    """Chunks hold one frame; the only filters are shuffle and zlib level 1.

    With one set of libraries even the packed bytes are the same: nothing depends on the
    clock.
    """
    with h5py.File(written[0]) as file:
        for name in ("position", "velocity"):
            variable = file[name]
            assert variable.chunks == (1, 8, 2)
            assert variable.compression == "gzip"
            assert variable.compression_opts == 1
            assert variable.shuffle
        np.testing.assert_array_equal(file["velocity"][...], -frames_of(3, 4, 8))
    first, _ = write_scenario(tmp_path / "a", KEY)
    second, _ = write_scenario(tmp_path / "b", KEY)
    assert file_sha256(first) == file_sha256(second)


def test_all_routes_to_the_content_hash_agree(written: tuple[Path, str]) -> None:
    """Ours, xarray's variables in memory, and thirty lines written from docs/format.md.

    Sixteen digits suffice where one is expected; another one is told. A patch release
    may better a long_name: no reader computes with it.
    """
    path, content = written
    assert (
        independent_hash.content_hash(path)
        == content
        == rehash(path)
        == check_scenario(path)
    )
    with xr.open_dataset(path) as scenario, read_scenario(path) as file:
        hasher = ContentHasher(KEY.identity(file.header.seed, file.header.parameters))
        for name, variable in scenario.variables.items():
            hasher.declare(str(name), variable.dtype, variable.dims, variable.shape)
            hasher.update(str(name), variable.values)
    assert hasher.hexdigest() == content
    assert check_scenario(path, content[:16]) == content
    with pytest.raises(
        DataError, match=r"(?s)another content hash.*expected: 0123.*got: " + content
    ):
        check_scenario(path, "0123456789abcdef")
    with h5py.File(path, "r+") as file:
        file["position"].attrs["long_name"] = "where the particles are"
    assert check_scenario(path) == content


def test_free_surface_files_have_no_walls(tmp_path: Path) -> None:
    """Without wall velocities there is neither a wall dimension nor a Reynolds
    number.
    """
    path, content = write_scenario(tmp_path, KEY, walls=False)
    with xr.open_dataset(path) as scenario:
        assert "wall" not in scenario.dims
        assert "reynolds_number" not in scenario.attrs
    assert check_scenario(path) == content == independent_hash.content_hash(path)


@settings(
    max_examples=20,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    parameters=st.dictionaries(
        st.from_regex("[a-z]{1,6}_p", fullmatch=True),
        st.one_of(
            st.booleans(),
            st.integers(-(2**63), 2**63 - 1),
            # Taichi, once started in this process, makes its thread round subnormals to
            # zero.
            st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False),
            st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1),
        ),
        max_size=4,
    ),
    seed=st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1),
)
def test_parameters_survive_the_file(
    tmp_path: Path, parameters: dict[str, Any], seed: str
) -> None:
    """What was hashed while writing is what two readers find, whatever the parameters
    are.
    """
    path, content = write_scenario(tmp_path, KEY, parameters=parameters, seed=seed)
    with read_scenario(path) as file:
        assert file.header.parameters == {**parameters, "reynolds_number": 100.0}
        assert file.header.seed == seed
    assert rehash(path) == content == independent_hash.content_hash(path)


@pytest.mark.parametrize("name", sorted(TYPES))
def test_every_variable_is_hashed_and_named(
    written: tuple[Path, str], name: str
) -> None:
    """Changing one value of any variable is found, and the error names file and
    variable.
    """
    path, content = written
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        file[name][...] = values + np.ones_like(values)
    assert rehash(path) != content
    damaged(path, "differ", f"variable '{name}'")


@pytest.mark.parametrize(
    "name", ["dt", "wall_moving", "seed", "scenario", "subset", "hashed_parameters"]
)
def test_changed_attributes_are_found(written: tuple[Path, str], name: str) -> None:
    """Parameters and identity enter the hash; the error says that attributes differ."""
    path, _ = written
    with netCDF4.Dataset(path, "r+") as file:
        file.setncattr(
            name,
            {"dt": 0.0021, "scenario": 4, "hashed_parameters": "dt"}.get(name, "other"),
        )
    damaged(path, "attributes differ", "attributes")


@pytest.mark.parametrize(
    ("variable", "name", "value"),
    [
        ("position", "scale_factor", 2.0),
        ("velocity", "add_offset", 1.0),
        ("position", "_FillValue", np.array([0.5], np.float32)),
        ("material", "missing_value", np.int8(0)),
        ("position", "valid_max", np.float32(0.5)),
        ("velocity", "valid_range", np.array([0.0, 0.5], np.float32)),
        ("material", "_Unsigned", "true"),
        ("position", "units", "m"),
        ("time", "units", "days since 2000-01-01"),
        ("material", "flag_meanings", "rope snow jelly liquid"),
        ("material", "flag_values", np.array([3, 2, 1, 0], np.int8)),
        ("velocity", "coordinates", None),
    ],
)
def test_attributes_that_change_the_meaning_are_refused(
    written: tuple[Path, str], variable: str, name: str, value: object
) -> None:
    """The values are the same, yet readers that follow CF would read others: file,
    variable, attribute.
    """
    path, content = written
    with h5py.File(path, "r+") as file:
        if value is None:
            del file[variable].attrs[name]
        else:
            file[variable].attrs[name] = value
    assert rehash(path) == content
    damaged(path, f"variable '{variable}'", name)


def test_flipped_byte_in_a_compressed_chunk_names_the_variable(tmp_path: Path) -> None:
    """Damage inside packed frames is told as damage of that variable, not as a
    traceback of HDF5.
    """
    path, _ = write_scenario(tmp_path, KEY, frames=4, particles=2000)
    with h5py.File(path) as file:
        offset = file["velocity"].id.get_chunk_info(2).byte_offset
    data = bytearray(path.read_bytes())
    data[offset + 100] ^= 1
    path.write_bytes(data)
    for check in (rehash, check_scenario):
        damaged(
            path, "damaged", "variable 'velocity'", "lagbench generate", check=check
        )


@pytest.mark.slow
def test_no_flipped_byte_escapes_as_another_error(written: tuple[Path, str]) -> None:
    """Each of 600 flips all over the file leaves the content as it is or gives a
    DataError.
    """
    path, content = written
    good = path.read_bytes()
    noticed = 0
    for offset in range(0, len(good), len(good) // 600):
        data = bytearray(good)
        data[offset] ^= 0x55
        path.write_bytes(data)
        try:
            found = check_scenario(path)
        except DataError as error:
            found = content if str(path) in str(error) else "an error without the path"
            noticed += 1
        assert found == content, f"byte {offset}"
    assert noticed >= 20
    for share in (0.0, 0.001, 0.3, 0.7, 0.999):  # cut anywhere
        path.write_bytes(good[: int(share * len(good))])
        damaged(path, "damaged")


def test_missing_foreign_and_impossible_files(
    written: tuple[Path, str], tmp_path: Path
) -> None:
    """Missing, somebody else's netCDF, a shape of terabytes in kilobytes, a type that
    no file of ours has.

    The operating system's refusal becomes exit code 5 with the path and a remedy.
    """
    damaged(tmp_path / "0000.nc", "missing", check=read_scenario)
    other = tmp_path / "other.nc"
    xr.Dataset({"a": ("b", [1.0])}).to_netcdf(other, engine="netcdf4")
    damaged(other, "not one of lagbench", check=read_scenario)
    old = tmp_path / "old.nc"  # has no HDF5 inside
    xr.Dataset({"a": ("b", [1.0])}).to_netcdf(
        old, engine="netcdf4", format="NETCDF3_CLASSIC"
    )
    damaged(old, "damaged", check=read_scenario)
    with h5py.File(other, "w") as file:
        file.create_dataset("position", (2**40,), "f4", chunks=(1024,))
    damaged(other, "larger than its file", "variable 'position'", check=read_scenario)
    with netCDF4.Dataset(written[0], "r+") as file:
        file.createVariable(
            "odd", file.createCompoundType(np.dtype([("a", "i4")]), "pair"), ()
        )
    damaged(written[0], "damaged", "variable 'odd'", check=rehash)
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "cavity").write_text("in the way")
    with pytest.raises(WorkFailedError) as caught:
        write_scenario(tmp_path / "root", KEY)
    assert caught.value.where.endswith("root/cavity/tiny/v2/test/0003.nc")
    assert caught.value.exit_code == 5


def writer(path: Path, **changes: Any) -> ScenarioWriter:
    """Return a writer of two frames of eight particles, unless told otherwise."""
    told: dict[str, Any] = {
        "particles": 8,
        "frames": 2,
        "frame_interval": 0.1,
        "particle_mass": 1.0,
    }
    told |= {
        "material": np.zeros(8),
        "parameters": {},
        "seed": "s",
        "device": "cpu",
        "generator": "g",
    }
    return ScenarioWriter(path, KEY, **(told | changes))


def test_other_readers_may_have_the_file_open(written: tuple[Path, str]) -> None:
    """HDF5 opens a file twice in a process only if both openings treat locks alike."""
    path, _ = written
    with h5py.File(path, "r"), read_scenario(path) as file, h5py.File(path, "r"):
        assert file.header.particles == 8


def _crowd(file: h5py.File) -> None:
    """Hide a link behind a thousand groups."""
    del file["frame"]
    file["frame"] = h5py.ExternalLink("other.nc", "/frame")
    for number in range(1000):
        file.create_group(f"a{number:04d}")


def _virtual(file: h5py.File) -> None:
    """Read values of another file, which need not be there."""
    layout = h5py.VirtualLayout(shape=(4, 8, 2), dtype="f4")
    layout[:] = h5py.VirtualSource("other.nc", "position", shape=(4, 8, 2))
    file.create_virtual_dataset("spin", layout)


def _named_like_a_dimension(file: h5py.File) -> None:
    """Name values like a dimension, although they are no scale: netCDF shows them."""
    file["spin"] = np.zeros((4, 8), np.float32)
    file["spin"].attrs["NAME"] = (
        "This is a netCDF dimension but not a netCDF variable.         4"
    )


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (
            lambda file: file.update({"too": h5py.SoftLink("/position")}),
            "'too' is a soft link",
        ),
        (
            lambda file: file.update({"too": h5py.ExternalLink("other.nc", "/a")}),
            "'too' is a external link",
        ),
        (_crowd, "members"),
        (_virtual, "'spin' lie elsewhere: virtual"),
        (_named_like_a_dimension, "spin"),
    ],
)
def test_what_other_readers_would_follow_or_show_is_damage(
    written: tuple[Path, str], harm: Callable[[h5py.File], None], said: str
) -> None:
    """Links and virtual data sets are not followed, and no member is beyond the
    count.
    """
    path, _ = written
    with h5py.File(path, "r+") as file:
        harm(file)
    damaged(path, "damaged", said, check=read_scenario)


def test_texts_that_are_no_texts_are_damage(written: tuple[Path, str]) -> None:
    """Bytes that are no UTF-8 in a text of no set length change the hash, and raise
    nothing else.
    """
    path, content = written
    with h5py.File(path, "r+") as file:
        del file.attrs["seed"]
        file.attrs.create("seed", b"\xff\xfe", dtype=h5py.string_dtype("utf-8"))
    assert rehash(path) != content
    damaged(path, "attributes differ")


def test_reading_parts(written: tuple[Path, str]) -> None:
    """Method read takes frames or slices, blocks stream everything in order, unknown
    names are told.
    """
    path, _ = written
    truth = frames_of(3, 4, 8)
    with read_scenario(path) as file:
        np.testing.assert_array_equal(file.read("position", 2), truth[2])
        np.testing.assert_array_equal(file.read("position", slice(1, 3)), truth[1:3])
        np.testing.assert_array_equal(
            np.concatenate(list(file.blocks("position"))), truth
        )
        assert file.read("particle_mass") == 1e-4 / 8
        assert file.header.frames == 4
        assert file.header.particles == 8
        assert file.header.key == KEY
        with pytest.raises(DataError) as caught:
            file.read("density")
        assert caught.value.where.endswith(
            "cavity/tiny/v2/test/0003.nc, variable 'density'"
        )


def test_what_is_known_at_last_is_hashed_like_what_is_known_at_first(
    tmp_path: Path,
) -> None:
    """A parameter stated after the frames gives the file that has it from the start."""
    frames = frames_of(3, 4, 8)
    digests = []
    for place, (first, last) in enumerate(
        [({"a": 1, "b": 2}, {}), ({"a": 1}, {"b": 2})]
    ):
        path = tmp_path / f"{place}.nc"
        with writer(path, frames=4, parameters=first) as file:
            for position in frames:
                file.append(position, -position)
            with pytest.raises(DataError):
                file.state(seed=1)
            file.state(**last)
        digests.append(file.content_sha256)
        assert check_scenario(path) == file.content_sha256
        with read_scenario(path) as file:
            assert file.header.parameters == {"a": 1, "b": 2}
    assert digests[0] == digests[1]


def test_wrong_frames_are_refused(tmp_path: Path) -> None:
    """Shape, type and number of frames; neither a file nor a temporary one appears, an
    old file survives.
    """
    path, content = write_scenario(tmp_path, KEY)
    frame = np.zeros((8, 2), np.float32)
    for pieces, said in {
        (8, 4): r"(?s)wrong shape.*'velocity'",
        (1, 8): r"(?s)wrong shape.*'position'",
        (8, 8): r"(?s)values are missing.*'position'",
    }.items():
        with pytest.raises(DataError, match=said), writer(path) as file:
            file.append(*(frame[:length] for length in pieces))
    with (
        pytest.raises(DataError, match=r"(?s)another type.*'position'"),
        writer(path) as file,
    ):
        file.append(frame.astype(np.float64), frame)
    assert check_scenario(path) == content
    assert list(path.parent.iterdir()) == [path]
    with writer(tmp_path / "c.nc") as file:
        file.append(frame, frame)
        file.append(frame, frame)
        with pytest.raises(DataError) as caught:
            file.append(frame, frame)
        assert caught.value.where == "variable 'position'"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, 1) for name in ("seed", "content_sha256", "two words", "")),
        *(("depth", value) for value in ("", [1], {"a": 1}, np.array([1, 2]))),
    ],
)
def test_parameters_that_cannot_be_stored(
    tmp_path: Path, name: str, value: object
) -> None:
    """Names that would hide an attribute of the format, what netCDF would give back as
    something else.
    """
    with pytest.raises(DataError) as caught:
        write_scenario(tmp_path, KEY, parameters={name: value})
    assert caught.value.where.endswith("cavity/tiny/v2/test/0003.nc")
