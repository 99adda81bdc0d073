"""Adopting one's own trajectories: what goes in comes out, hashed, with a task, or an
error says why not.
"""

from __future__ import annotations

import functools
import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pytest
from command_line import Result
from exchange_readers import straight_runs
from file_size_limit import largest_file
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

import lagbench
from lagbench.data.box import Box
from lagbench.data.checksums import dataset_hash, subset_hash
from lagbench.data.local import DESCRIPTION, locate, locate_split
from lagbench.data.manifest import read_manifest
from lagbench.data.scenario import check_scenario, read_scenario
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.exchange import adopt, import_split, local_split
from lagbench.exchange.adoption import _divide_into_subsets
from lagbench.exchange.local_split import LocalSplit
from lagbench.exchange.trajectory import (
    BoxTransform,
    Description,
    Trajectory,
    estimate_spacing,
)
from lagbench.submission.predictions import open_predictions
from lagbench.work.run import Progress

BASIC: dict[str, Any] = {
    "radius": 0.1,
    "frame_interval": 0.25,
}
UNIT_SQUARE = ((0.0, 1.0), (0.0, 1.0))
Runs = list[NDArray[np.float32]]
Run = Callable[..., Result]


def save_runs(folder: Path, runs: Runs) -> list[Path]:
    """Write each trajectory to a .npy file."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, run in enumerate(runs):
        path = folder / f"run{number}.npy"
        np.save(path, run)
        paths.append(path)
    return paths


def adopted(folder: Path, runs: Runs, **options: Any) -> LocalSplit:
    """Adopt each trajectory from a file of its own."""
    paths = save_runs(folder / "in", runs)
    return adopt(paths, output=folder / "mine", **(BASIC | options))


Adopt = Callable[..., LocalSplit]


@pytest.fixture
def adopt_here(tmp_path: Path) -> Adopt:
    """A function that adopts trajectories as ``mine`` in the folder of the test."""
    return functools.partial(adopt, output=tmp_path / "mine", **BASIC)


def stored(own_split: LocalSplit, number: int, name: str) -> NDArray[Any]:
    """Return an array of a scenario."""
    size, root, _ = locate(str(own_split.folder))
    with read_scenario(size.path(root, number)) as file:
        return file.read(name)


@pytest.fixture(scope="module")
def runs() -> Runs:
    """Six trajectories of 12 frames and 40 particles."""
    return straight_runs(6)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory, runs: Runs) -> LocalSplit:
    """A local split of these trajectories, four to train on."""
    return adopted(tmp_path_factory.mktemp("own"), runs, test=1)


def test_positions_come_out_as_they_went_in(own: LocalSplit, runs: Runs) -> None:
    """Every subset of the opened split holds the arrays bit for bit, the last ones in
    test.

    v(f) = (x(f) - x(f-1)) / interval, and v(0) = v(1).
    """
    for subset, expected in (
        ("train", runs[:4]),
        ("valid", runs[4:5]),
        ("test", runs[5:]),
    ):
        with lagbench.open_split(str(own.folder), subset=subset) as data:
            positions = data["position"].values
            assert_array_equal(positions, np.stack(expected))
            assert data["time"].values[-1] == 11 * 0.25
    velocity = stored(own, 0, "velocity")
    steps = np.diff(runs[0].astype(np.float64), axis=0)
    expected_velocity = (steps / 0.25).astype(np.float32)
    assert_array_equal(velocity[1:], expected_velocity)
    assert_array_equal(velocity[0], expected_velocity[0])


def test_hashes_follow_from_the_files(own: LocalSplit) -> None:
    """The data set hash is that of the files' own content hashes, and what split.yaml
    records.
    """
    size, root, _ = locate(str(own.folder))
    measured = size.measured
    assert measured is not None
    subset_hashes = {}
    for name, scenarios in (
        ("train", range(4)),
        ("valid", [4]),
        ("test", [5]),
    ):
        hashes = {}
        for scenario in scenarios:
            hashes[scenario] = check_scenario(size.path(root, scenario))
            beginning = hashes[scenario][:16]
            assert measured.scenario_sha256[scenario] == beginning
        subset_hashes[name] = subset_hash(hashes)
    assert len(measured.scenario_sha256) == 6
    expected = dataset_hash("mine", "full", 1, subset_hashes)
    assert own.dataset_sha256 == expected
    assert measured.dataset_sha256 == expected


def test_the_same_arrays_give_the_same_split(
    own: LocalSplit, tmp_path: Path, runs: Runs, adopt_here: Adopt
) -> None:
    """Once in files of their own, once as one array of four dimensions."""
    path = tmp_path / "all.npy"
    np.save(path, np.stack(runs))
    own_split = adopt_here(path, test=1)
    assert own_split.dataset_sha256 == own.dataset_sha256
    assert (own_split.folder / "split.yaml").read_bytes() == (
        own.folder / "split.yaml"
    ).read_bytes()


def test_a_local_split_is_verified_templated_and_scored(
    own: LocalSplit, tmp_path: Path
) -> None:
    """Commands take its folder; the naive baseline constant-velocity predicts straight
    flight.
    """
    path = str(own.folder)
    assert lagbench.verify(path).verdict == "equal to split.yaml"
    target = tmp_path / "predictions.nc"
    lagbench.template(path, output=target)
    card = lagbench.score(
        target,
        root=own.folder.parent,
        output_dir=tmp_path,
        workers=1,
    )
    straight = card.scores["constant-velocity"]["position_rmse"]
    assert np.max(straight.per_frame) < 1e-5
    at_rest = card.scores["persistence"]["position_rmse"]
    assert np.min(at_rest.per_frame) > 1e-3
    assert card.header.split == "mine"


def test_a_local_split_is_named_by_its_description_too(
    own: LocalSplit, monkeypatch: pytest.MonkeyPatch
) -> None:
    description = own.folder / "split.yaml"
    assert locate_split(str(description)).name == "mine"
    assert locate_split(description).root == own.folder.parent
    monkeypatch.chdir(own.folder)
    assert locate_split("split.yaml").root == own.folder.parent


def test_predictions_for_a_local_split_are_validated_and_compared(
    own: LocalSplit, tmp_path: Path
) -> None:
    """The split is named as in score: by its folder, without a root."""
    target = tmp_path / "predictions.nc"
    lagbench.template(str(own.folder), output=target)
    validation = lagbench.validate(target, split=f"{own.folder}/")
    validation.check()
    assert validation.split == "mine"
    with pytest.raises(UsageError, match="another split"):
        lagbench.validate(target, split="cavity")
    result = lagbench.compare(target, "persistence", split=f"{own.folder}/")
    assert result.split == "mine"
    assert result.second == "persistence"

    lagbench.score(target, split=str(own.folder), output_dir=tmp_path)
    scores = tmp_path / "scores.json"
    result = lagbench.compare(scores, "persistence", split=own.folder)
    assert result.split == "mine"
    with pytest.raises(UsageError) as caught:
        lagbench.compare(scores, "persistence", split="cavity")
    assert caught.value.where == str(scores)
    assert caught.value.expected == "cavity"


def test_progress_counts_towards_the_number_of_trajectories(tmp_path: Path) -> None:
    """Each subset ends with all of its trajectories written, of as many."""
    last_counts: dict[str, tuple[int, int, int]] = {}

    def note(report: Progress) -> None:
        counts = (report.scenarios_done, report.scenarios, report.total)
        last_counts[report.stage] = counts

    adopted(tmp_path, straight_runs(6), test=2, progress=note)
    assert last_counts == {
        "writing train": (3, 3, 3),
        "writing valid": (1, 1, 1),
        "writing test": (2, 2, 2),
    }


def test_ten_comes_after_two(tmp_path: Path) -> None:
    """Files count by the numbers in their names, as a shell lists them or in a folder;
    others stay.
    """
    listed_paths = []
    for number in (0, 1, 10, 11, 2):
        path = tmp_path / f"run{number}.npz"
        path.write_bytes(b"1")
        listed_paths.append(path)
    expected = {
        "train": ["run0", "run1", "run2"],
        "valid": ["run10"],
        "test": ["run11"],
    }
    for paths in (listed_paths, [tmp_path]):
        subsets = _divide_into_subsets(paths, valid=1, test=1)
        assert subsets.keys() == expected.keys()
        for subset, rows in subsets.items():
            stems = [path.stem for path, _ in rows]
            assert stems == expected[subset]
    subsets = _divide_into_subsets(listed_paths[::-1], valid=1, test=1)
    ((last_path, _),) = subsets["test"]
    assert last_path.stem == "run0"


@pytest.mark.parametrize("ending", ["npy", "npz", "nc"])
def test_an_empty_file_is_no_trajectory(tmp_path: Path, ending: str) -> None:
    """The error says that it is empty, and does not say that there are too few."""
    save_runs(tmp_path, straight_runs(2))
    (tmp_path / f"run2.{ending}").touch()
    with pytest.raises(UnreadableFileError) as caught:
        adopt(tmp_path, output=tmp_path / "mine", **BASIC)
    assert caught.value.where == str(tmp_path / f"run2.{ending}")


def motion(run: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return velocities as forward differences over a quarter of a second."""
    beyond_the_last = 2 * run[-1:] - run[-2:-1]
    step = np.diff(run, axis=0, append=beyond_the_last)
    return np.asarray(4 * step, np.float32)


