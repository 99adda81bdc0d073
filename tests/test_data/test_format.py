"""Scenario files: other readers, content hashes, and damage."""

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
from numpy.testing import assert_array_equal
from scenario_factory import DIMS, PARAMETERS, frames_of, make_key, write_scenario

from lagbench.data import MATERIALS, PARTICLE_KINDS
from lagbench.data.checksums import ContentHasher, file_sha256
from lagbench.data.scenario import check_scenario, read_scenario, rehash
from lagbench.data.writer import ScenarioWriter
from lagbench.errors import DataError
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
    with pytest.raises(DataError):
        check_scenario(path, "0123456789abcdef")


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


@pytest.mark.parametrize("number", [len(PARTICLE_KINDS), -1])
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
