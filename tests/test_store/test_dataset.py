"""open_split gives one lazy, padded xarray.Dataset, or says what is missing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import dask.array
import netCDF4
import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_array_equal, assert_equal
from scenario_factory import PARAMETERS, frames_of, make_key, write_scenario

import lagbench
from lagbench.data import registry
from lagbench.errors import DataError, LagbenchError
from lagbench.store.dataset import open_split

TEST_IDS = registry.load().size("cavity", "tiny").subsets["test"]


@pytest.fixture
def ragged(tmp_path: Path) -> Path:
    """A root whose cavity tiny test scenarios differ in frames and particles."""
    for place, scenario in enumerate(TEST_IDS):
        write_scenario(
            tmp_path,
            make_key(scenario),
            frames=5 - place,
            particles=6 + place,
        )
    return tmp_path


def open_tiny(root: Path) -> xr.Dataset:
    """Open the test subset of cavity tiny."""
    return open_split("cavity", size="tiny", root=root)


def scenario_path(root: Path, scenario: int) -> Path:
    """Return the file of a test scenario."""
    return root / "cavity/tiny/v2/test" / f"{scenario:04d}.nc"


def set_scenario_id(path: Path, scenario: int) -> None:
    """Let a file say that it is of a scenario."""
    with netCDF4.Dataset(path, "r+") as file:
        file.scenario = scenario


def test_ragged_scenarios_are_padded(ragged: Path) -> None:
    """Beyond its own frames and particles a scenario is NaN, its material -1."""
    with open_tiny(ragged) as data:
        assert data["position"].dims == ("scenario", "frame", "particle", "space")
        assert data["wall_velocity"].dims == ("scenario", "frame", "wall", "space")
        assert tuple(data["scenario"].values) == TEST_IDS
        times = 0.1 * np.arange(5)
        assert_array_equal(data["time"], times)
        most_particles = 6 + len(TEST_IDS) - 1
        for place, scenario in enumerate(TEST_IDS):
            frames = 5 - place
            particles = 6 + place
            one = data.sel(scenario=scenario)
            assert int(one["frame_count"]) == frames
            assert int(one["particle_count"]) == particles
            assert one["particle_mass"] == 1e-4 / particles

            positions = frames_of(scenario, frames, particles)
            expected = np.full((5, most_particles, 2), np.nan, np.float32)
            expected[:frames, :particles] = positions
            assert_array_equal(one["position"], expected)
            assert_array_equal(one["velocity"], -expected)
            material = np.full(most_particles, -1)
            material[:particles] = np.arange(particles) % 4
            assert_array_equal(one["material"], material)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("position", "float32"),
        ("velocity", "float32"),
        ("wall_velocity", "float32"),
        ("material", "int8"),
    ],
)
def test_types_survive_the_padding(ragged: Path, name: str, dtype: str) -> None:
    with open_tiny(ragged) as data:
        assert str(data[name].dtype) == dtype


def test_the_given_viscosity_is_a_coordinate(tmp_path: Path) -> None:
    """Each scenario has its own; one that states none has none in the cavity."""
    first, second, *_ = TEST_IDS
    stated = {first: 2e-3, second: 5e-4}
    for scenario in TEST_IDS:
        parameters: dict[str, object] = {"grid": 16}
        if scenario in stated:
            parameters["viscosity"] = stated[scenario]
        write_scenario(tmp_path, make_key(scenario), parameters=parameters)
    with open_tiny(tmp_path) as data:
        for scenario in TEST_IDS:
            of_scenario = data["viscosity"].sel(scenario=scenario)
            viscosity = float(of_scenario)
            expected = stated.get(scenario, np.nan)
            assert_equal(viscosity, expected)


def test_a_scenario_without_an_obstacle_has_nan(tmp_path: Path) -> None:
    """Others of the same subset may have one."""
    disc = {"obstacle_x": 0.25, "obstacle_y": 0.5, "obstacle_diameter": 0.125}
    first, second = TEST_IDS
    write_scenario(tmp_path, make_key(first))
    write_scenario(tmp_path, make_key(second), parameters={**PARAMETERS, **disc})
    with open_tiny(tmp_path) as data:
        assert_equal(data.obstacle.values, [[np.nan] * 3, [0.25, 0.5, 0.0625]])


def test_it_is_lazy_and_bounded(tmp_path: Path) -> None:
    """Positions are dask arrays in chunks of some megabytes, one scenario each."""
    for scenario in TEST_IDS:
        key = make_key(scenario)
        write_scenario(tmp_path, key, frames=100, particles=8192)
    with open_tiny(tmp_path) as data:
        position = data["position"]
        assert isinstance(position.data, dask.array.Array)
        assert position.data.chunksize == (1, 64, 8192, 2)  # 4 MiB
        expected = frames_of(TEST_IDS[1], 100, 8192)
        value = float(position[1, 99, 0, 0])
        assert value == expected[99, 0, 0]


def test_missing_files_are_counted_and_named(ragged: Path) -> None:
    """The error gives the command that generates them."""
    scenario_path(ragged, TEST_IDS[1]).unlink()
    with pytest.raises(DataError) as caught:
        open_tiny(ragged)
    message = str(caught.value)
    command = "lagbench generate --split cavity --size tiny --subset test"
    assert caught.value.exit_code == 4
    assert f"1 of {len(TEST_IDS)} scenarios" in message
    assert f"{command} --root {ragged}" in message


def test_a_truncated_file_is_damage(ragged: Path) -> None:
    path = scenario_path(ragged, TEST_IDS[0])
    content = path.read_bytes()
    half = len(content) // 2
    path.write_bytes(content[:half])
    with pytest.raises(DataError):
        open_tiny(ragged)


def list_open_files(root: Path) -> list[str]:
    """Return the files below a folder that this process has open."""
    names = []
    for descriptor in Path("/proc/self/fd").iterdir():
        if descriptor.is_symlink():
            target = descriptor.readlink()
            if target.is_relative_to(root):
                names.append(str(target))
    return names


@pytest.mark.parametrize(
    ("variable", "attribute", "value"),
    [
        ("material", "units", "days since 1900-01-01"),
        ("position", "coordinates", "material time"),
    ],
)
def test_files_of_unlike_kinds_are_not_joined(
    ragged: Path, variable: str, attribute: str, value: str
) -> None:
    """An attribute may make dates or coordinates of numbers."""
    path = scenario_path(ragged, TEST_IDS[1])
    with netCDF4.Dataset(path, "r+") as file:
        file[variable].setncattr(attribute, value)
    with pytest.raises(DataError):
        open_tiny(ragged)


def test_nothing_stays_open_after_an_error(ragged: Path) -> None:
    """Neither the wrong file nor those before it, while the error still exists.

    A thread that collects them would close them while another reads, and HDF5 crashes.
    """
    path = scenario_path(ragged, TEST_IDS[1])
    set_scenario_id(path, 17)
    with pytest.raises(DataError) as caught:
        open_tiny(ragged)
    assert list_open_files(ragged) == [], caught

    set_scenario_id(path, TEST_IDS[1])
    with open_tiny(ragged):
        assert len(list_open_files(ragged)) == len(TEST_IDS)
    assert list_open_files(ragged) == []


def test_public_names_load_on_first_use() -> None:
    """Each public name is reachable and listed."""
    assert set(lagbench.__all__) <= set(dir(lagbench))
    assert lagbench.open_split is open_split
    assert lagbench.__version__[0].isdigit()
    assert lagbench.errors.LagbenchError is LagbenchError
    with pytest.raises(AttributeError) as caught:
        lagbench.opensplit  # noqa: B018
    # of these two Python forms "Did you mean: 'open_split'?"
    assert caught.value.name == "opensplit"
    assert caught.value.obj is lagbench


OPEN_AGAIN = """
import sys
from lagbench import open_split

def measure(place):
    again = open_split("cavity", size="tiny", root=sys.argv[1])
    return float(again["position"].isel(scenario=place).diff("frame").mean())

kept = open_split("cavity", size="tiny", root=sys.argv[1])
for turn in range(20):
    measure(turn % 2)
print("done")
"""


@pytest.mark.slow
def test_a_subset_that_is_kept_open_is_opened_again(ragged: Path) -> None:
    """Threads of Dask free the files of each turn while the next turn opens its own."""
    run = subprocess.run(
        [sys.executable, "-c", OPEN_AGAIN, str(ragged)], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-2000:]
    assert run.stdout.strip() == "done"
