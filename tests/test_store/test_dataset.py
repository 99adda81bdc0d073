"""open_split gives one lazy, padded xarray.Dataset, or says what is missing."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import dask.array
import netCDF4
import numpy as np
import pytest
from scenario_factory import frames_of, make_key, write_scenario

import lagbench
from lagbench.data import registry
from lagbench.data.manifest import build_manifest, write_manifest
from lagbench.data.scenario import check_scenario, read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.store.dataset import list_splits, load_manifest, open_split

TEST_IDS = registry.load().size("cavity", "tiny").subsets["test"]


@pytest.fixture
def ragged(tmp_path: Path) -> Path:
    """A root whose cavity tiny test scenarios differ in frames and particles."""
    for place, scenario in enumerate(TEST_IDS):
        write_scenario(
            tmp_path, make_key(scenario), frames=5 - place, particles=6 + place
        )
    return tmp_path


def test_ragged_scenarios_are_padded(ragged: Path) -> None:
    """Each scenario holds its own frames and particles; what is beyond is NaN, material
    -1.
    """
    with open_split("cavity", size="tiny", root=ragged) as data:
        assert data["position"].dims == ("scenario", "frame", "particle", "space")
        assert data["wall_velocity"].dims == ("scenario", "frame", "wall", "space")
        assert tuple(data["scenario"].values) == TEST_IDS
        for place, scenario in enumerate(TEST_IDS):
            frames = 5 - place
            particles = 6 + place
            one = data.sel(scenario=scenario)
            assert int(one["frame_count"]) == frames
            assert int(one["particle_count"]) == particles
            expected = np.full((5, 6 + len(TEST_IDS) - 1, 2), np.nan, np.float32)
            expected[:frames, :particles] = frames_of(scenario, frames, particles)
            np.testing.assert_array_equal(one["position"], expected)
            np.testing.assert_array_equal(one["velocity"], -expected)
            np.testing.assert_array_equal(
                one["material"][:particles], np.arange(particles) % 4
            )
            assert (one["material"][particles:] == -1).all()
            assert one["particle_mass"] == 1e-4 / particles
        np.testing.assert_array_equal(data["time"], np.arange(5) * 0.1)


def test_types_survive_the_padding(
    ragged: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Padding turns neither float32 into float64 nor int8 into float; LAGBENCH_ROOT is
    a root too.
    """
    monkeypatch.setenv("LAGBENCH_ROOT", str(ragged))
    with open_split("cavity", size="tiny") as data:
        types = [
            str(data[name].dtype)
            for name in ("position", "velocity", "wall_velocity", "material")
        ]
        assert types == ["float32", "float32", "float32", "int8"]
        assert data.attrs["split"] == "cavity"
        assert data.attrs["size"] == "tiny"
        assert data.attrs["subset"] == "test"
        assert "content_sha256" not in {*data.attrs, *data["position"].attrs}


def test_it_is_lazy_and_bounded(tmp_path: Path) -> None:
    """Positions are dask arrays in chunks of some megabytes, one scenario each."""
    for scenario in TEST_IDS:
        write_scenario(tmp_path, make_key(scenario), frames=100, particles=8192)
    with open_split("cavity", size="tiny", root=tmp_path) as data:
        position = data["position"].data
        assert isinstance(position, dask.array.Array)
        assert position.chunksize == (1, 64, 8192, 2)  # 4 MiB
        assert (
            float(data["position"][1, 99, 0, 0])
            == frames_of(TEST_IDS[1], 100, 8192)[99, 0, 0]
        )


