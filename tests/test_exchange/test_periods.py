"""Periods that the user states, beside the period of the positions."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command_line import Result
from exchange_writers import SUBSETS, write_metadata
from numpy.typing import NDArray

import lagbench
from lagbench.data.local import locate
from lagbench.errors import UsageError
from lagbench.exchange import adopt, import_split
from lagbench.exchange.local_split import LocalSplit

Floats = NDArray[np.float64]
Bounds = tuple[tuple[float, float], ...]

FRAMES = 24
FRAME_INTERVAL = 0.05  # [s]
SIDES = (14, 16, 18, 20)  # particles along each axis, by trajectory
SPEED = 0.02  # greatest speed of the vortices [length/frame]


def flow(position: Floats, speed: float) -> Floats:
    """Return the velocity of vortices with period 1, without divergence [length/frame].

    Args:
        position: points [length], shape [particle, axis].
        speed: greatest speed [length/frame].
    """
    angle = 2.0 * np.pi * position
    velocity = np.zeros_like(position)
    velocity[:, 0] = np.sin(angle[:, 0]) * np.cos(angle[:, 1])
    velocity[:, 1] = -np.cos(angle[:, 0]) * np.sin(angle[:, 1])
    return speed * velocity


def carried(
    side: int,
    *,
    dimension: int = 2,
    drift: float = 0.011,
    speed: float = SPEED,
    skipped: int = 0,
) -> Floats:
    """Return particles in a flow of period 1, not wrapped: [frame, particle, axis].

    Args:
        side: particles along each axis.
        dimension: 2 or 3.
        drift: mean velocity along each axis [length/frame].
        speed: greatest speed of the vortices [length/frame].
        skipped: frames before the recording begins.
    """
    generator = np.random.default_rng(side)
    axis = (np.arange(side) + 0.5) / side
    grid = np.meshgrid(*[axis] * dimension, indexing="ij")
    x = np.stack(grid, axis=-1).reshape(-1, dimension)
    x = x + generator.uniform(-0.1, 0.1, x.shape) / side
    frames = []
    for frame in range(skipped + FRAMES):
        if frame >= skipped:
            frames.append(x + frame * drift)
        # second order in time, in the frame that drifts
        half = x + 0.5 * flow(x, speed)
        x = x + flow(half, speed)
    return np.stack(frames)


def wrapped(position: Floats) -> Floats:
    """Return positions in the period from 0 to 1."""
    return position % 1.0


def write_runs(
    folder: Path, runs: list[Floats], *, ending: str = "npy", scale: float = 1.0
) -> Path:
    """Write trajectories as files for ``adopt``."""
    folder.mkdir()
    for number, run in enumerate(runs):
        position = (scale * run).astype(np.float32)
        if ending == "npy":
            np.save(folder / f"{number}.npy", position)
        elif ending == "npz":
            np.savez(folder / f"{number}.npz", position=position)
        else:
            with h5py.File(folder / f"{number}.nc", "w") as file:
                file["position"] = position
    return folder


def write_set(folder: Path, runs: list[Floats], bounds: Bounds, form: str) -> Path:
    """Write a set in the format of another code base."""
    folder.mkdir()
    runs_of = {"train": runs[:-2], "valid": runs[-2:-1], "test": runs[-1:]}
    for subset in SUBSETS:
        kinds = {"gns-npz": 5, "lagrangebench-h5": 0}
        arrays = {}
        for number, run in enumerate(runs_of[subset]):
            kind = np.full(run.shape[1], kinds[form], np.int64)
            arrays[f"{number:05d}"] = (run.astype(np.float32), kind)
        if form == "lagrangebench-h5":
            with h5py.File(folder / f"{subset}.h5", "w") as file:
                for name, (position, kind) in arrays.items():
                    group = file.create_group(name)
                    group["position"] = position
                    group["particle_type"] = kind
        else:
            objects: dict[str, Any] = {}
            for name, pair in arrays.items():
                item = np.empty(2, dtype=object)
                item[:] = pair
                objects[name] = item
            np.savez(folder / f"{subset}.npz", **objects)
    changes = {
        "bounds": [list(side) for side in bounds],
        "dim": len(bounds),
        "sequence_length": FRAMES,
        "default_connectivity_radius": 0.1,
        "periodic_boundary_conditions": [True] * len(bounds),
    }
    write_metadata(folder, changes)
    return folder


Make = Callable[..., LocalSplit]


@pytest.fixture
def adopt_runs(tmp_path: Path) -> Make:
    """Adopt trajectories, with the stated ends of the box."""

    def make(
        runs: list[Floats],
        bounds: Bounds,
        *,
        periodic: tuple[str, ...] | None = None,
        ending: str = "npy",
        scale: float = 1.0,
        rescale: bool = False,
        input_frames: int = 6,
    ) -> LocalSplit:
        folder = write_runs(tmp_path / "runs", runs, ending=ending, scale=scale)
        axes = ("x", "y", "z")[: len(bounds)]
        return adopt(
            folder,
            output=tmp_path / "own",
            radius=0.1 * scale,
            frame_interval=FRAME_INTERVAL,
            bounds=bounds,
            periodic=periodic or axes,
            rescale=rescale,
            input_frames=input_frames,
        )

    return make


def greatest_speed(local_split: LocalSplit) -> float:
    """Return the greatest component of a velocity in train [length/s]."""
    with lagbench.open_split(local_split.folder, subset="train") as data:
        return float(np.nanmax(np.abs(data["velocity"])))


WRONG_BOUNDS: dict[str, Bounds] = {
    "short": ((0.0, 0.75), (0.0, 1.0)),
    "half": ((0.0, 0.5), (0.0, 1.0)),
    "short by a spacing": ((0.0, 0.95), (0.0, 1.0)),
    "short in y": ((0.0, 1.0), (0.0, 0.75)),
    "long": ((0.0, 1.0), (-0.25, 1.25)),
    "three times as long": ((0.0, 1.0), (0.0, 3.0)),
}


@pytest.mark.parametrize("bounds", WRONG_BOUNDS.values(), ids=WRONG_BOUNDS)
def test_a_period_that_particles_contradict_is_refused(
    adopt_runs: Make, tmp_path: Path, bounds: Bounds
) -> None:
    """Particles that cross the boundary jump by 1, whatever the user states."""
    runs = [wrapped(carried(side)) for side in SIDES]
    with pytest.raises(UsageError) as caught:
        adopt_runs(runs, bounds, rescale=True)
    assert "--bounds" in str(caught.value.where)
    assert caught.value.exit_code == 2
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize("ending", ["npy", "npz", "nc"])
def test_every_file_format_is_looked_at(adopt_runs: Make, ending: str) -> None:
    runs = [wrapped(carried(side)) for side in SIDES]
    with pytest.raises(UsageError):
        adopt_runs(runs, ((0.0, 0.75), (0.0, 1.0)), ending=ending)


@pytest.mark.parametrize("form", ["gns-npz", "lagrangebench-h5"])
def test_the_metadata_of_a_set_may_state_a_wrong_period(
    tmp_path: Path, form: str
) -> None:
    runs = [wrapped(carried(side)) for side in SIDES]
    wrong = write_set(tmp_path / "wrong", runs, ((0.0, 0.75), (0.0, 1.0)), form)
    right = write_set(tmp_path / "right", runs, ((0.0, 1.0), (0.0, 1.0)), form)
    with pytest.raises(UsageError):
        import_split(wrong, format=form, output=tmp_path / "own", full_box=True)
    own = import_split(right, format=form, output=tmp_path / "own", full_box=True)
    interval = locate(own.folder).size.frame_interval
    assert greatest_speed(own) * interval < 0.05


HONEST_RUNS: dict[str, Callable[[int], Floats]] = {
    "wrapped": lambda side: wrapped(carried(side)),
    "wrapped, around 0": lambda side: wrapped(carried(side) + 0.5) - 0.5,
    "wrapped, in strong vortices": lambda side: wrapped(carried(side, speed=0.1)),
    "not wrapped": carried,
    "not wrapped, far": lambda side: carried(side, drift=0.07),
    "not wrapped, begins late": lambda side: carried(side, drift=0.03, skipped=200),
    "at rest": lambda side: carried(side, drift=0.0, speed=0.0),
}


@pytest.mark.parametrize("honest", HONEST_RUNS.values(), ids=HONEST_RUNS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_true_period_is_accepted(
    adopt_runs: Make, honest: Callable[..., Floats], dimension: int
) -> None:
    """Wrapped or not; the velocities are those of the flow."""
    runs = []
    for side in SIDES:
        run = honest(side)
        if dimension == 3:
            # some layers above one another, which leave the box along z too
            height = np.linspace(0.0, 0.75, 4)
            rise = 0.02 * np.arange(FRAMES)
            layers = []
            for z in height:
                column = np.broadcast_to((z + rise)[:, None, None], (*run.shape[:2], 1))
                layers.append(np.concatenate([run, column % 1.0], axis=2))
            run = np.concatenate(layers, axis=1)
        runs.append(run)
    own = adopt_runs(runs, ((0.0, 1.0),) * dimension)
    assert greatest_speed(own) < 0.25 / FRAME_INTERVAL


def test_random_places_that_begin_late_are_accepted(adopt_runs: Make) -> None:
    """Tracers have no spacing, and diffuse over several periods."""
    generator = np.random.default_rng(0)
    runs = []
    for side in SIDES:
        start = generator.normal(scale=0.8, size=(side**2, 2))
        steps = generator.normal(scale=0.01, size=(FRAMES, side**2, 2))
        runs.append(start + np.cumsum(steps, axis=0))
    adopt_runs(runs, ((0.0, 1.0), (0.0, 1.0)))


def test_a_first_frame_longer_than_the_period_has_a_note(
    adopt_runs: Make, tmp_path: Path
) -> None:
    """Random places at rest do not tell whether the stated period is too short."""
    generator = np.random.default_rng(0)
    runs = []
    for side in SIDES:
        start = generator.uniform(size=(side**2, 2))
        run = start + 1e-4 * generator.normal(size=(FRAMES, *start.shape))
        runs.append(run)
    own = adopt_runs(runs, ((0.0, 0.75), (0.0, 1.0)))
    assert sum("0.75" in note for note in own.notes) == 1


def test_few_frames_of_a_fast_flow_are_accepted(adopt_runs: Make) -> None:
    """Of every fourth frame, in which particles turn between long steps."""
    runs = []
    for side in (40, 41, 42, 43):
        run = carried(side, drift=0.0, speed=0.06, skipped=30)
        runs.append(run[::4])
    own = adopt_runs(runs, ((0.0, 1.0), (0.0, 1.0)), input_frames=2)
    assert locate(own.folder).size.box.periodic == (True, True)


def test_random_steps_are_accepted(adopt_runs: Make) -> None:
    """Particles that go to and fro through the boundary."""
    generator = np.random.default_rng(0)
    runs = []
    for side in SIDES:
        start = generator.uniform(size=(side**2, 2))
        steps = generator.normal(scale=0.03, size=(FRAMES, side**2, 2))
        runs.append(wrapped(start + np.cumsum(steps, axis=0)))
    adopt_runs(runs, ((0.0, 1.0), (0.0, 1.0)))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("period", [0.5, 0.7, 0.83])
def test_a_period_that_puts_particles_on_others_is_refused(
    adopt_runs: Make, dimension: int, period: float
) -> None:
    """No particle crosses the boundary, but the box is longer than the period."""
    runs = []
    for side in (10, 11, 12, 13):
        runs.append(carried(side, dimension=dimension, drift=0.0, speed=0.01))
    bounds = ((0.0, period), *[(0.0, 1.0)] * (dimension - 1))
    with pytest.raises(UsageError) as caught:
        adopt_runs(runs, bounds)
    assert "--bounds" in str(caught.value.where)


def test_a_liquid_that_flows_out_of_the_stated_period_is_refused(
    adopt_runs: Make,
) -> None:
    """At first it lies within one period; later it would flow through itself."""
    runs = []
    for side in (14, 15, 16, 17):
        position = carried(side, drift=0.0, speed=0.0)
        position[..., 1] *= 0.5
        stretch = 0.6 + 0.4 * np.arange(FRAMES) / (FRAMES - 1.0)
        position[..., 0] *= stretch[:, None]
        position[..., 1] /= stretch[:, None]
        runs.append(position)
    with pytest.raises(UsageError):
        adopt_runs(runs, ((0.0, 0.75), (0.0, 1.0)), periodic=("x",))


def test_the_error_states_the_period_in_the_length_of_the_data(
    adopt_runs: Make,
) -> None:
    """By a jump of 20, for half of the particles, which leave the box one by one."""
    runs = [wrapped(carried(side))[:, ::2] for side in SIDES]
    with pytest.raises(UsageError) as caught:
        adopt_runs(runs, ((0.0, 25.0), (0.0, 20.0)), scale=20.0, rescale=True)
    assert "20 along x" in str(caught.value.expected)
    assert "25 along x" in str(caught.value.got)
    assert "along y" not in str(caught.value.got)


def test_few_crossings_of_several_trajectories_count_together(
    adopt_runs: Make,
) -> None:
    """One particle in each trajectory, which crosses a few times."""
    runs = []
    for number in range(12):
        place = 0.1 * number + 0.05 * np.arange(FRAMES)
        path = np.stack([place, np.full(FRAMES, 0.5)], axis=1)
        runs.append(wrapped(path[:, None]))
    with pytest.raises(UsageError) as caught:
        adopt_runs(runs, ((0.0, 0.75), (0.0, 1.0)))
    assert "1 along x" in str(caught.value.expected)


Run = Callable[..., Result]


def test_the_periodic_axes_are_printed(tmp_path: Path, run: Run) -> None:
    """By the commands that make a split and the command that shows it."""
    runs = [wrapped(carried(side)) for side in SIDES]
    folder = write_runs(tmp_path / "runs", runs)
    source = write_set(
        tmp_path / "theirs", runs, ((0.0, 1.0), (0.0, 1.0)), "lagrangebench-h5"
    )
    own = tmp_path / "own"
    options = ["--radius", "0.1", "--frame-interval", "0.05", "--full-box"]
    words = ("adopt", folder, "-o", own, "--periodic", "x,y", *options)
    words += ("--bounds", "0,1,0,1")
    assert "periodic x, y" in run(*words).stdout
    words = ("import", source, "--format", "lagrangebench-h5", "-o", tmp_path / "two")
    printed = json.loads(run(*words, "--json").stdout)
    assert printed["periodic"] == ["x", "y"]
    assert "periodic x, y" in run("info", f"{own}/").stdout
    printed = json.loads(run("info", f"{own}/", "--json").stdout)
    assert printed["sizes"]["full"]["periodic"] == ["x", "y"]


def test_walls_are_not_printed_as_periodic(run: Run) -> None:
    assert "periodic" not in box_line(run("info", "fluid", "--size", "mini").stdout)
    line = box_line(run("info", "decaying-vortices", "--size", "mini").stdout)
    assert "periodic x, y" in line


def box_line(text: str) -> str:
    """Return the line of the box."""
    for line in text.splitlines():
        if line.startswith("  box "):
            return line
    raise AssertionError(text)


def test_imported_and_adopted_data_have_the_same_notes_of_few_test_trajectories(
    adopt_runs: Make, tmp_path: Path
) -> None:
    runs = [wrapped(carried(side)) for side in SIDES]
    bounds = ((0.0, 1.0), (0.0, 1.0))
    source = write_set(tmp_path / "theirs", runs, bounds, "lagrangebench-h5")
    adopted = adopt_runs(runs, bounds)
    imported = import_split(
        source, format="lagrangebench-h5", output=tmp_path / "imported"
    )
    assert len(adopted.notes) == 1
    assert imported.notes == adopted.notes
