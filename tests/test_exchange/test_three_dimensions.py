"""Data sets in three dimensions with periodic axes, from arrays to predictions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exchange_readers import read_gns, read_h5
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

import lagbench
from lagbench.data.local import locate
from lagbench.data.scenario import check_scenario, read_scenario
from lagbench.errors import DataError
from lagbench.exchange import adopt, export, import_split
from lagbench.exchange.local_split import LocalSplit
from lagbench.submission.predictions import open_predictions

BOX = ((0.0, 1.0), (0.0, 0.5), (0.25, 0.75))
PERIODIC = ("x", "z")
VELOCITY = np.array([0.03, 0.0, -0.02])  # [length/frame]
FRAMES = 12
COUNTS = (343, 343, 300, 216)
"""Particles of each scenario: 7^3, 7^3, some of them, 6^3."""


def straight_run(count: int) -> NDArray[np.float32]:
    """Return particles of a lattice that fly straight through the periodic sides."""
    side = round(count ** (1 / 3) + 0.499)
    axes = [low + (high - low) * (np.arange(side) + 0.5) / side for low, high in BOX]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    frames = np.arange(FRAMES)[:, None, None]
    position = lattice[:count] + frames * VELOCITY
    low, high = np.array(BOX).T
    wrapped = low + (position - low) % (high - low)
    position = np.where([True, False, True], wrapped, position)
    return np.asarray(position, np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A set whose scenarios differ in particles."""
    folder = tmp_path_factory.mktemp("solid")
    paths = []
    for number, count in enumerate(COUNTS):
        paths.append(folder / f"run{number}.npz")
        walls = np.zeros((FRAMES, 6, 3))
        walls[:, 3, 0] = 0.25
        np.savez(paths[-1], position=straight_run(count), wall_velocity=walls)
    return adopt(
        paths,
        output=folder / "solid",
        valid=1,
        test=2,
        radius=0.12,
        frame_interval=0.5,
        bounds=BOX,
        periodic=PERIODIC,
        input_frames=3,
        full_box=True,
    )


def test_the_files_state_three_axes_and_which_are_periodic(made: LocalSplit) -> None:
    size = locate(made.folder).size
    assert size.bounds == BOX
    assert size.box.periodic == (True, False, True)
    assert [size.particle_count(number) for number in range(4)] == list(COUNTS)
    path = size.path(made.folder.parent, 0)
    check_scenario(path)
    with read_scenario(path) as file:
        assert file.read("space").tolist() == ["x", "y", "z"]
        assert file.read("wall").tolist()[4:] == ["front", "back"]
        assert file.read("wall_velocity").shape == (FRAMES, 6, 3)
        assert file.header.parameters["periodic"] == "x z"
        position = file.read("position")
    assert_array_equal(position, straight_run(COUNTS[0]))
    assert (position[..., [0, 2]] < [1.0, 0.75]).all()


def test_statistics_follow_the_shortest_way(made: LocalSplit) -> None:
    """The mean velocity of a straight flight is its velocity."""
    measured = locate(made.folder).size.measured
    assert measured is not None
    mean = measured.statistics["velocity_mean"]
    assert_allclose(mean, VELOCITY, atol=1e-7)
    assert_allclose(measured.statistics["velocity_std"], 0.0, atol=1e-6)


def test_subsets_and_windows_have_three_components(made: LocalSplit) -> None:
    with lagbench.open_split(made.folder, subset="test") as data:
        assert data["space"].values.tolist() == ["x", "y", "z"]
        assert data["particle_count"].values.tolist() == list(COUNTS[2:])
        stored = data["position"].values[1, :, : COUNTS[3]]
    assert_array_equal(stored, straight_run(COUNTS[3]))
    window = lagbench.windows(made.folder, subset="test", history=2)[-1]
    expected = straight_run(COUNTS[3])[-3:].transpose(1, 0, 2)
    assert_array_equal(window.position, expected)
    assert window.wall_velocity is not None
    assert window.wall_velocity.shape == (3, 6, 3)


def test_predictions_are_ragged_and_valid(made: LocalSplit, tmp_path: Path) -> None:
    """What is written is read, and a swap of two scenarios is refused."""
    path = tmp_path / "predictions.nc"
    truth = {number: straight_run(COUNTS[number])[3:] for number in (2, 3)}
    lagbench.submission.write(path, truth, split=made.folder, method="truth")
    result = lagbench.validate(path, root=made.folder.parent, isolated=False)
    assert result.valid
    assert not result.findings
    with open_predictions(path) as predictions:
        for number, position in truth.items():
            frames = predictions.frames(number, 3, FRAMES - 3)
            assert_array_equal(frames, position)
    with pytest.raises(lagbench.errors.UsageError):
        lagbench.submission.write(
            path,
            {2: truth[3], 3: truth[2]},
            split=made.folder,
            method="swapped",
        )


@pytest.mark.parametrize("form", ["gns-npz", "lagrangebench-h5"])
def test_another_program_reads_it_and_it_comes_back(
    made: LocalSplit, tmp_path: Path, form: str
) -> None:
    """Positions survive export and import, with box and periodic axes."""
    out = tmp_path / "out"
    export(made.folder, format=form, output=out)
    if form == "gns-npz":
        trajectories = read_gns(out / "train.npz")
    else:
        trajectories = read_h5(out / "train.h5")
    position, _ = trajectories[0]
    assert position.shape == (FRAMES, COUNTS[0], 3)
    # the first format has no place for periodic axes; none given: those of the file
    options = {"periodic": list(PERIODIC)} if form == "gns-npz" else {}
    again = import_split(out, format=form, output=tmp_path / "again", **options)
    box = locate(again.folder).size.box
    assert box.bounds == BOX
    assert box.periodic == (True, False, True)
    with lagbench.open_split(again.folder, subset="valid") as data:
        stored = data["position"].values[0]
    assert_allclose(stored, straight_run(COUNTS[1]), atol=1e-6)


def test_a_solid_that_crosses_its_box_needs_the_axes(tmp_path: Path) -> None:
    """A step of nearly the box is refused, and the fix names the axis."""
    paths = []
    for number in range(3):
        paths.append(tmp_path / f"run{number}.npy")
        np.save(paths[-1], straight_run(COUNTS[0]))
    with pytest.raises(DataError) as caught:
        adopt(
            paths,
            output=tmp_path / "open",
            radius=0.12,
            frame_interval=0.5,
            bounds=BOX,
        )
    assert "along" in str(caught.value.where)
    assert "--periodic" in str(caught.value.fix)