def test_missing_damaged_and_foreign_files_are_told(ragged: Path) -> None:
    """The error counts what is missing, lists the ids and gives the generate
    command.
    """
    other = ragged / "cavity/tiny/v2/test" / f"{TEST_IDS[1]:04d}.nc"
    other.rename(ragged / "kept")
    with pytest.raises(DataError) as caught:
        open_split("cavity", size="tiny", root=ragged)
    assert caught.value.exit_code == 4
    assert f"1 of {len(TEST_IDS)} scenarios" in str(caught.value)
    assert f"missing: {TEST_IDS[1]}" in str(caught.value)
    assert (
        f"lagbench generate --split cavity --size tiny --subset test --root {ragged}"
        in str(caught.value)
    )
    (ragged / "kept").rename(other)
    # a truncated file and a file of another scenario are told by path
    path = ragged / "cavity/tiny/v2/test" / f"{TEST_IDS[0]:04d}.nc"
    sound = path.read_bytes()
    path.write_bytes(sound[: len(sound) // 2])
    with pytest.raises(DataError, match=rf"(?s)damaged.*{path.name}"):
        open_split("cavity", size="tiny", root=ragged)
    path.write_bytes(sound)
    with netCDF4.Dataset(path, "r+") as file:
        file.scenario = 17
    with pytest.raises(DataError, match=rf"(?s)another scenario.*{path.name}"):
        open_split("cavity", size="tiny", root=ragged)


def test_nothing_stays_open_after_an_error(ragged: Path) -> None:
    """Neither the file that is wrong nor those before it, though the error is still
    held.

    A thread that collects them would close them while another reads, and HDF5 crashes.
    """

    def held() -> list[str]:
        links = [
            link.readlink()
            for link in Path("/proc/self/fd").iterdir()
            if link.is_symlink()
        ]
        return [str(link) for link in links if link.is_relative_to(ragged)]

    path = ragged / "cavity/tiny/v2/test" / f"{TEST_IDS[1]:04d}.nc"
    for number in (17, TEST_IDS[1]):
        with netCDF4.Dataset(path, "r+") as file:
            file.scenario = number
        kept = pytest.raises(DataError) if number == 17 else nullcontext()
        with kept as caught, open_split("cavity", size="tiny", root=ragged):
            assert len(held()) == len(TEST_IDS)
        assert held() == [], caught


@pytest.mark.parametrize(
    ("split", "size", "subset", "hint"),
    [
        ("cavty", "tiny", "test", "did you mean 'cavity'"),
        ("cavity", "tiney", "test", "did you mean 'tiny'"),
        ("cavity", "tiny", "tset", "did you mean 'test'"),
        ("cavity", "tiny", ["train"], "did you mean 'train'"),
    ],
)
def test_unknown_names_offer_the_nearest(
    tmp_path: Path, split: str, size: str, subset: Any, hint: str
) -> None:
    """A typing error is exit code 2 and names the nearest known word."""
    with pytest.raises(UsageError, match=hint):
        open_split(split, size=size, subset=subset, root=tmp_path)


def test_a_split_left_open_spoils_nothing(ragged: Path, tmp_path: Path) -> None:
    """Files open elsewhere are checked and, after another file was written, opened
    again.
    """
    data = open_split("cavity", size="tiny", root=ragged)
    paths = sorted(ragged.rglob("*.nc"))
    for path in paths:
        check_scenario(path)
    with netCDF4.Dataset(tmp_path / "other.nc", "w") as other:
        other.createDimension("n", 3)
        other.createVariable("x", "f4", ("n",))
        for path in paths:
            with read_scenario(path) as file:
                assert file.read("space").tolist() == ["x", "y"]
    data.close()


def test_load_manifest(tmp_path: Path) -> None:
    """The manifest of a generated set is read; where there is none the command is
    named.
    """
    with pytest.raises(DataError) as caught:
        load_manifest("cavity", size="tiny", root=tmp_path)
    assert caught.value.where.endswith("cavity/tiny/v2")
    names: dict[str, Any] = {"split": "cavity", "size": "tiny", "version": "2.0.0"}
    manifest = build_manifest(None, [], **names, subsets={"test": (3,)}, environment={})
    write_manifest(tmp_path, manifest)
    assert load_manifest("cavity", size="tiny", root=tmp_path) == manifest


def test_public_names_load_on_first_use() -> None:
    """Each public name is reachable and listed; so are the four splits of the
    registry.
    """
    assert {"cavity", "curl-noise", "fluid", "multimaterial"} <= set(list_splits())
    assert set(lagbench.__all__) <= set(dir(lagbench))
    assert lagbench.open_split is open_split
    assert lagbench.__version__[0].isdigit()
    with pytest.raises(AttributeError):
        lagbench.opensplit  # noqa: B018