@pytest.mark.parametrize("factor", [-1.0, 0.0, 0.1, 10.0])
def test_velocities_that_contradict_the_motion_are_refused(
    tmp_path: Path, factor: float, adopt_here: Adopt
) -> None:
    """Another unit or direction is a mistake; nothing is written."""
    folder = tmp_path / "in"
    folder.mkdir()
    for number, run in enumerate(straight_runs(3)):
        velocity = factor * motion(run)
        np.savez(folder / f"{number}.npz", position=run, velocity=velocity)
    with pytest.raises(DataError, match="contradict the motion") as caught:
        adopt_here(folder)
    assert "0.npz" in str(caught.value.where)
    assert not (tmp_path / "mine").exists()


def test_two_arrays_of_one_name_are_refused(tmp_path: Path, adopt_here: Adopt) -> None:
    """Which one counts would depend on the reader."""
    paths = [tmp_path / f"{number}.npz" for number in range(3)]
    for path, run in zip(paths, straight_runs(3), strict=True):
        np.savez(path, position=run)
    with zipfile.ZipFile(paths[0]) as archive:
        content = archive.read("position.npy")
    with (
        pytest.warns(match="Duplicate name"),
        zipfile.ZipFile(paths[0], "a") as archive,
    ):
        archive.writestr("position.npy", content)
    with pytest.raises(UnreadableFileError) as caught:
        adopt_here(paths)
    assert caught.value.where == str(paths[0])


@pytest.mark.parametrize("ending", ["npy", "nc"])
def test_exchanged_axes_are_refused_until_they_are_stated(
    tmp_path: Path, ending: str, adopt_here: Adopt
) -> None:
    """Stated, the split is that of the usual order."""
    runs = straight_runs(3, frames=12, particles=40)
    paths = []
    for number, run in enumerate(runs):
        path = tmp_path / f"run{number}.{ending}"
        exchanged = run.swapaxes(0, 1)
        paths.append(path)
        if ending == "npy":
            np.save(path, exchanged)
            continue
        with netCDF4.Dataset(path, "w") as file:
            variable(file, exchanged.shape, "f4")[:] = exchanged
    with pytest.raises(DataError, match="look exchanged"):
        adopt_here(paths)
    own_split = adopt_here(paths, axes=("particle", "frame", "space"))
    position = stored(own_split, 2, "position")
    assert_array_equal(position, runs[2])
    with pytest.raises(UsageError, match="no order of axes"):
        adopt_here(paths, output=tmp_path / "other", axes=("frame", "space"))


def test_a_lattice_that_flies_far_is_no_exchange(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """Its particles are nearer to each other than two frames of one of them."""
    x, y = np.meshgrid(np.arange(20), np.arange(20))
    lattice = np.stack([x, y], axis=-1).reshape(-1, 2)
    start = 0.1 + 0.004 * lattice
    rng = np.random.default_rng(0)
    start = start[rng.permutation(len(start))]
    time = np.arange(30)[:, None, None]
    flight = 0.02 * time * np.array([1.0, 0.3])
    run = (start + flight).astype(np.float32)
    paths = save_runs(tmp_path / "in", [run, run + 1e-3, run + 2e-3])
    own_split = adopt_here(paths)
    assert own_split.frames == 90


def test_one_error_names_all_missing_options(tmp_path: Path) -> None:
    """Radius, frame interval, folder and trajectories."""
    paths = save_runs(tmp_path / "in", straight_runs(2))
    with pytest.raises(UsageError) as caught:
        adopt(paths)
    for words in ("--radius", "--frame-interval", "--output", "2 trajectories"):
        assert words in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "test_count"),
    [
        (4, 1),
        (12, 4),
        (20, 6),
        (70, 7),
    ],
)
def test_test_has_enough_trajectories_for_a_p_value(
    tmp_path: Path, count: int, test_count: int, adopt_here: Adopt
) -> None:
    """Six where train can spare them; with fewer a note says so."""
    path = tmp_path / "runs.npy"
    np.save(path, np.stack(straight_runs(count)))
    own_split = adopt_here(path)
    noun = "trajectory" if test_count == 1 else "trajectories"
    has_note = any(f"{test_count} {noun} for" in note for note in own_split.notes)
    assert own_split.scenarios["test"] == test_count
    assert has_note == (test_count < 6)


@pytest.mark.parametrize("moves", [True, False])
def test_a_set_in_which_nothing_moves_has_a_note(
    tmp_path: Path, moves: bool, adopt_here: Adopt
) -> None:
    run = straight_runs(1)[0]
    if not moves:
        run = np.broadcast_to(run[0], run.shape)
    path = tmp_path / "runs.npy"
    np.save(path, np.stack([run] * 20))
    own_split = adopt_here(path)
    has_note = any("no particle of train moves" in note for note in own_split.notes)
    assert has_note != moves


