"""Scoring in three dimensions with periodic axes: flows whose scores are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import lagbench
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit

SIDE = 8
FRAMES = 10
GIVEN = 4
AMPLITUDES = (
    (0.02, 0.03, 0.01),
    (0.01, 0.02, 0.03),
    (0.03, 0.01, 0.02),
)
"""Of the flows of Arnold, Beltrami and Childress [length/frame]."""


Floats = NDArray[np.float64]


def beltrami(position: Floats, amplitudes: tuple[float, float, float]) -> Floats:
    """Return the ABC flow of period 1, whose curl is 2 pi times itself."""
    a, b, c = amplitudes
    x, y, z = 2.0 * math.pi * position.T
    u = a * np.sin(z) + c * np.cos(y)
    v = b * np.sin(x) + a * np.cos(z)
    w = c * np.sin(y) + b * np.cos(x)
    return np.stack([u, v, w], axis=1)


def carried(amplitudes: tuple[float, float, float]) -> NDArray[np.float32]:
    """Return particles of a lattice that the flow carries, by the classical Runge-Kutta
    method.
    """
    axis = (np.arange(SIDE) + 0.5) / SIDE
    grid = np.meshgrid(axis, axis, axis, indexing="ij")
    x = np.stack(grid, axis=-1).reshape(-1, 3)
    frames = []
    for _ in range(FRAMES):
        frames.append(x % 1.0)
        k1 = beltrami(x, amplitudes)
        k2 = beltrami(x + k1 / 2, amplitudes)
        k3 = beltrami(x + k2 / 2, amplitudes)
        k4 = beltrami(x + k3, amplitudes)
        x = x + (k1 + 2 * k2 + 2 * k3 + k4) / 6
    return np.asarray(np.stack(frames), np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    folder = tmp_path_factory.mktemp("abc")
    paths = []
    for number, amplitudes in enumerate(AMPLITUDES):
        path = folder / f"run{number}.npy"
        np.save(path, carried(amplitudes))
        paths.append(path)
    return adopt(
        paths,
        output=folder / "abc",
        valid=1,
        test=1,
        radius=0.2,
        frame_interval=0.1,
        bounds=((0.0, 1.0),) * 3,
        periodic=("x", "y", "z"),
        input_frames=GIVEN,
        frames_of_interest=(6,),
        cells=4,
        full_box=True,
    )


@pytest.mark.slow
def test_truth_is_perfect_and_references_are_measured(
    made: LocalSplit, tmp_path: Path
) -> None:
    """A steady flow is what the frozen field predicts best, far better than rest."""
    path = tmp_path / "predictions.nc"
    truth = carried(AMPLITUDES[2])[GIVEN:]
    root = made.folder.parent
    lagbench.submission.write(path, {2: truth}, split=made.folder, method="truth")
    validated = lagbench.validate(path, root=root)
    card = lagbench.score(
        path,
        root=root,
        output_dir=tmp_path,
        workers=1,
        validated=validated,
    )
    assert card.submission["vorticity_nrmse"].mean == 0.0
    assert card.submission["position_rmse"].mean == 0.0
    errors = {}
    for name, scores in card.scores.items():
        errors[name] = scores["position_rmse"].mean
        assert math.isfinite(errors[name])
    assert {"analog", "frozen-field"} <= errors.keys()
    assert errors["frozen-field"] < 0.2 * errors["persistence"]
