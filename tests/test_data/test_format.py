"""Scenario files: other readers, content hashes, and damage."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from contextlib import suppress
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
from numpy.testing import assert_array_equal
from scenario_factory import DIMS, PARAMETERS, frames_of, make_key, write_scenario

from lagbench.data import MATERIALS
from lagbench.data.checksums import ContentHasher, file_sha256
from lagbench.data.scenario import check_scenario, damage_error, read_scenario, rehash
from lagbench.data.writer import ScenarioWriter
from lagbench.errors import DataError, WorkFailedError
from lagbench.generators.split import Material

KEY = make_key()
TYPES = {
    "frame": "int32",
    "particle": "int32",
    "time": "float64",
    "particle_mass": "float64",
    "position": "float32",
    "velocity": "float32",
    "wall_velocity": "float32",
    "material": "int8",
}


Written = tuple[Path, str]


@pytest.fixture
def written(tmp_path: Path) -> Written:
    """A small cavity scenario and its content hash."""
    return write_scenario(tmp_path, KEY)


def assert_refused(
    path: Path,
    *parts: str,
    check: Callable[[Path], object] = check_scenario,
) -> None:
    """Assert that the error of a check has the name of the file and these parts."""
    with pytest.raises(DataError) as caught:
        check(path)
    message = str(caught.value)
    for part in (path.name, *parts):
        assert part in message


@pytest.mark.parametrize("engine", ["netcdf4", "h5netcdf"])
def test_xarray_opens_it_unaided(written: Written, engine: str) -> None:
    """Plain open_dataset gives the documented dims, types and coordinates."""
    path, _ = written
    with xr.open_dataset(path, engine=engine) as scenario:
        dims = {}
        types = {}
        for name, variable in scenario.variables.items():
            dims[str(name)] = variable.dims
            if name in TYPES:
                types[str(name)] = str(variable.dtype)
        assert dims == DIMS
        assert types == TYPES
        coordinates = {"frame", "time", "particle", "space", "wall"}
        assert set(scenario.coords) == coordinates
        space = list(scenario["space"].values)
        assert space == ["x", "y"]
        walls = list(scenario["wall"].values)
        assert walls == ["left", "right", "bottom", "top"]
        positions = frames_of(3, 4, 8)
        assert_array_equal(scenario["position"], positions)
        times = 0.1 * np.arange(4)
        assert_array_equal(scenario["time"], times)
        top_velocity = scenario["wall_velocity"][:, 3, 0]
        assert_array_equal(top_velocity, 0.125)
        attributes = scenario.attrs
        assert attributes["Conventions"] == "CF-1.11"
        parameters = {name: attributes[name] for name in PARAMETERS}
        assert parameters == PARAMETERS
        assert attributes["reynolds_number"] == 100.0
        meanings = scenario["material"].attrs["flag_meanings"]
    assert meanings.split() == list(MATERIALS)
    names = tuple(material.name.lower() for material in Material)
    assert names == MATERIALS


def test_plain_h5py_opens_it(written: Written) -> None:
    """Chunks hold one frame; the only filters are shuffle and zlib level 1."""
    path, _ = written
    with h5py.File(path) as file:
        for name in ("position", "velocity"):
            variable = file[name]
            assert variable.chunks == (1, 8, 2)
            assert variable.compression == "gzip"
            assert variable.compression_opts == 1
            assert variable.shuffle
        velocities = -frames_of(3, 4, 8)
        assert_array_equal(file["velocity"][...], velocities)


def test_equal_scenarios_have_equal_bytes(tmp_path: Path) -> None:
    """With one set of libraries nothing depends on the clock."""
    first, _ = write_scenario(tmp_path / "a", KEY)
    second, _ = write_scenario(tmp_path / "b", KEY)
    assert file_sha256(first) == file_sha256(second)


def test_all_routes_to_the_content_hash_agree(written: Written) -> None:
    """By lagbench, from xarray, and by code written after docs/format.md."""
    path, content = written
    assert rehash(path) == content
    assert check_scenario(path) == content
    assert independent_hash.content_hash(path) == content
    with read_scenario(path) as file:
        header = file.header
    identity = KEY.identity(header.seed, header.parameters)
    hasher = ContentHasher(identity)
    with xr.open_dataset(path) as scenario:
        for key, variable in scenario.variables.items():
            name = str(key)
            hasher.declare(name, variable.dtype, variable.dims, variable.shape)
            hasher.update(name, variable.values)
    assert hasher.hexdigest() == content


def test_sixteen_digits_of_an_expected_hash_suffice(written: Written) -> None:
    path, content = written
    assert check_scenario(path, content[:16]) == content
    message = r"(?s)another content hash.*expected: 0123.*got: " + content
    with pytest.raises(DataError, match=message):
        check_scenario(path, "0123456789abcdef")


def test_a_patch_release_may_change_a_long_name(written: Written) -> None:
    """No reader computes with it."""
    path, content = written
    with h5py.File(path, "r+") as file:
        file["position"].attrs["long_name"] = "where the particles are"
    assert check_scenario(path) == content


def test_free_surface_files_have_no_walls(tmp_path: Path) -> None:
    """Without wall velocities there is no Reynolds number either."""
    path, content = write_scenario(tmp_path, KEY, walls=False)
    with xr.open_dataset(path) as scenario:
        assert "wall" not in scenario.dims
        assert "reynolds_number" not in scenario.attrs
    assert check_scenario(path) == content
    assert independent_hash.content_hash(path) == content


CHARACTERS = st.characters(codec="utf-8", exclude_characters="\0")
TEXTS = st.text(CHARACTERS, min_size=1)


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
            st.floats(
                allow_nan=False,
                allow_infinity=False,
                allow_subnormal=False,
            ),
            TEXTS,
        ),
        max_size=4,
    ),
    seed=TEXTS,
)
def test_parameters_survive_the_file(
    tmp_path: Path, parameters: dict[str, Any], seed: str
) -> None:
    """Two readers find the hash of the writer, whatever the parameters are."""
    path, content = write_scenario(
        tmp_path,
        KEY,
        parameters=parameters,
        seed=seed,
    )
    with read_scenario(path) as file:
        expected = parameters | {"reynolds_number": 100.0}
        assert file.header.parameters == expected
        assert file.header.seed == seed
    assert rehash(path) == content
    assert independent_hash.content_hash(path) == content


@pytest.mark.parametrize("name", sorted(TYPES))
def test_every_variable_is_hashed_and_named(written: Written, name: str) -> None:
    """Changing one value of any variable is found, and the error names file and
    variable.
    """
    path, content = written
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        changed = values + np.ones_like(values)
        file[name][...] = changed
    assert rehash(path) != content
    assert_refused(path, "differ", f"variable '{name}'")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dt", 0.0021),
        ("wall_moving", "other"),
        ("seed", "other"),
        ("scenario", 4),
        ("subset", "other"),
        ("hashed_parameters", "dt"),
    ],
)
def test_changed_attributes_are_found(
    written: Written, name: str, value: object
) -> None:
    """Parameters and identity enter the hash."""
    path, _ = written
    with netCDF4.Dataset(path, "r+") as file:
        file.setncattr(name, value)
    assert_refused(path, "attributes differ", "attributes")


@pytest.mark.parametrize("number", [3.7, "3", np.nan, [3, 3]])
def test_an_id_that_is_no_integer_is_refused(written: Written, number: object) -> None:
    """Other readers would read another id than ours."""
    path, _ = written
    with netCDF4.Dataset(path, "r+") as file:
        file.setncattr("scenario", number)
    assert_refused(path)


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
    written: Written,
    variable: str,
    name: str,
    value: object,
) -> None:
    """The values are the same, yet readers that follow CF would read others."""
    path, content = written
    with h5py.File(path, "r+") as file:
        if value is None:
            del file[variable].attrs[name]
        else:
            file[variable].attrs[name] = value
    assert rehash(path) == content
    assert_refused(path, f"variable '{variable}'", name)


def test_long_attributes_make_no_long_message(written: Written) -> None:
    path, _ = written
    with netCDF4.Dataset(path, "r+") as file:
        file["position"].units = "x" * 50_000
        for number in range(100):
            file["position"].setncattr(f"attribute_{number}", "y")
    with pytest.raises(DataError) as caught:
        check_scenario(path)
    assert "position" in str(caught.value.where)
    assert len(str(caught.value)) < 2000


def test_flipped_byte_in_a_compressed_chunk_names_the_variable(tmp_path: Path) -> None:
    """The error is that of the variable, not a traceback of HDF5."""
    path, _ = write_scenario(tmp_path, KEY, frames=4, particles=2000)
    with h5py.File(path) as file:
        chunk = file["velocity"].id.get_chunk_info(2)
        offset = chunk.byte_offset
    data = bytearray(path.read_bytes())
    data[offset + 100] ^= 1
    path.write_bytes(data)
    for check in (rehash, check_scenario):
        assert_refused(
            path, "damaged", "variable 'velocity'", "lagbench generate", check=check
        )


@pytest.mark.slow
def test_no_flipped_byte_escapes_as_another_error(written: Written) -> None:
    """Each of 200 flips leaves the content as it is or gives a DataError."""
    path, content = written
    good = path.read_bytes()
    messages = []
    step = len(good) // 200
    for offset in range(0, len(good), step):
        data = bytearray(good)
        data[offset] ^= 0x55
        path.write_bytes(data)
        try:
            content_after = check_scenario(path)
        except DataError as error:
            messages.append(str(error))
        else:
            assert content_after == content, f"byte {offset}"
    assert len(messages) >= 20
    for message in messages:
        assert str(path) in message


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.7, 0.999])
def test_a_truncated_file_is_damage(written: Written, share: float) -> None:
    path, _ = written
    good = path.read_bytes()
    length = int(share * len(good))
    path.write_bytes(good[:length])
    assert_refused(path, "damaged")


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    assert_refused(tmp_path / "0000.nc", "missing", check=read_scenario)


def test_a_file_that_vanishes_while_it_is_read_is_not_called_damaged(
    tmp_path: Path,
) -> None:
    """The disk was taken away after the file was found."""
    path = tmp_path / "0001.nc"
    error = damage_error(path, "FileNotFoundError: no such file", "position")
    assert "missing" in error.what
    assert error.where == str(path)
    path.write_bytes(b"x")
    assert "damaged" in damage_error(path, "OSError: no signature").what


def test_the_systems_limit_of_files_is_no_damage(written: Written) -> None:
    """Reading goes on once the system opens files again."""
    path, content_hash = written
    soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    with open(os.devnull) as file:
        lowest_free = file.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free, hard_limit))
    try:
        with pytest.raises(WorkFailedError) as caught:
            check_scenario(path)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft_limit, hard_limit))
    assert caught.value.where == str(path)
    assert check_scenario(path) == content_hash


def test_other_netcdf_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.nc"
    data = xr.Dataset({"a": ("b", [1.0])})
    data.to_netcdf(path, engine="netcdf4")
    assert_refused(path, "not one of lagbench", check=read_scenario)


def test_netcdf_files_without_hdf5_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.nc"
    data = xr.Dataset({"a": ("b", [1.0])})
    data.to_netcdf(path, engine="netcdf4", format="NETCDF3_CLASSIC")
    assert_refused(path, "damaged", check=read_scenario)


def test_a_shape_of_terabytes_in_kilobytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "large.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("position", (2**40,), "f4", chunks=(1024,))
    assert_refused(
        path, "larger than its file", "variable 'position'", check=read_scenario
    )


@pytest.mark.parametrize("version", ["x.y", "", "1.0", "9" * 5000 + ".0.0", 3])
def test_an_invalid_version_is_damage(written: Written, version: object) -> None:
    path, _ = written
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = version
    assert_refused(path, "damaged", check=read_scenario)


def test_a_compound_type_is_damage(written: Written) -> None:
    path, _ = written
    with netCDF4.Dataset(path, "r+") as file:
        integer = np.dtype([("a", "i4")])
        pair = file.createCompoundType(integer, "pair")
        file.createVariable("odd", pair, ())
    assert_refused(path, "damaged", "variable 'odd'", check=rehash)


def test_a_root_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "cavity").write_text("in the way")
    with pytest.raises(WorkFailedError) as caught:
        write_scenario(tmp_path, KEY)
    assert str(caught.value.where).endswith("cavity/tiny/v2/test/0003.nc")
    assert caught.value.exit_code == 5


def open_writer(path: Path, **changes: Any) -> ScenarioWriter:
    """Return a writer of two frames of eight particles by default."""
    options: dict[str, Any] = {
        "particles": 8,
        "frames": 2,
        "frame_interval": 0.1,
        "particle_mass": 1.0,
        "material": np.zeros(8),
        "parameters": {},
        "seed": "s",
        "device": "cpu",
        "generator": "g",
    }
    return ScenarioWriter(path, KEY, **(options | changes))


@pytest.mark.parametrize(
    "material",
    [
        0,
        [0],
        np.zeros((8, 1)),
        np.full(8, len(MATERIALS)),
        np.full(8, -1),
        np.full(8, 256),
        np.full(8, 0.5),
    ],
)
def test_other_materials_are_not_written(tmp_path: Path, material: Any) -> None:
    """One number for each particle, and no number that a cast would wrap or cut."""
    with pytest.raises(DataError) as caught:
        open_writer(tmp_path / "c.nc", material=material)
    assert str(caught.value.where).endswith("c.nc, variable 'material'")


@pytest.mark.parametrize("number", [len(MATERIALS), -1])
def test_an_unknown_material_is_found_though_the_hashes_fit(
    written: Written, number: int
) -> None:
    path, _ = written
    with h5py.File(path, "r+") as file:
        file["material"][0] = number
        digest = independent_hash.variable_hash("material", file["material"])
    with netCDF4.Dataset(path, "r+") as file:
        file["material"].content_sha256 = digest
    content = independent_hash.content_hash(path)
    with netCDF4.Dataset(path, "r+") as file:
        file.content_sha256 = content
    assert_refused(path, "variable 'material'")


def test_the_order_of_the_periodic_axes_changes_nothing(tmp_path: Path) -> None:
    hashes = set()
    for periodic in (("x", "y"), ("y", "x")):
        with open_writer(tmp_path / "c.nc", periodic=periodic) as file:
            for position in frames_of(3, 2, 8):
                file.append(position, -position)
        hashes.add(file.content_sha256)
        with read_scenario(tmp_path / "c.nc") as stored:
            assert stored.header.parameters["periodic"] == "x y"
    assert len(hashes) == 1


def test_an_error_of_the_caller_goes_on_as_it_is(tmp_path: Path) -> None:
    """A pipe that broke is no disk that is full."""
    with pytest.raises(BrokenPipeError), open_writer(tmp_path / "c.nc"):
        raise BrokenPipeError
    assert not list(tmp_path.iterdir())


def test_other_readers_may_have_the_file_open(written: Written) -> None:
    """HDF5 opens a file twice in a process only if both openings treat locks alike."""
    path, _ = written
    with (
        h5py.File(path, "r"),
        read_scenario(path) as file,
        h5py.File(path, "r"),
    ):
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


def _soft_link(file: h5py.File) -> None:
    """Show an array under a second name."""
    file["too"] = h5py.SoftLink("/position")


def _external_link(file: h5py.File) -> None:
    """Show an array of another file."""
    file["too"] = h5py.ExternalLink("other.nc", "/a")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_soft_link, "'too' is a soft link"),
        (_external_link, "'too' is a external link"),
        (_crowd, "members"),
        (_virtual, "'spin' lie elsewhere: virtual"),
        (_named_like_a_dimension, "spin"),
    ],
)
def test_members_that_other_readers_would_follow_or_show_are_damage(
    written: Written,
    change: Callable[[h5py.File], None],
    words: str,
) -> None:
    """Links and virtual data sets are not followed, and the members are counted."""
    path, _ = written
    with h5py.File(path, "r+") as file:
        change(file)
    assert_refused(path, "damaged", words, check=read_scenario)


def test_texts_that_are_no_texts_are_damage(written: Written) -> None:
    """Bytes that are no UTF-8 change the hash, and raise no other error."""
    path, content = written
    with h5py.File(path, "r+") as file:
        del file.attrs["seed"]
        utf8 = h5py.string_dtype("utf-8")
        file.attrs.create("seed", b"\xff\xfe", dtype=utf8)
    assert rehash(path) != content
    assert_refused(path, "attributes differ")


def test_frames_and_slices_can_be_read(written: Written) -> None:
    path, _ = written
    truth = frames_of(3, 4, 8)
    with read_scenario(path) as file:
        assert file.header.frames == 4
        assert file.header.particles == 8
        assert file.header.key == KEY
        assert file.read("particle_mass") == 1e-4 / 8
        frame = file.read("position", 2)
        assert_array_equal(frame, truth[2])
        two_frames = file.read("position", slice(1, 3))
        assert_array_equal(two_frames, truth[1:3])


def test_blocks_stream_all_frames_in_order(written: Written) -> None:
    path, _ = written
    with read_scenario(path) as file:
        blocks = list(file.blocks("position"))
    frames = np.concatenate(blocks)
    assert_array_equal(frames, frames_of(3, 4, 8))


def test_an_unknown_variable_is_an_error(written: Written) -> None:
    path, _ = written
    with read_scenario(path) as file, pytest.raises(DataError) as caught:
        file.read("density")
    assert str(caught.value.where).endswith(f"{path.name}, variable 'density'")


def write_with_parameters(
    path: Path,
    first: dict[str, Any],
    last: dict[str, Any],
) -> str | None:
    """Write a scenario with parameters before and after its frames."""
    with open_writer(path, frames=4, parameters=first) as file:
        for position in frames_of(3, 4, 8):
            file.append(position, -position)
        with pytest.raises(DataError):
            file.state(seed=1)
        file.state(**last)
    return file.content_sha256


def test_a_parameter_may_be_stated_after_the_frames(tmp_path: Path) -> None:
    """The file is the one that has it from the start."""
    both = {"a": 1, "b": 2}
    first_path = tmp_path / "0.nc"
    second_path = tmp_path / "1.nc"
    at_first = write_with_parameters(first_path, both, {})
    at_last = write_with_parameters(second_path, {"a": 1}, {"b": 2})
    assert at_first == at_last
    for name in ("0.nc", "1.nc"):
        assert check_scenario(tmp_path / name) == at_first
        with read_scenario(tmp_path / name) as file:
            assert file.header.parameters == both


@pytest.mark.parametrize("name", ["viscosity", "friction"])
def test_an_impossible_attribute_is_named_with_its_scenario(
    tmp_path: Path, name: str
) -> None:
    """In plain words and a short message."""
    path = tmp_path / "0.nc"
    with open_writer(path, frames=4, parameters={name: "thick" * 1000}) as file:
        for position in frames_of(3, 4, 8):
            file.append(position, -position)
    with read_scenario(path) as scenario, pytest.raises(DataError) as caught:
        getattr(scenario.header, name)
    where = f"{KEY.split} {KEY.size}, scenario {KEY.scenario}, attribute {name}"
    assert caught.value.where == where
    assert len(str(caught.value)) < 500


FRAME = np.zeros((8, 2), np.float32)
FRAME_IN_DOUBLES = FRAME.astype(np.float64)


@pytest.mark.parametrize(
    ("position", "velocity", "words"),
    [
        (FRAME, FRAME[:4], r"(?s)wrong shape.*'velocity'"),
        (FRAME[:1], FRAME, r"(?s)wrong shape.*'position'"),
        (FRAME, FRAME, r"(?s)values are missing.*'position'"),
        (FRAME_IN_DOUBLES, FRAME, r"(?s)another type.*'position'"),
    ],
)
def test_wrong_frames_are_refused(
    tmp_path: Path,
    position: Any,
    velocity: Any,
    words: str,
) -> None:
    """No file appears, not even a temporary one, and an old file survives."""
    path, content = write_scenario(tmp_path, KEY)
    with pytest.raises(DataError, match=words), open_writer(path) as file:
        file.append(position, velocity)
    assert check_scenario(path) == content
    assert list(path.parent.iterdir()) == [path]


def test_too_many_frames_are_refused(tmp_path: Path) -> None:
    with open_writer(tmp_path / "c.nc") as file:
        file.append(FRAME, FRAME)
        file.append(FRAME, FRAME)
        with pytest.raises(DataError) as caught:
            file.append(FRAME, FRAME)
    assert caught.value.where == "variable 'position'"


@pytest.mark.parametrize("name", ["seed", "content_sha256", "two words", ""])
def test_parameters_that_would_hide_an_attribute_are_refused(
    tmp_path: Path, name: str
) -> None:
    """So are names that are no names."""
    with pytest.raises(DataError) as caught:
        write_scenario(tmp_path, KEY, parameters={name: 1})
    assert str(caught.value.where).endswith("0003.nc")


@pytest.mark.parametrize(
    "name",
    [
        "CLASS",
        "NAME",
        "DIMENSION_LIST",
        "REFERENCE_LIST",
        "_ARRAY_DIMENSIONS",
        "_Codecs",
        "_Format",
        "_IsNetcdf4",
        "_NCProperties",
        "_Netcdf4Coordinates",
        "_Netcdf4Dimid",
        "_SuperblockVersion",
        "_nc3_strict",
        "_nczarr_array",
        "_nczarr_attr",
        "_nczarr_group",
        "_nczarr_superblock",
        "a" * 257,
        "\u00e9" * 129,
        "n\u0303",
    ],
)
def test_names_that_netcdf_keeps_or_changes_are_refused(
    tmp_path: Path, name: str
) -> None:
    """NetCDF refuses each name, or has another one in the file.

    The last one is an n and a tilde. NetCDF would store one character for both.
    """
    names = []
    with suppress(AttributeError), netCDF4.Dataset(tmp_path / "raw.nc", "w") as raw:
        raw.setncattr(name, 1)
        names = raw.ncattrs()
    assert name not in names

    with pytest.raises(DataError) as caught:
        write_scenario(tmp_path, KEY, parameters={name: 1})
    assert str(caught.value.where).endswith("0003.nc")
    with open_writer(tmp_path / "last.nc") as file:
        file.append(FRAME, FRAME)
        file.append(FRAME, FRAME)
        with pytest.raises(DataError):
            file.state(**{name: 1})


@pytest.mark.parametrize("name", ["a" * 256, "\u00e9" * 128, "_depth"])
def test_a_long_name_of_a_parameter_survives_the_file(
    tmp_path: Path, name: str
) -> None:
    path, content = write_scenario(tmp_path, KEY, parameters={name: 1})
    with read_scenario(path) as file:
        assert file.header.parameters[name] == 1
    assert check_scenario(path) == content
    assert independent_hash.content_hash(path) == content


@pytest.mark.parametrize(
    "value",
    [
        "",
        [1],
        {"a": 1},
        np.array([1, 2]),
        2**64,
        -(2**63) - 1,
        pytest.param(10**5000, id="an integer that Python does not print"),
        pytest.param("\ud800", id="half of a character"),
    ],
)
def test_parameters_that_netcdf_would_change_are_refused(
    tmp_path: Path, value: object
) -> None:
    with pytest.raises(DataError) as caught:
        write_scenario(tmp_path, KEY, parameters={"depth": value})
    assert str(caught.value.where).endswith("0003.nc")