def test_a_note_states_the_walls_that_nobody_stated(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """The highest particle of all frames would else become a ceiling unnoticed."""
    runs = np.stack(straight_runs(20))
    path = tmp_path / "runs.npy"
    np.save(path, runs)
    own_split = adopt_here(path)
    low = runs.min(axis=(0, 1, 2))
    high = runs.max(axis=(0, 1, 2))
    assert own_split.bounds == pytest.approx(np.stack([low, high], 1))
    (note,) = own_split.notes
    assert f"{high[1]:.6g}]" in note
    assert "--bounds" in note


def test_stated_walls_need_no_note(tmp_path: Path, adopt_here: Adopt) -> None:
    path = tmp_path / "runs.npy"
    np.save(path, np.stack(straight_runs(20)))
    own_split = adopt_here(path, bounds=((0.0, 1.0), (0.0, 1.0)))
    assert own_split.bounds == ((0.0, 1.0), (0.0, 1.0))
    assert own_split.notes == ()


def test_without_bounds_the_extent_of_all_positions_is_fitted(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """A scale that is a power of two."""
    runs = [8.0 * run - 5.0 for run in straight_runs(3)]
    paths = save_runs(tmp_path / "in", runs)
    own_split = adopt_here(paths, rescale=True, radius=0.8)
    size = locate(own_split.folder).size
    all_positions = np.stack(runs).reshape(-1, 2)
    extent = np.ptp(all_positions, axis=0)
    scale = 2.0 ** np.ceil(np.log2(extent.max()))
    expected = np.stack([np.zeros(2), extent / scale], axis=1)
    assert_allclose(size.bounds, expected)


def test_trajectories_may_lie_in_the_home_folder(
    tmp_path: Path, adopt_here: Adopt, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_runs(tmp_path / "in", straight_runs(3))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert adopt_here("~/in").scenarios == {"train": 1, "valid": 1, "test": 1}
    several = [f"~/in/run{number}.npy" for number in range(3)]
    own_split = adopt_here(several, output=tmp_path / "other")
    assert own_split.scenarios == {"train": 1, "valid": 1, "test": 1}


def test_without_bounds_a_fitted_extent_is_that_of_one_dimension(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """The trajectory that differs is named, and no option that nobody gave."""
    runs: list[NDArray[Any]] = list(straight_runs(3))
    height = np.full((*runs[2].shape[:2], 1), 0.5, np.float32)
    runs[2] = np.concatenate([runs[2], height], axis=2)
    paths = save_runs(tmp_path / "in", runs)
    with pytest.raises(DataError) as caught:
        adopt_here(paths, rescale=True)
    assert caught.value.where == str(paths[2])
    assert "--bounds" not in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, -1e39])
def test_without_bounds_a_position_beyond_float32_is_named(
    tmp_path: Path, adopt_here: Adopt, value: float
) -> None:
    """As with bounds: the fitted box would have no side of float32."""
    runs: list[NDArray[Any]] = [run.astype(np.float64) for run in straight_runs(3)]
    runs[1][3, 7, 1] = value
    paths = save_runs(tmp_path / "in", runs)
    with pytest.raises(DataError) as caught:
        adopt_here(paths, rescale=True)
    assert str(caught.value.where) == f"{paths[1]}, frame 3, particle 7"


def test_an_npz_file_may_hold_velocities_materials_and_walls(
    tmp_path: Path, runs: Runs, adopt_here: Adopt
) -> None:
    """An .npz file may hold velocities, materials and walls; all of them are stored."""
    wall_velocity = np.zeros((4, 2))
    wall_velocity[3, 0] = 0.5
    named = {
        "material": np.arange(40) % 4,
        "wall_velocity": wall_velocity,
    }
    paths = []
    for number, run in enumerate(runs[:3]):
        path = tmp_path / f"{number}.npz"
        paths.append(path)
        np.savez(
            path,
            position=run,
            velocity=motion(run),
            **named,
        )
    own_split = adopt_here(paths)
    velocity = stored(own_split, 2, "velocity")
    assert_array_equal(velocity, motion(runs[2]))
    material = stored(own_split, 2, "material")
    assert_array_equal(material, named["material"])
    stored_wall_velocity = stored(own_split, 2, "wall_velocity")
    assert_array_equal(stored_wall_velocity[5], wall_velocity)


def variable(
    file: netCDF4.Dataset,
    shape: tuple[int, ...],
    kind: str,
) -> netCDF4.Variable:
    """Return a new variable for positions."""
    names = ("time", "point", "axis")
    for name, length in zip(names, shape, strict=True):
        file.createDimension(name, length)
    return file.createVariable("position", kind, names)


def test_the_message_names_the_arrays_of_a_file_without_positions(
    tmp_path: Path, runs: Runs, adopt_here: Adopt
) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, pos=runs[0], vel=runs[0])
    with pytest.raises(UnreadableFileError) as caught:
        adopt_here([path, *save_runs(tmp_path / "in", runs[:2])])
    assert caught.value.got == "'pos', 'vel'"
    assert "'position'" in str(caught.value.expected)


def test_the_particle_without_a_position_is_named(
    tmp_path: Path, runs: Runs, adopt_here: Adopt
) -> None:
    broken = runs[0].copy()
    broken[3, 7, 1] = np.nan
    paths = save_runs(tmp_path / "in", [broken, *runs[1:3]])
    with pytest.raises(DataError) as caught:
        adopt_here(paths)
    assert str(caught.value.where).endswith("frame 3, particle 7")


def test_netcdf_files_are_adopted_frame_by_frame(
    tmp_path: Path, runs: Runs, adopt_here: Adopt
) -> None:
    """NetCDF files of double precision in subset folders are read frame by frame,
    rounded once.
    """
    for number, subset in enumerate(("train", "valid", "test")):
        folder = tmp_path / "in" / subset
        folder.mkdir(parents=True)
        run = runs[number]
        with netCDF4.Dataset(folder / "a.nc", "w") as file:
            position = variable(file, run.shape, "f8")
            position[:] = run + 1e-9
    own_split = adopt_here(tmp_path / "in")
    assert own_split.scenarios == {
        "train": 1,
        "valid": 1,
        "test": 1,
    }
    in_doubles = runs[2].astype(np.float64) + 1e-9
    position = stored(own_split, 2, "position")
    assert_array_equal(position, in_doubles.astype(np.float32))


def test_packed_netcdf_is_refused(
    tmp_path: Path, runs: Runs, adopt_here: Adopt
) -> None:
    """With scale_factor, the stored values are not positions: the error names the
    file.
    """
    paths = save_runs(tmp_path, runs[:2])
    packed = tmp_path / "packed.nc"
    with netCDF4.Dataset(packed, "w") as file:
        position = variable(file, runs[2].shape, "f4")
        position.scale_factor = 2.0
        position[:] = runs[2]
    with pytest.raises(UnreadableFileError) as caught:
        adopt_here([*paths, packed])
    assert caught.value.where.endswith("packed.nc, position, scale_factor")


def test_the_folder_of_another_writer_is_left_alone(
    tmp_path: Path, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A temporary folder of the same name, as of another machine, is neither used nor
    removed.
    """
    theirs = tmp_path / ".mine.partial"
    theirs.mkdir()
    monkeypatch.setattr(local_split, "temporary_name", lambda _: theirs)
    with pytest.raises(WorkFailedError) as caught:
        adopted(tmp_path, runs)
    assert caught.value.where.endswith("/mine")
    assert theirs.is_dir()


def assert_says_what_happened(error: LagbenchError) -> None:
    """Assert that an error has all its parts and blames no full disk."""
    for part in (error.what, error.expected, error.got, error.fix):
        assert part
    assert "disk space" not in str(error)


@pytest.mark.slow
def test_the_folder_that_another_process_made_meanwhile_stays_whole(
    tmp_path: Path, runs: Runs
) -> None:
    """Of two that adopt into one folder at once the first one to end wins; the other
    one says so, and leaves nothing behind.
    """
    sources = save_runs(tmp_path / "other", runs)
    command = [sys.executable, "-m", "lagbench", "adopt", *map(str, sources)]
    command += ["--radius", "0.1", "--frame-interval", "0.5"]
    command += ["-o", str(tmp_path / "mine"), "--quiet"]

    has_ended: list[bool] = []

    def adopt_elsewhere(progress: Progress) -> None:
        if progress.done and not has_ended:
            subprocess.run(command, check=True, timeout=600)
            has_ended.append(True)

    with pytest.raises(UsageError) as caught:
        adopted(tmp_path, runs, progress=adopt_elsewhere)
    assert has_ended
    assert caught.value.where == str(tmp_path / "mine")
    assert_says_what_happened(caught.value)

    size, root, _ = locate(str(tmp_path / "mine"))
    assert size.value("frame_rate") == 2.0  # of the other process, not 1/0.25
    assert size.measured is not None
    for scenario, beginning in size.measured.scenario_sha256.items():
        assert check_scenario(size.path(root, scenario))[:16] == beginning
    assert {path.name for path in tmp_path.iterdir()} == {"in", "other", "mine"}


def test_a_call_of_the_same_process_into_the_same_folder_is_refused(
    tmp_path: Path, runs: Runs
) -> None:
    """The call that began first ends well; the other one says who is in the way."""
    errors: list[WorkFailedError] = []

    def adopt_too(progress: Progress) -> None:
        if progress.done and not errors:
            with pytest.raises(WorkFailedError) as caught:
                adopted(tmp_path, runs)
            errors.append(caught.value)

    split = adopted(tmp_path, runs, progress=adopt_too)
    assert errors[0].where == str(tmp_path / "mine")
    assert_says_what_happened(errors[0])
    assert split.folder == tmp_path / "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"in", "mine"}


KILLED = """
import os, signal, sys
from lagbench.exchange import adopt

def die(progress):
    if progress.done > 1:
        os.kill(os.getpid(), signal.SIGKILL)

sources, output = sys.argv[1:]
adopt(sources, output=output, radius=0.1, frame_interval=0.25, progress=die)
"""


def test_what_a_killed_call_left_is_removed_by_the_next_one(
    tmp_path: Path, runs: Runs
) -> None:
    """The folder of a call that works, or of another target, is left alone."""
    save_runs(tmp_path / "in", runs)
    for name in ("mine", "other"):
        command = [sys.executable, "-c", KILLED, tmp_path / "in", tmp_path / name]
        assert subprocess.run(command, timeout=100).returncode == -signal.SIGKILL
    leftovers = [path.name for path in tmp_path.glob(".*.partial")]
    assert len(leftovers) == 2

    adopted(tmp_path, runs)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"in", "mine"} < names
    (left,) = names - {"in", "mine"}
    assert left.startswith(".other.")


def test_an_error_of_who_watches_goes_on_as_it_is(tmp_path: Path, runs: Runs) -> None:
    """A pipe that broke, or a service that failed, is no disk that is full."""
    failure = WorkFailedError("no answer", where="elsewhere", fix="wait")
    for error in (BrokenPipeError(32, "Broken pipe"), failure):

        def fail(_: Progress, error: Exception = error) -> None:
            raise error

        with pytest.raises(type(error)) as caught:
            adopted(tmp_path, runs, progress=fail)
        assert caught.value is error
        assert {path.name for path in tmp_path.iterdir()} == {"in"}


def test_a_full_disk_is_named_by_the_folder_to_make(tmp_path: Path, runs: Runs) -> None:
    sources = save_runs(tmp_path / "in", runs)
    with largest_file(3000), pytest.raises(WorkFailedError) as caught:
        adopt(sources, output=tmp_path / "mine", **BASIC)
    assert caught.value.where == str(tmp_path / "mine")
    assert "--output" in str(caught.value.fix)
    assert {path.name for path in tmp_path.iterdir()} == {"in"}


def test_a_link_that_leads_nowhere_is_no_place_for_a_folder(
    tmp_path: Path, runs: Runs
) -> None:
    (tmp_path / "gone").symlink_to(tmp_path / "nothing")
    sources = save_runs(tmp_path / "in", runs)
    with pytest.raises(WorkFailedError) as caught:
        adopt(sources, output=tmp_path / "gone" / "mine", **BASIC)
    assert caught.value.where == str(tmp_path / "gone" / "mine")
    assert "--output" in str(caught.value.fix)


@pytest.mark.parametrize("material", [9, -1])
def test_unknown_materials_are_refused(
    tmp_path: Path, runs: Runs, material: int
) -> None:
    """Also of who gives trajectories without a file, so that nothing checked them."""
    subsets = {}
    for number, subset in enumerate(("train", "valid", "test")):
        positions = runs[number]
        trajectory = Trajectory(
            name=subset,
            frames=len(positions),
            material=np.full(positions.shape[1], material),
            read=lambda positions=positions: ((frame, None) for frame in positions),
        )
        subsets[subset] = [trajectory]
    description = Description(
        name="mine", source="a test", radius=0.1, frame_interval=0.25
    )
    with pytest.raises(DataError) as caught:
        local_split.make_local_split(
            description, subsets, tmp_path / "mine", command="adopt"
        )
    assert str(caught.value.where).endswith("variable 'material'")
    assert not list(tmp_path.iterdir())


def test_the_order_of_the_periodic_axes_changes_nothing(
    tmp_path: Path, runs: Runs
) -> None:
    sources = save_runs(tmp_path / "in", runs)
    hashes = set()
    descriptions = set()
    for number, periodic in enumerate((("x", "y"), ("y", "x"))):
        split = adopt(
            sources,
            output=tmp_path / str(number) / "mine",
            periodic=periodic,
            bounds=UNIT_SQUARE,
            **BASIC,
        )
        hashes.add(split.dataset_sha256)
        descriptions.add((split.folder / DESCRIPTION).read_text())
    assert len(hashes) == len(descriptions) == 1


def test_scenarios_may_differ_in_length_and_particles(tmp_path: Path) -> None:
    """Ragged trajectories are padded when opened; the task follows the shortest
    scenario of test and valid.
    """
    ragged = []
    for frames, particles in (
        (12, 40),
        (20, 30),
        (15, 25),
        (30, 40),
        (18, 40),
    ):
        (run,) = straight_runs(1, frames=frames, particles=particles, seed=frames)
        ragged.append(run)
    own_split = adopted(tmp_path, ragged, test=2)
    assert own_split.horizon == 9  # 15 frames of valid, 18 and 30 of test
    assert own_split.particles == (25, 40)
    with lagbench.open_split(str(own_split.folder), subset="train") as data:
        assert data["frame_count"].values.tolist() == [12, 20]
        assert data["particle_count"].values.tolist() == [40, 30]
        position = data["position"].values
    assert_array_equal(position[1, :20, :30], ragged[1])
    path = tmp_path / "p.nc"
    lagbench.template(str(own_split.folder), output=path)
    result = lagbench.validate(path, root=tmp_path)
    assert result.valid


def test_a_horizon_that_valid_is_too_short_for_is_refused(tmp_path: Path) -> None:
    """A training could not predict the scenarios of valid."""
    ragged = []
    for frames in (20, 12, 20):
        ragged.extend(straight_runs(1, frames=frames, seed=frames))
    with pytest.raises(UsageError) as caught:
        adopted(tmp_path, ragged, test=1, valid=1, horizon=10)
    assert "valid" in caught.value.what
    assert "at most 12 frames" in str(caught.value)


@pytest.mark.slow
def test_unequal_test_scenarios_are_predicted_without_padding(tmp_path: Path) -> None:
    """Each scenario has as many particles in its predictions as in its file."""
    ragged = []
    for particles in (40, 40, 30, 20):
        (run,) = straight_runs(1, particles=particles)
        ragged.append(run)
    own_split = adopted(tmp_path, ragged, test=2, valid=1)
    path = tmp_path / "p.nc"
    lagbench.template(str(own_split.folder), output=path)
    result = lagbench.validate(path, root=tmp_path)
    assert result.valid
    with open_predictions(path) as predictions:
        first = predictions.header.frames[0]
        for scenario, count in ((2, 30), (3, 20)):
            frames = predictions.frames(scenario, first, 1)
            assert frames.shape == (1, count, 2)
            assert np.isfinite(frames).all()


def test_a_wide_box_is_fitted_without_losing_a_bit(tmp_path: Path) -> None:
    """A box of 3 is divided by 4: times 4, every position is the source's."""
    wide = straight_runs(3, box=3.0)
    own_split = adopted(
        tmp_path,
        wide,
        radius=0.3,
        bounds=((0.0, 3.0), (0.0, 3.0)),
        rescale=True,
    )
    size = locate(str(own_split.folder)).size
    assert size.task.radius == 0.075
    assert size.bounds[0] == (0.0, 0.75)
    assert size.value("source_scale") == 4.0
    position = stored(own_split, 0, "position")
    assert_array_equal(4 * position, wide[0])


@pytest.mark.parametrize(
    ("bounds", "scale", "corner"),
    [
        (
            ((0.0, 1.0), (0.0, 0.5)),
            1.0,
            (0.0, 0.0),
        ),
        (
            ((0.1, 5.3), (0.0, 2.0)),
            8.0,
            (0.0, 0.0),
        ),
        (
            ((-1.0, 1.0), (0.0, 3.0)),
            4.0,
            (-1.0, 0.0),
        ),
        (
            ((7.0, 7.5), (7.0, 7.25)),
            1.0,
            (7.0, 7.0),
        ),
        (
            ((1000.0, 1001.0), (1000.0, 1001.0)),
            1.0,
            (1000.0, 1000.0),
        ),
        (
            ((0.0, 0.001), (0.0, 0.0005)),
            2.0**-9,
            (0.0, 0.0),
        ),
        (
            ((0.0, 1024.0), (0.0, 1024.0 * (1.0 + 2.0**-52))),
            2048.0,
            (0.0, 0.0),
        ),
    ],
)
def test_a_fitted_box_lies_in_the_unit_box(
    bounds: Any, scale: float, corner: tuple[float, float]
) -> None:
    """Scale and corner are the least that bring a box into the unit box."""
    transform = BoxTransform.fit(bounds)
    assert transform.scale == scale
    assert transform.corner == corner
    box = np.array(transform.transform_box(bounds))
    assert box.min() >= 0.0
    assert box.max() <= 1.0


def test_periods_that_no_grid_fits_become_one() -> None:
    """As 2 pi; a period of 1.12, which is 14 cells of 0.08, is halved without loss."""
    cube = ((0.0, 2.0 * math.pi),) * 3
    transform = BoxTransform.fit(cube, ("x", "y", "z"))
    assert transform.transform_box(cube) == ((0.0, 1.0),) * 3
    assert BoxTransform.fit(cube).scale == 8.0
    assert BoxTransform.fit(((0.0, 1.12),) * 2, ("x", "y")).scale == 2.0
    channel = ((0.0, 2.0 * math.pi), (0.0, 8.0))  # its walls are further apart
    assert BoxTransform.fit(channel, ("x",)).scale == 4.0 * math.pi
    # no scale helps where the ratio of the periods is irrational
    assert BoxTransform.fit(((0.0, 1.0), (0.0, math.sqrt(2.0))), ("x", "y")).scale == 2


@pytest.mark.parametrize("radius", [0.012, 0.026, 0.06])
@pytest.mark.parametrize(("dimension", "across"), [(2, 6), (2, 40), (3, 6), (3, 12)])
def test_the_spacing_of_a_lattice_is_found(
    dimension: int, across: int, radius: float
) -> None:
    """The estimate is within 1 % of the lattice constant, whatever the radius."""
    axis = 0.2 + 0.01 * np.arange(across)
    points = np.stack(np.meshgrid(*[axis] * dimension), axis=-1)
    spacing = estimate_spacing(points.reshape(-1, dimension), radius)
    assert math.isclose(spacing, 0.01, rel_tol=0.01)


@pytest.mark.parametrize("low", [0.0, -1.0, 0.013, 5.0])
@pytest.mark.parametrize("periodic", [(True, True, True), (True, False, False)])
def test_the_spacing_in_a_periodic_box_is_found(
    periodic: tuple[bool, ...], low: float
) -> None:
    """In a cube of eight particles a side each has neighbours across the ends, wherever
    the box begins.
    """
    axis = low + (np.arange(8) + 0.5) / 8
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    box = Box.from_bounds([(low, low + 1.0)] * 3, periodic)
    for radius in (0.2, 0.45):
        assert math.isclose(estimate_spacing(cube, radius, box), 0.125, rel_tol=0.01)


@pytest.mark.parametrize("shape", [(100, 6), (40, 40, 6)])
def test_the_spacing_of_a_thin_layer_is_found(shape: tuple[int, ...]) -> None:
    """Most of its particles are near a surface."""
    axes = [0.005 * np.arange(count) for count in shape]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(shape))
    assert math.isclose(estimate_spacing(points, 0.01), 0.005, rel_tol=0.01)


def test_the_spacing_of_random_positions_is_near() -> None:
    """Their mean volume is known; the estimate is at most 10 % off."""
    positions = np.random.default_rng(0).random((4000, 2))
    box = Box.from_bounds([(0.0, 1.0)] * 2, [True] * 2)
    spacing = estimate_spacing(positions, 0.03, box)
    assert math.isclose(spacing, 4000**-0.5, rel_tol=0.1)


def test_particles_at_one_place_have_no_spacing() -> None:
    with pytest.raises(UsageError):
        estimate_spacing(np.full((50, 2), 0.5), 0.1)


def holed(run: NDArray[np.float32], frame: int, value: float) -> NDArray[np.float32]:
    """Return a trajectory with another number in one place."""
    run[frame, 5, 0] = value
    return run


Run = NDArray[np.float32]
Fault = tuple[Callable[[Run], NDArray[Any]], type[LagbenchError], str]
BROKEN: dict[str, Fault] = {
    "flat": (
        lambda run: run[0],
        UnreadableFileError,
        "no positions",
    ),
    "space": (
        lambda run: np.concatenate([run, run], axis=-1),
        DataError,
        "4 components",
    ),
    "transposed": (
        lambda run: run.swapaxes(1, 2),
        DataError,
        "40 components",
    ),
    "integer": (
        lambda run: run.astype(np.int32),
        UnreadableFileError,
        "no positions",
    ),
    "single": (
        lambda run: run[:1],
        DataError,
        "too little",
    ),
    "missing": (
        lambda run: holed(run, 3, np.nan),
        DataError,
        "not finite",
    ),
    "missing at once": (
        lambda run: holed(run, 0, np.nan),
        DataError,
        "not finite",
    ),
    "beyond float32": (
        lambda run: run.astype(np.float64) * 1e300,
        DataError,
        "not finite",
    ),
    "outside": (
        lambda run: holed(run, 3, 1.5),
        DataError,
        "outside the unit box",
    ),
    "objects": (
        lambda run: np.array([run, None], dtype=object),
        UnreadableFileError,
        "pickled",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_no_trajectory_leaves_nothing(
    tmp_path: Path, kind: str, adopt_here: Adopt
) -> None:
    """Each fault has its message, which names the file, and no folder is made."""
    broken, error, words = BROKEN[kind]
    paths = save_runs(tmp_path / "in", straight_runs(3))
    (run,) = straight_runs(1)
    np.save(paths[2], broken(run), allow_pickle=True)
    with pytest.raises(error, match=words) as caught:
        adopt_here(paths)
    assert "run2.npy" in str(caught.value)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["in"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"radius": None},
            "the radius is not known",
        ),
        (
            {"radius": -1.0},
            "where: --radius",
        ),
        (
            {"frame_interval": 1e-12},
            "where: --frame-interval",
        ),
        (
            {"horizon": 7},
            "too short for the task",
        ),
        *(({"horizon": count}, "where: --horizon") for count in (0, -1)),
        (
            {"input_frames": 1},
            "where: --input-frames",
        ),
        (
            {"input_frames": 12},
            "too short for the task",
        ),
        (
            {"test": 3, "valid": 3},
            "each subset needs a trajectory",
        ),
        (
            {"bounds": ((1.0, 0.0), (0.0, 1.0))},
            "low to high",
        ),
        (
            {"bounds": ((0.0, 0.3), (0.0, 1.0))},
            "outside the stated bounds",
        ),
        (
            {"output": "My Data"},
            "--output my-data",
        ),
        (
            {"output": "cavity"},
            "one of the splits of lagbench",
        ),
        (
            {"output": "in"},
            "there already",
        ),
    ],
)
def test_what_a_user_says_is_checked(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    """Wrong options are usage errors that name the option, and no folder is made."""
    paths = save_runs(tmp_path / "in", straight_runs(4))
    options = {
        "output": "mine",
        **BASIC,
        **changes,
    }
    options["output"] = tmp_path / options["output"]
    with pytest.raises(UsageError, match=words):
        adopt(paths, **options)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["in"]


def test_the_adopt_command_makes_a_split_that_other_commands_take(
    tmp_path: Path, run: Run
) -> None:
    """`lagbench adopt` says what it made, and other commands take the folder it
    names.
    """
    paths = save_runs(tmp_path / "in", straight_runs(4))
    target = tmp_path / "mine"
    options = [
        "--radius",
        "0.1",
        "--frame-interval",
        "0.25",
        "--frames-of-interest",
        "8,10",
    ]
    done = run("adopt", *paths, "-o", target, *options, "--bounds", "0,1,0.25,1")
    assert done.exit_code == 0, done.output
    assert "2 train, 1 valid, 1 test, 48 frames, 40 particles" in done.stdout
    size = locate(str(target)).size
    assert size.task.frames_of_interest == (8, 10)
    assert size.bounds == ((0.0, 1.0), (0.25, 1.0))
    assert "mine" in run("info", f"{target}/").stdout
    refused = run("generate", "--split", target)
    assert refused.exit_code == 2
    assert "cannot be simulated" in refused.output


def test_the_next_steps_of_adopted_data_are_commands_that_work(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file of recipes that the hint writes has a recipe for the data."""
    monkeypatch.chdir(tmp_path)
    paths = save_runs(tmp_path / "in", straight_runs(4))
    done = run(
        "adopt", *paths, "-o", "my-data", "--radius", "0.1", "--frame-interval", "0.25"
    )
    commands = []
    for line in done.stdout.splitlines():
        words = line.split("lagbench ", 1)
        if "echo " in line:
            subprocess.run(line, shell=True, check=True)
        elif len(words) == 2 and "--split" in line:
            commands.append(shlex.split(words[1]))
    template, *trainings = commands
    assert run(*template).exit_code == 0
    assert (tmp_path / "predictions.nc").exists()
    assert len(trainings) == 2
    for train in trainings:
        refused = run(*train, "--set", "training.steps=none")
        assert "training.steps" in refused.stderr


PLAIN: dict[str, Any] = {
    "radius": 0.15,
    "frame_interval": 0.25,
    "density": 1.5,
    "spacing": 0.05,
    "cells": 8,
    "input_frames": 3,
    "horizon": 8,
    "frames_of_interest": (10,),
    "bounds": UNIT_SQUARE,
    "full_box": True,
}


@pytest.mark.parametrize("spelled", ["numpy", "texts and floats"])
def test_numbers_may_be_spelled_otherwise(tmp_path: Path, spelled: str) -> None:
    """NumPy's scalars and arrays, and what --describe takes for numbers, give the same
    description.
    """
    paths = save_runs(tmp_path / "in", straight_runs(3))
    other = {
        **PLAIN,
        "radius": "0.15",
        "cells": 8.0,
        "horizon": 8.0,
        "density": "1.5",
        "title": None,
    }
    if spelled == "numpy":
        other = {name: np.asarray(value)[()] for name, value in PLAIN.items()}
        other["density"] = np.float32(1.5)
    texts = [
        (
            adopt(paths, output=tmp_path / kind / "mine", **wishes).folder
            / "split.yaml"
        ).read_bytes()
        for kind, wishes in (("plain", PLAIN), ("other", other))
    ]
    assert texts[0] == texts[1]


@pytest.mark.parametrize(
    ("wish", "key"),
    [
        (
            {"radius": "far"},
            "radius",
        ),
        (
            {"density": [1.0]},
            "density",
        ),
        (
            {"cells": 16.5},
            "cells",
        ),
        (
            {"horizon": "all"},
            "horizon",
        ),
        (
            {"horizon": np.array([5])},
            "horizon",
        ),
        (
            {"horizon": 10**5000},
            "horizon",
        ),
        (
            {"frames_of_interest": 8},
            "frames_of_interest",
        ),
        (
            {"frames_of_interest": [10**5000]},
            "frames_of_interest.0",
        ),
        ({"title": 3}, "title"),
        (
            {"title": 10**5000},
            "title",
        ),
        (
            {"bounds": ((0.0, 1.0),) * 4},
            "bounds",
        ),
        (
            {"bounds": 1.0},
            "bounds",
        ),
        (
            {"raduis": 0.1},
            "raduis",
        ),
    ],
)
def test_a_value_that_does_not_fit_names_its_key(
    tmp_path: Path, wish: dict[str, Any], key: str, adopt_here: Adopt
) -> None:
    """By adopt and by import, before a file is looked at."""
    with pytest.raises(UsageError) as adopted:
        adopt_here(tmp_path / "none", **wish)
    with pytest.raises(UsageError) as imported:
        import_split(
            tmp_path / "none",
            format="gns-npz",
            output=tmp_path / "mine",
            **wish,
        )
    assert adopted.value.where == imported.value.where == key
    assert not list(tmp_path.iterdir())


def test_walls_in_some_trajectories_only_are_refused(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """Whichever of them come first, the error names the first that is otherwise."""
    for walled in ({0}, {1, 2}):
        paths = []
        for number, run in enumerate(straight_runs(3)):
            paths.append(tmp_path / f"run{number}.npz")
            walls = {"wall_velocity": np.zeros((4, 2))} if number in walled else {}
            np.savez(paths[-1], position=run, **walls)
        with pytest.raises(DataError) as caught:
            adopt_here(paths)
        assert caught.value.where == str(paths[1])
        assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("way", ["twice", "folder", "link", "subsets"])
def test_a_trajectory_named_twice_is_refused(tmp_path: Path, way: str) -> None:
    """It would be trained on and tested: by its name, in its folder, by a link, and in
    two subsets.
    """
    paths = save_runs(tmp_path / "in", straight_runs(4))
    link = tmp_path / ("in/test/run9.npy" if way == "subsets" else "run9.npy")
    paths_by_way = {
        "twice": [*paths, paths[0]],
        "folder": [tmp_path / "in", paths[2]],
        "link": [*paths, link],
    }
    if way == "subsets":
        for subset, path in zip(("train", "valid", "test"), paths, strict=False):
            (tmp_path / "in" / subset).mkdir()
            path.rename(tmp_path / "in" / subset / path.name)
        link.symlink_to(tmp_path / "in/train/run0.npy")
    elif way == "link":
        link.symlink_to(paths[1])
    sources = paths_by_way.get(way, [tmp_path / "in"])
    with pytest.raises(UsageError) as caught:
        adopt(sources, output=tmp_path / "mine", **BASIC)
    assert "run" in str(caught.value.where)
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("text", ["x", "8-", "9-8", "8,8"])
def test_bad_frames_of_interest_name_their_option(
    tmp_path: Path, run: Run, text: str
) -> None:
    """The list is read as one of scenarios is, and the message speaks of frames."""
    paths = save_runs(tmp_path / "in", straight_runs(3))
    options = ["-o", tmp_path / "mine", "--radius", "0.1", "--frame-interval", "0.25"]
    done = run("adopt", *paths, *options, "--frames-of-interest", text)
    assert done.exit_code == 2
    assert "where: --frames-of-interest" in done.output
    assert "--scenarios" not in done.output


def test_a_file_describes_the_data_and_options_win(tmp_path: Path, run: Run) -> None:
    """Keys of `--describe` count where no option says otherwise; unknown keys and wrong
    types are refused.
    """
    paths = save_runs(tmp_path / "in", straight_runs(4))
    description = tmp_path / "data.yaml"
    options = [
        "-o",
        tmp_path / "mine",
        "--describe",
        description,
        "--free-surface",
        "--horizon",
        "3",
    ]
    words = ["adopt", *paths, *options]
    endless = f"0x{'f' * 5000}"  # an integer whose digits Python does not spell
    wrong = [
        "colour: red",
        "radius: far",
        "- radius",
        f"title: {endless}",
        f"horizon: {endless}",
    ]
    for line in (*wrong, f"density: [{endless}]", f"? {endless}\n: 1"):
        description.write_text(line)
        assert run(*words).exit_code == 2
    description.write_text("radios: 0.1")
    refused = run(*words).output
    assert "expected: a key of a description" in refused
    assert "radius" in refused
    assert not (tmp_path / "mine").exists()
    description.write_text(
        "radius: 0.1\nframe_interval: 0.25\nbounds: [[0, 1], [0.25, 1]]\nhorizon: 4\n"
        "frames_of_interest: [8]\nlicence: CC0-1.0\ndensity: 2\nspacing: "
        "0.05\nfull_box: true\n"
    )
    done = run(*words)
    assert done.exit_code == 0, done.output
    size, _, splits = locate(str(tmp_path / "mine"))
    assert size.task.radius == 0.1
    assert size.task.horizon == 3
    assert size.task.frames_of_interest == (8,)
    assert size.bounds == ((0.0, 1.0), (0.25, 1.0))
    assert size.value("density") == 2.0
    assert splits.split("mine").licence == "CC0-1.0"
    assert size.task.score_grid.placement == "nodes"


def test_more_mistakes_than_a_message_holds_are_counted(
    tmp_path: Path, run: Run
) -> None:
    paths = save_runs(tmp_path / "in", straight_runs(4))
    description = tmp_path / "data.yaml"
    lines = [f"colour_{number}: red" for number in range(13)]
    description.write_text("\n".join(lines))
    output = tmp_path / "mine"
    done = run(
        "adopt", *paths, "-o", output, "--describe", description, "--free-surface"
    )
    assert done.exit_code == 2
    assert "colour_9" in done.output
    assert "3 more" in done.output
    places = [line for line in done.output.splitlines() if "where: " in line]
    assert len(places) == 11
    assert not places[-1].rstrip().endswith("key")


def test_one_particle_is_counted_in_the_singular(tmp_path: Path, run: Run) -> None:
    paths = save_runs(tmp_path / "in", straight_runs(4, particles=1))
    description = tmp_path / "data.yaml"
    description.write_text("{radius: 0.1, spacing: 0.1, frame_interval: 0.25}\n")
    output = tmp_path / "mine"
    done = run(
        "adopt", *paths, "-o", output, "--describe", description, "--free-surface"
    )
    assert done.exit_code == 0, done.output
    assert " 1 particle\n" in done.output
    filled = run("template", "--split", output, "-o", tmp_path / "empty.nc")
    assert filled.exit_code == 0, filled.output
    assert " 1 particle, " in filled.output


def drifting_runs(count: int) -> list[NDArray[np.float32]]:
    """Return trajectories through a periodic box of side 1, wrapped into it."""
    rng = np.random.default_rng(7)
    start = rng.random((count, 1, 60, 2))
    time = np.arange(12)[None, :, None, None]
    position = start + np.array([0.02, 0.001]) * time
    return list(np.mod(position, 1.0).astype(np.float32))


def test_jumps_of_nearly_a_box_are_refused_unless_the_box_is_periodic(
    tmp_path: Path, run: Callable[..., Result]
) -> None:
    paths = save_runs(tmp_path / "in", drifting_runs(3))
    options = {"bounds": UNIT_SQUARE, **BASIC}
    with pytest.raises(DataError) as caught:
        adopt(paths, output=tmp_path / "walls", **options)
    assert caught.value.where is not None
    assert "along x" in caught.value.where

    own_split = adopt(paths, output=tmp_path / "mine", periodic=["x", "y"], **options)
    size = locate(str(own_split.folder)).size
    assert size.box.periodic == (True, True)
    velocity = stored(own_split, 0, "velocity") * size.frame_interval  # [length/frame]
    assert_allclose(velocity[..., 0], 0.02, atol=1e-6)
    manifest = read_manifest(tmp_path, "mine", "full", 1)
    assert manifest is not None
    assert manifest.statistics["velocity_mean"][0] == pytest.approx(0.02, rel=1e-4)

    result = run(
        "adopt",
        tmp_path / "in",
        "--output",
        tmp_path / "told",
        "--radius",
        "0.2",
        "--frame-interval",
        "0.1",
        "--bounds",
        "0,1,0,1",
        "--periodic",
        "x,y",
    )
    assert result.exit_code == 0, result.output
    assert locate(str(tmp_path / "told")).size.box == size.box


def test_the_scorer_refuses_a_changed_train(own: LocalSplit, tmp_path: Path) -> None:
    """Naive predictors look things up there: other values would be another skill."""
    folder = tmp_path / "copy" / own.folder.name
    shutil.copytree(own.folder, folder)
    target = tmp_path / "predictions.nc"
    lagbench.template(str(folder), output=target)
    path = next(folder.rglob("train/*.nc"))
    with h5py.File(path, "r+") as file:
        file["position"][1, 0, 0] += np.float32(1e-3)
    with pytest.raises(DataError) as caught:
        lagbench.score(target, root=folder.parent, output_dir=tmp_path, workers=1)
    assert str(path) in str(caught.value.where)


def test_a_periodic_split_is_scored_by_the_shortest_way(tmp_path: Path) -> None:
    """Straight flight across the boundary is what constant velocity predicts."""
    own_split = adopt(
        save_runs(tmp_path / "in", drifting_runs(3)),
        output=tmp_path / "mine",
        bounds=UNIT_SQUARE,
        periodic=["x", "y"],
        input_frames=3,
        **BASIC,
    )
    target = tmp_path / "predictions.nc"
    lagbench.template(str(own_split.folder), output=target)
    card = lagbench.score(target, root=tmp_path, output_dir=tmp_path, workers=1)
    straight = card.scores["constant-velocity"]["position_rmse"]
    assert np.max(straight.per_frame) < 1e-5
    at_rest = card.scores["persistence"]["position_rmse"].per_frame[0]  # [length]
    drift = 0.02 * np.arange(1, len(at_rest) + 1)
    assert_allclose(at_rest, drift / np.sqrt(2.0), rtol=0.01)


@pytest.mark.parametrize(
    ("axes", "ends"),
    [
        (["x"], 4),
        (["x", "z"], 6),
    ],
)
def test_the_fix_for_missing_bounds_shows_their_form(
    tmp_path: Path, axes: list[str], ends: int
) -> None:
    """The fix is an option that can be typed."""
    with pytest.raises(UsageError) as caught:
        adopted(tmp_path, straight_runs(3), periodic=axes, bounds=None)
    fix = str(caught.value.fix)
    example = re.search(r"--bounds (\S+)", fix)
    assert example is not None
    numbers = example[1].split(",")
    assert len(numbers) == ends
    assert caught.value.where == "--periodic"


def wrapped_run() -> NDArray[np.float32]:
    """Particles that leave a periodic square along x early, and along y late."""
    axis = (np.arange(8) + 0.5) / 8
    start = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    frames = np.arange(40)[:, None, None]
    path = start + 0.01 * frames * np.array([1.0, 0.0])
    path = path + 0.02 * np.maximum(frames - 30, 0) * np.array([0.0, 1.0])
    return (path % 1.0).astype(np.float32)


def test_one_error_names_all_axes_along_which_particles_jump(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """The fix names both axes, also where one is crossed frames later."""
    paths = save_runs(tmp_path / "in", [wrapped_run()] * 3)
    with pytest.raises(DataError) as caught:
        adopt_here(paths)
    fix = str(caught.value.fix)
    assert "--periodic x,y " in fix
    place = str(caught.value.where)
    assert "along x" in place
    assert "along y" in place
    own_split = adopt_here(paths, periodic=["x", "y"], bounds=UNIT_SQUARE)
    assert own_split.frames == 120


def test_the_bounds_of_the_message_hold_all_frames(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """Bounds that hold one frame would be refused by a later one."""
    runs = straight_runs(3)
    low = float(runs[0].min())
    high = float(runs[0].max())
    paths = save_runs(tmp_path / "in", runs)
    with pytest.raises(UsageError) as caught:
        adopt_here(paths, bounds=((0.0, 0.1), (0.0, 0.1)))
    expected = str(caught.value.expected)
    ends = [float(number) for number in re.findall(r"[\d.]+", expected)]
    assert min(ends) == pytest.approx(low, rel=1e-4)
    assert max(ends) == pytest.approx(high, rel=1e-4)


def test_bounds_of_a_periodic_axis_are_its_period(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """Positions beyond a period are wrapped: their extent is not what is needed."""
    runs = [run + np.array([3.0, 0.0], np.float32) for run in straight_runs(3)]
    paths = save_runs(tmp_path / "in", runs)
    with pytest.raises(UsageError) as caught:
        adopt_here(paths, periodic=["x"], bounds=((0.0, 1.0), (0.0, 0.1)))
    expected = str(caught.value.expected)
    assert expected.startswith("bounds that hold [0, 1] x ")
    high = [run + np.array([3.0, 5.0], np.float32) for run in straight_runs(3)]
    high_paths = save_runs(tmp_path / "high", high)
    with pytest.raises(DataError) as outside:
        adopt_here(high_paths, periodic=["x"], bounds=((0.0, 1.0), (0.0, 9.0)))
    assert str(outside.value.got).startswith("[0, 1] x [5")


def test_one_error_names_all_wrong_values_of_a_description(
    tmp_path: Path,
) -> None:
    paths = save_runs(tmp_path / "in", straight_runs(3))
    wrong = {"radius": -1.0, "input_frames": 1, "cells": 1, "periodic": ["x"]}
    with pytest.raises(UsageError) as caught:
        adopt(paths, output=tmp_path / "mine", frame_interval=0.0, **wrong)
    for option in (
        "--radius",
        "--frame-interval",
        "--input-frames",
        "--cells",
        "--periodic",
    ):
        assert option in str(caught.value)
    unknown: dict[str, Any] = {"radios": 0.1, "frame_interval": "soon"}
    with pytest.raises(UsageError) as caught:
        adopt(paths, output=tmp_path / "mine", **unknown)
    for key in ("radios", "frame_interval"):
        assert key in str(caught.value)


def test_a_periodic_axis_needs_a_name_and_bounds(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    paths = save_runs(tmp_path / "in", drifting_runs(3))
    for options in (
        {"periodic": ["x"]},
        {"periodic": ["q"], "bounds": UNIT_SQUARE},
    ):
        with pytest.raises(UsageError) as caught:
            adopt_here(paths, **options)
        assert caught.value.where == "--periodic"


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("radius", True, "a number"),
        ("frame_interval", False, "a number"),
        ("periodic", "x,y", "a list in brackets"),
        ("axes", 3, "a list in brackets"),
        ("title", "caf\udce9", "UTF-8"),
        ("licence", "\udcff", "UTF-8"),
    ],
)
def test_options_of_a_wrong_kind_are_refused(
    tmp_path: Path, option: str, value: object, expected: str
) -> None:
    """True is no number, a text no list, and a file in UTF-8 holds no other text."""
    save_runs(tmp_path / "in", straight_runs(3))
    options: dict[str, Any] = {**BASIC, option: value}
    with pytest.raises(UsageError) as caught:
        adopt(tmp_path / "in", output=tmp_path / "mine", **options)
    assert caught.value.where == option
    assert expected in str(caught.value.expected)


def save_periodic_runs(folder: Path, dimension: int) -> list[Path]:
    """Write four trajectories in the periodic unit box."""
    generator = np.random.default_rng(3)
    runs = []
    for _ in range(4):
        first = generator.uniform(0.2, 0.8, (60, dimension))
        velocity = generator.uniform(-0.01, 0.01, (60, dimension))
        steps = np.arange(12)[:, None, None]
        runs.append((first + steps * velocity).astype(np.float32))
    return save_runs(folder, runs)


@pytest.mark.parametrize("walls", ["unknown", "stated", "periodic"])
def test_a_score_grid_that_fills_the_memory_is_refused(
    tmp_path: Path, walls: str, adopt_here: Adopt
) -> None:
    """1000 cells across a cube are 8 GB for each quantity; across a square they fit."""
    for dimension in (3, 2):
        paths = save_periodic_runs(tmp_path / f"in{dimension}", dimension)
        options: dict[str, Any] = {"cells": 1000}
        if walls != "unknown":
            options["bounds"] = ((0.0, 1.0),) * dimension
        if walls == "periodic":
            options["periodic"] = ("x", "y", "z")[:dimension]
        if dimension == 2:
            assert locate(adopt_here(paths, **options).folder)
            continue
        with pytest.raises(UsageError) as caught:
            adopt_here(paths, **options)
        assert "--cells" in str(caught.value.where)
        assert not (tmp_path / "mine").exists()
        # the fix is a command that works
        proposal = re.search(r"--cells (\d+)", str(caught.value.fix))
        assert proposal is not None
        assert int(proposal[1]) >= 128


def test_a_long_period_makes_no_large_grid(tmp_path: Path, adopt_here: Adopt) -> None:
    """A period of 1e6 has 64e6 cells of 1/64, whether or not the cells are stated."""
    paths = save_periodic_runs(tmp_path / "in", 2)
    options: dict[str, Any] = {"bounds": ((0.0, 1e6), (0.0, 1.0)), "periodic": ("x",)}
    for changes in ({}, {"cells": 64}):
        with pytest.raises(UsageError) as caught:
            adopt_here(paths, **options, **changes)
        assert "--rescale" in str(caught.value.fix)
    assert not (tmp_path / "mine").exists()


def test_the_cells_of_a_tiny_drop_in_a_cube_are_few(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """The spacing would have 4,000 cells across: 64e9 nodes."""
    axis = 0.5 + 1e-4 * np.arange(6)
    first = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    run = first + 1e-5 * np.arange(12)[:, None, None]
    paths = save_runs(tmp_path / "in", [run.astype(np.float32)] * 4)
    box = ((0.0, 1.0),) * 3
    size = locate(adopt_here(paths, bounds=box, spacing=1e-4).folder).size
    assert math.prod(size.field_grid.shape) <= 20_000_000


@pytest.mark.parametrize("radius", [0.2, 0.21])
def test_the_radius_is_at_most_half_a_period(
    tmp_path: Path, radius: float, adopt_here: Adopt
) -> None:
    """Beyond it a particle would be a neighbour twice, which minimum images cannot be.

    Walls have no images, so the height of 1/4 of the box does not count.
    """
    paths = save_periodic_runs(tmp_path / "in", 2)
    runs = [np.load(path) * 0.25 + 0.3 for path in paths]
    paths = save_runs(tmp_path / "in", runs)
    options: dict[str, Any] = {
        "radius": radius,
        # the difference is below 0.4 by rounding
        "bounds": ((0.3, 0.7), (0.25, 0.65)),
        "cells": 20,
    }
    with_walls = adopt_here(paths, output=tmp_path / "walls", **options)
    assert locate(with_walls.folder).size.task.radius == radius
    if radius == 0.2:
        periodic = adopt_here(paths, periodic=("x",), **options)
        assert locate(periodic.folder).size.task.radius == radius
        return
    with pytest.raises(UsageError) as caught:
        adopt_here(paths, periodic=("x",), **options)
    assert "--radius" in str(caught.value.where)
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize(
    ("counts", "least"),
    [
        ({}, 3),
        ({"test": 5}, 7),
        ({"valid": 4}, 7),
        ({"test": 5, "valid": 4}, 10),
    ],
)
def test_the_least_number_of_trajectories_is_told(
    tmp_path: Path, counts: dict[str, int], least: int, adopt_here: Adopt
) -> None:
    """One less is refused, and the number of the message is enough."""
    runs = straight_runs(least)
    with pytest.raises(UsageError) as caught:
        adopt_here(save_runs(tmp_path / "few", runs[:-1]), **counts)
    assert f"at least {least} trajectories" in str(caught.value.expected)
    own_split = adopt_here(save_runs(tmp_path / "enough", runs), **counts)
    assert own_split.scenarios["train"] == 1


@pytest.mark.parametrize("count", [0, -1])
@pytest.mark.parametrize("option", ["valid", "test"])
def test_valid_and_test_have_a_trajectory(
    tmp_path: Path, option: str, count: int, adopt_here: Adopt
) -> None:
    """More files would not help, so the message names the option."""
    paths = save_runs(tmp_path / "in", straight_runs(4))
    with pytest.raises(UsageError) as caught:
        adopt_here(paths, **{option: count})
    assert caught.value.where == f"--{option}"


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e300])
@pytest.mark.parametrize("frame", [0, 3])
def test_the_error_has_the_position_of_the_file(
    tmp_path: Path, frame: int, value: float, adopt_here: Adopt
) -> None:
    """In periodic and in scaled boxes too."""
    paths = save_periodic_runs(tmp_path / "in", 2)
    run = np.load(paths[0]).astype(np.float64)
    run[frame, 5, 1] = value
    np.save(paths[0], run)
    with pytest.raises(DataError) as caught:
        adopt_here(
            paths,
            bounds=((-2.0, 2.0), (-2.0, 2.0)),
            periodic=("x", "y"),
            rescale=True,
        )
    assert "run0.npy" in str(caught.value.where)
    assert_array_equal(np.array(caught.value.got, np.float64), run[frame, 5])


def test_the_error_of_exchanged_bounds_names_the_axis(
    tmp_path: Path, adopt_here: Adopt
) -> None:
    """It has no brackets of Python, and the numbers as the user gave them."""
    paths = save_runs(tmp_path / "in", straight_runs(4))
    with pytest.raises(UsageError) as caught:
        adopt_here(paths, bounds=((0.0, 1.0), (0.75, 0.25)))
    got = str(caught.value.got)
    assert "y" in got
    assert "0.75" in got
    assert "(" not in got


def test_a_wrong_shape_is_named_before_trajectories_are_counted(
    tmp_path: Path,
) -> None:
    """A user would look for more files. Several in an .npz get a fix that works."""
    flat = tmp_path / "flat.npy"
    np.save(flat, np.zeros((25, 80), np.float32))
    with pytest.raises(UnreadableFileError) as caught:
        adopt(flat, output=tmp_path / "own", radius=0.1, frame_interval=0.1)
    assert "(25, 80)" in str(caught.value.got)

    several = np.stack([*straight_runs(6)])
    archive = tmp_path / "several.npz"
    np.savez(archive, position=several)
    archives = [archive, *save_runs(tmp_path, straight_runs(3))]
    with pytest.raises(UnreadableFileError, match=r"one \.npy") as caught:
        adopt(archives, output=tmp_path / "own", radius=0.1, frame_interval=0.1)
    array = tmp_path / "several.npy"
    np.save(array, several)
    own = adopt(array, output=tmp_path / "own", radius=0.1, frame_interval=0.1)
    assert sum(own.scenarios.values()) == 6
