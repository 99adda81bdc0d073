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
    axes = []
    for low, high in BOX:
        share = (np.arange(side) + 0.5) / side
        axes.append(low + (high - low) * share)
    coordinates = np.meshgrid(*axes, indexing="ij")
    lattice = np.stack(coordinates, axis=-1).reshape(-1, 3)
    frames = np.arange(FRAMES)[:, None, None]
    position = lattice[:count] + frames * VELOCITY
    low, high = np.array(BOX).T
    wrapped = low + (position - low) % (high - low)
    is_periodic = [True, False, True]
    position = np.where(is_periodic, wrapped, position)
    return np.asarray(position, np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A set whose scenarios differ in particles."""
    folder = tmp_path_factory.mktemp("solid")
    walls = np.zeros((FRAMES, 6, 3))
    walls[:, 3, 0] = 0.25
    paths = []
    for number, count in enumerate(COUNTS):
        path = folder / f"run{number}.npz"
        np.savez(path, position=straight_run(count), wall_velocity=walls)
        paths.append(path)
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
    counts = tuple(size.particle_count(number) for number in range(4))
    assert counts == COUNTS
    path = size.path(made.folder.parent, 0)
    check_scenario(path)
    with read_scenario(path) as file:
        assert file.read("space").tolist() == ["x", "y", "z"]
        walls = file.read("wall").tolist()
        assert walls[4:] == ["front", "back"]
        wall_velocity = file.read("wall_velocity")
        assert wall_velocity.shape == (FRAMES, 6, 3)
        assert file.header.parameters["periodic"] == "x z"
        position = file.read("position")
    assert_array_equal(position, straight_run(COUNTS[0]))
    periodic_components = position[..., [0, 2]]
    assert (periodic_components < [1.0, 0.75]).all()


def test_statistics_follow_the_shortest_way(made: LocalSplit) -> None:
    """The mean velocity of a straight flight is its velocity."""
    measured = locate(made.folder).size.measured
    assert measured is not None
    statistics = measured.statistics
    assert_allclose(statistics["velocity_mean"], VELOCITY, atol=1e-7)
    assert_allclose(statistics["velocity_std"], 0.0, atol=1e-6)


def test_subsets_and_windows_have_three_components(made: LocalSplit) -> None:
    last_count = COUNTS[3]
    last_run = straight_run(last_count)
    with lagbench.open_split(made.folder, subset="test") as data:
        assert data["space"].values.tolist() == ["x", "y", "z"]
        counts = data["particle_count"].values
        assert counts.tolist() == list(COUNTS[2:])
        stored = data["position"].values[1, :, :last_count]
    assert_array_equal(stored, last_run)
    windows = lagbench.windows(made.folder, subset="test", history=2)
    window = windows[-1]
    expected = last_run[-3:].transpose(1, 0, 2)
    assert_array_equal(window.position, expected)
    assert window.wall_velocity is not None
    assert window.wall_velocity.shape == (3, 6, 3)


def test_predictions_are_ragged_and_valid(made: LocalSplit, tmp_path: Path) -> None:
    """What is written is read, and a swap of two scenarios is refused."""
    path = tmp_path / "predictions.nc"
    truth = {}
    for number in (2, 3):
        run = straight_run(COUNTS[number])
        truth[number] = run[3:]
    lagbench.submission.write(path, truth, split=made.folder, method="truth")
    result = lagbench.validate(path, root=made.folder.parent, isolated=False)
    assert result.valid
    assert not result.findings
    with open_predictions(path) as predictions:
        for number, position in truth.items():
            frames = predictions.frames(number, 3, FRAMES - 3)
            assert_array_equal(frames, position)
    swapped = {2: truth[3], 3: truth[2]}
    with pytest.raises(lagbench.errors.UsageError):
        lagbench.submission.write(path, swapped, split=made.folder, method="swapped")


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
    again = import_split(out, format=form, output=tmp_path / "again")
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
        path = tmp_path / f"run{number}.npy"
        np.save(path, straight_run(COUNTS[0]))
        paths.append(path)
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
