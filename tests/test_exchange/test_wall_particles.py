"""Particles of a fixed wall: models see them at their places, scores leave them out."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from trajectories import vortex

import lagbench
from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.errors import DataError, UsageError
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.scoring.compare import compare
from lagbench.scoring.score import score

SEEDS = {"train": 0, "valid": 1, "test": 2}
LINE = np.linspace(0.1, 0.9, 17)
FLOOR = np.concatenate([np.stack([LINE, 0 * LINE + y], -1) for y in (0.05, 0.1)])
RECIPE = """format: 1
recipes: {own/full: {training: {steps: 4, batch: 1, learning_rate: 1.0e-3}}}
"""


def save_lagrangebench(folder: Path, *, wall_kind: int = 1, moves: float = 0.0) -> None:
    """Write runs over a floor of two layers, as LagrangeBench has them."""
    for name, seed in SEEDS.items():
        floor = np.tile(FLOOR, (16, 1, 1))
        floor[8:] += moves
        with h5py.File(folder / f"{name}.h5", "w") as file:
            position = np.concatenate([floor, vortex(seed)], axis=1)
            file["00000/position"] = position.astype("f4")
            kinds = np.repeat([wall_kind, 0], [len(FLOOR), 144])
            file["00000/particle_type"] = kinds
    metadata = {
        "bounds": [[0, 1], [0, 1]],
        "default_connectivity_radius": 0.12,
        "dt": 0.1,
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    folder = tmp_path_factory.mktemp("walls")
    save_lagrangebench(folder)
    (folder / "recipe.yaml").write_text(RECIPE)
    return adopt(folder, output=folder / "own")


def test_walls_of_lagrangebench_are_read(own: LocalSplit) -> None:
    """The spacing, statistics of train and mass are those without walls."""
    assert own.materials == (0, 4)
    assert own.particles == (178, 178)
    assert own.spacing == pytest.approx(0.05, rel=0.02)
    with xr.open_dataset(own.folder / "full/v1/test/0002.nc") as file:
        np.testing.assert_array_equal(
            file.position[:, :34], np.tile(FLOOR, (16, 1, 1)).astype("f4")
        )
        assert file.material.attrs["flag_meanings"].split()[4] == "wall"
    manifest = json.loads((own.folder / "full/v1/manifest.json").read_text())
    velocity = np.diff(vortex(0).astype(float), axis=0).reshape(-1, 2)
    np.testing.assert_allclose(
        manifest["statistics"]["velocity_std"], velocity.std(axis=0), rtol=1e-6
    )


def test_moving_walls_are_refused(tmp_path: Path) -> None:
    """A kind that may move needs to be named first."""
    save_lagrangebench(tmp_path, wall_kind=2, moves=0.001)
    with pytest.raises(UsageError, match="2=wall for a fixed wall"):
        adopt(tmp_path, output=tmp_path / "own")
    with pytest.raises(DataError, match="frame 8: particle 0 moves, as 34 of 34"):
        adopt(tmp_path, output=tmp_path / "own", kinds="2=wall")


def test_scores_leave_walls_out(own: LocalSplit, tmp_path: Path) -> None:
    """Whatever is predicted of them; references have no walls either."""
    with xr.open_dataset(own.folder / "full/v1/test/0002.nc") as file:
        truth = file.position.values[6:]
    results = []
    for shift in (0.0, 0.01):
        rollout = truth.copy()
        rollout[:, :34] += shift
        rollout[:, 34:] += np.float32(0.001)
        path = tmp_path / f"{shift}.nc"
        lagbench.submission.write(
            path,
            {2: rollout},
            method="moved",
            split="own",
            size="full",
            root=own.folder.parent,
        )
        card = score(path, root=own.folder.parent, write=False)
        results.append(card.scores["submission"]["position_rmse"].values)
        assert "persistence" in card.scores
        for reference in card.scores.keys() - {"submission"}:
            result = compare(path, reference, split=own.folder)
            assert result.second == reference
    np.testing.assert_array_equal(results[0], results[1])
    assert results[0] == pytest.approx(0.001, rel=1e-3)


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("gns", ("model.latent=8", "model.layers=1", "model.noise_std=1.0e-3")),
        ("neuralmpm", ("model.materials=[0,4]", "model.cells=16", "model.width=4")),
    ],
)
def test_models_hold_walls(
    own: LocalSplit, tmp_path: Path, method: str, settings: tuple[str, ...]
) -> None:
    root = own.folder.parent
    train(
        method,
        str(own.folder),
        output=tmp_path / "run",
        recipe=str(root / "recipe.yaml"),
        settings=settings,
        device="cpu",
    )
    predict(
        tmp_path / "run/weights.safetensors",
        tmp_path / "predictions.nc",
        root=root,
        device="cpu",
    )
    with xr.open_dataset(tmp_path / "predictions.nc") as file:
        walls = file.position.values[0, :, :34]
    np.testing.assert_array_equal(
        walls, np.broadcast_to(FLOOR.astype("f4"), walls.shape)
    )


def test_other_models_refuse_walls(own: LocalSplit, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="knows no particles of walls"):
        train(
            "mlp",
            str(own.folder),
            output=tmp_path / "run",
            recipe=str(own.folder.parent / "recipe.yaml"),
            device="cpu",
        )
