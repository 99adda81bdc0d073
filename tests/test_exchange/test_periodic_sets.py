"""A set of another code base, in a periodic square and with scenarios of different
particle numbers: import, train, predict, score.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import h5py
import numpy as np
import pytest
from exchange_writers import SUBSETS, write_metadata
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

import lagbench
from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.data.local import locate
from lagbench.data.scenario import read_scenario
from lagbench.errors import UsageError
from lagbench.exchange import adopt, export, import_split
from lagbench.exchange.local_split import LocalSplit
from lagbench.scoring.card import ScoreCard

Floats = NDArray[np.float64]

SIDES = {"train": (18, 22), "valid": (20,), "test": (26, 18)}
"""Particles along each axis, by subset: 324 to 676 in a scenario."""
FRAMES = 16
GIVEN = 4
DRIFT = np.array([0.037, -0.021])  # of the whole fluid [length/frame]
VORTEX = 0.006  # greatest speed of the vortices [length/frame]
SHIFT = np.array([0.03, 0.0])  # of a prediction [length]

RECIPE = """
format: 1
recipes:
  '*/full': {training: {steps: 3, batch: 1, learning_rate: 1.0e-4}}
"""


def vortices(position: Floats) -> Floats:
    """Return the velocity of Taylor-Green vortices at rest [length/frame]."""
    x, y = 2.0 * math.pi * position.T
    u = np.sin(x) * np.cos(y)
    v = -np.cos(x) * np.sin(y)
    return VORTEX * np.stack([u, v], axis=1)


def carried(side: int) -> NDArray[np.float32]:
    """Return particles in vortices that drift through the ends of the square."""
    axis = (np.arange(side) + 0.5) / side
    grid = np.meshgrid(axis, axis, indexing="ij")
    x = np.stack(grid, axis=-1).reshape(-1, 2)
    frames = []
    for frame in range(FRAMES):
        frames.append((x + frame * DRIFT) % 1.0)
        half = x + vortices(x) / 2.0
        x = x + vortices(half)
    wrapped = np.asarray(np.stack(frames), np.float32)
    # A coordinate may round up to the end of the period, which is its start.
    zero = np.float32(0.0)
    return np.where(wrapped >= 1.0, zero, wrapped)


def write_set(folder: Path, length: float = 1.0) -> Path:
    """Write train.h5, valid.h5, test.h5 and metadata.json as LagrangeBench does.

    Args:
        folder: folder to make.
        length: side of the periodic square.
    """
    folder.mkdir()
    for subset in SUBSETS:
        with h5py.File(folder / f"{subset}.h5", "w") as file:
            for number, side in enumerate(SIDES[subset]):
                position = (length * carried(side)).astype(np.float32)
                particle_count = position.shape[1]
                group = file.create_group(f"{number:05d}")
                group["position"] = position
                group["particle_type"] = np.zeros(particle_count, np.int64)
    changes = {
        "bounds": [[0.0, length], [0.0, length]],
        "sequence_length": FRAMES,
        "default_connectivity_radius": 0.08 * length,
        "periodic_boundary_conditions": [True, True],
    }
    write_metadata(folder, changes)
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """The set as it is imported; the metadata say that it is periodic."""
    folder = tmp_path_factory.mktemp("periodic")
    return import_split(
        write_set(folder / "theirs"),
        format="lagrangebench-h5",
        output=folder / "drift",
        input_frames=GIVEN,
        full_box=True,
        cells=8,
    )


def ids_of_test(made: LocalSplit) -> dict[int, int]:
    """Return the particles along each axis of each test scenario."""
    ids = locate(made.folder).size.subsets["test"]
    return dict(zip(ids, SIDES["test"], strict=True))


def score_predictions(made: LocalSplit, path: Path) -> ScoreCard:
    """Return the scores of valid predictions."""
    root = made.folder.parent
    validated = lagbench.validate(path, root=root, isolated=False)
    assert validated.valid
    return lagbench.score(
        path,
        root=root,
        write=False,
        workers=1,
        validated=validated,
    )


def score_of(
    made: LocalSplit,
    positions: dict[int, NDArray[np.float32]],
    folder: Path,
) -> ScoreCard:
    """Return the scores of predictions."""
    path = folder / "predictions.nc"
    lagbench.submission.write(path, positions, split=made.folder, method="trivial")
    return score_predictions(made, path)


def position_errors(card: ScoreCard) -> dict[str, float]:
    """Return the mean error of positions of the submission and of references."""
    errors = {}
    for name, scores in card.scores.items():
        errors[name] = scores["position_rmse"].mean
    return errors


def test_the_box_and_the_numbers_of_particles_are_theirs(made: LocalSplit) -> None:
    size = locate(made.folder).size
    assert size.box.periodic == (True, True)
    counts = {size.particle_count(number) for number in size.scenarios}
    assert counts == {324, 400, 484, 676}


def test_a_square_of_side_2_pi_is_rescaled(tmp_path: Path) -> None:
    """LagrangeBench's Taylor-Green cube has this side. No power of two makes it whole
    cells; divided by the period the positions are those of the unit square.
    """
    source = write_set(tmp_path / "theirs", 2.0 * math.pi)
    own_split = import_split(
        source,
        format="lagrangebench-h5",
        output=tmp_path / "round",
        input_frames=GIVEN,
        full_box=True,
        rescale=True,
    )
    size = locate(own_split.folder).size
    assert size.box.bounds == ((0.0, 1.0), (0.0, 1.0))
    assert size.task.radius == pytest.approx(0.08)
    first = size.subsets["valid"][0]
    with read_scenario(size.path(tmp_path, first)) as file:
        position = file.read("position", slice(0, FRAMES))
    way = size.box.displacement(carried(20), position.astype(np.float64))
    assert np.abs(way).max() < 1e-6
    lagbench.submission.template(own_split.folder, output=tmp_path / "kept.nc")
    card = score_predictions(own_split, tmp_path / "kept.nc")
    assert card.scores


def test_cells_that_no_period_fits_are_refused(tmp_path: Path) -> None:
    """Before anything is written; nor are there periods without bounds."""
    source = write_set(tmp_path / "theirs", 0.7853981633974483)
    steps: list[object] = []
    with pytest.raises(UsageError) as caught:
        import_split(
            source,
            format="lagrangebench-h5",
            output=tmp_path / "seven",
            input_frames=GIVEN,
            full_box=True,
            cells=7,
            progress=steps.append,
        )
    assert caught.value.where == "--cells"
    assert not steps
    assert not (tmp_path / "seven").exists()

    runs = tmp_path / "runs"
    runs.mkdir()
    for number in range(4):
        np.save(runs / f"{number}.npy", carried(18))
    for rescale in (False, True):
        with pytest.raises(UsageError) as caught:
            adopt(
                runs,
                output=tmp_path / "own",
                radius=0.08,
                frame_interval=0.1,
                periodic=("x", "y"),
                rescale=rescale,
            )
        assert caught.value.where == "--periodic"


def test_a_periodic_export_begins_at_the_origin(tmp_path: Path) -> None:
    """LagrangeBench looks for neighbours from 0 to a period, whatever fills the box."""
    runs = tmp_path / "runs"
    runs.mkdir()
    for number in range(4):
        np.save(runs / f"{number}.npy", (0.25 + 0.5 * carried(18)).astype(np.float32))
    for full_box in (False, True):
        own_split = adopt(
            runs,
            output=tmp_path / f"shifted-{int(full_box)}",
            radius=0.05,
            frame_interval=0.1,
            bounds=((0.25, 0.75), (0.25, 0.75)),
            periodic=("x", "y"),
            full_box=full_box,
        )
        folder = tmp_path / f"out-{full_box}"
        export(own_split.folder, format="lagrangebench-h5", output=folder)
        with h5py.File(folder / "train.h5") as file:
            position = file["00000/position"][()]
        assert 0.0 <= position.min() <= position.max() < 0.5


def test_a_force_beside_the_data_is_not_read(tmp_path: Path) -> None:
    """It is a program; a note says that the split lacks its force."""
    source = write_set(tmp_path / "theirs")
    force = source / "force.py"
    force.write_text(f"open({str(tmp_path / 'run')!r}, 'w')")
    own_split = import_split(
        source, format="lagrangebench-h5", output=tmp_path / "own", input_frames=GIVEN
    )
    assert any("force.py" in note for note in own_split.notes)
    assert not (tmp_path / "run").exists()


def test_positions_adopted_with_the_same_axes_are_the_same(
    made: LocalSplit, tmp_path: Path
) -> None:
    """Arrays with --periodic make the scenarios that the format makes."""
    paths: list[Path] = []
    for subset in SUBSETS:
        for side in SIDES[subset]:
            path = tmp_path / f"run{len(paths)}.npy"
            np.save(path, carried(side))
            paths.append(path)
    own = adopt(
        paths,
        output=tmp_path / "own",
        valid=1,
        test=2,
        radius=0.08,
        frame_interval=0.05,
        bounds=((0.0, 1.0), (0.0, 1.0)),
        periodic=("x", "y"),
        input_frames=GIVEN,
        full_box=True,
    )
    for subset in SUBSETS:
        with (
            lagbench.open_split(made.folder, subset=subset) as theirs,
            lagbench.open_split(own.folder, subset=subset) as ours,
        ):
            assert_array_equal(ours["position"], theirs["position"])


def test_a_particle_that_crosses_the_boundary_costs_no_error(
    made: LocalSplit, tmp_path: Path
) -> None:
    """The truth has no error, and a fluid moved by a little has that error alone, with
    the particles that the move brings to the other end.
    """
    truth = {}
    moved = {}
    crossing_count = 0
    for number, side in ids_of_test(made).items():
        run = carried(side)
        truth[number] = run[GIVEN:]
        shifted = truth[number].astype(np.float64) + SHIFT
        crossing_count += int((shifted >= 1.0).sum())
        wrapped = shifted % 1.0
        moved[number] = wrapped.astype(np.float32)
    assert crossing_count > 100

    perfect = score_of(made, truth, tmp_path)
    for name in ("position_rmse", "velocity_rmse", "mse_avg_10", "vorticity_nrmse"):
        assert perfect.submission[name].mean == 0.0
    near = score_of(made, moved, tmp_path)
    # mean squares over axes: one of two is moved
    square = float(SHIFT @ SHIFT) / 2.0
    mse = near.submission["position_mse"].mean
    assert mse == pytest.approx(square, rel=1e-4)
    rmse = near.submission["position_rmse"].mean
    assert rmse == pytest.approx(math.sqrt(square), rel=1e-4)
    # The references reach across the ends too: a drift is what a velocity predicts.
    errors = position_errors(near)
    assert errors["constant-velocity"] < 0.3 * errors["persistence"]
    assert near.skill is not None


@pytest.mark.slow
@pytest.mark.parametrize("baseline", ["gns", "neuralmpm"])
def test_a_few_steps_of_training_are_scored(
    made: LocalSplit, tmp_path: Path, baseline: str
) -> None:
    """Models learn from, and predict, any number of particles in a periodic box."""
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    settings = {
        "gns": ("model.latent=16", "model.layers=2"),
        "neuralmpm": ("model.cells=12", "model.width=8", "model.velocities=2"),
    }
    trained = train(
        baseline,
        str(made.folder),
        recipe=str(recipe),
        settings=settings[baseline],
        output=tmp_path / "model",
    )
    root = made.folder.parent
    path = tmp_path / "predictions.nc"
    predict(trained.weights, path, root=root)
    errors = position_errors(score_predictions(made, path))
    # An untrained model keeps velocities; it loses no particle at the ends.
    assert errors["submission"] < errors["persistence"]


def test_metadata_without_the_axes_are_refused(tmp_path: Path) -> None:
    """Particles that jump through the box are no data between walls."""
    folder = write_set(tmp_path / "theirs")
    path = folder / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["periodic_boundary_conditions"] = [False, False]
    path.write_text(json.dumps(metadata))
    with pytest.raises(lagbench.errors.DataError) as caught:
        import_split(folder, format="lagrangebench-h5", output=tmp_path / "walls")
    assert "--periodic" in str(caught.value.fix)
