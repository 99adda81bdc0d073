"""Draw docs/figures/ranking.png: what the ranking metrics forgive and what they punish.

    python benchmarks/ranking_figure.py

One frame of a full box and one of a cloud, each with a good, a shifted, a smoothed and
a permuted prediction, and the scores that our own metrics give them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from lagbench.data.grid import Grid, Placement
from lagbench.metrics import FramePair, Scenario, TaskConfig, aggregate, select, tally

Floats = NDArray[np.float64]

PATH = Path(__file__).parent.parent / "docs" / "figures" / "ranking.png"
MODES = {(1, 2): 1.0, (3, 2): 0.8, (4, 5): 0.5, (7, 6): 0.35, (9, 11): 0.25}
"""Amplitudes of stream functions sin(m pi x) sin(n pi y), each over its wave number."""

SPEED = 0.004
SHOWN = {
    Placement.CELL_CENTRES: (
        "vorticity_nrmse",
        "vorticity_pearson",
        "spectrum_error",
        "position_rmse",
    ),
    Placement.NODES: ("cloud_distance", "position_rmse"),
}


def flow(position: Floats, *, largest: int = 99, shift: float = 0.0) -> Floats:
    """Return the velocity of the modes up to a wave number [length/frame].

    The shape is [particle, 2].
    """
    velocity = np.zeros_like(position)
    for (m, n), amplitude in MODES.items():
        if max(m, n) > largest:
            continue
        phase_x = np.pi * m * (position[:, 0] - shift)
        phase_y = np.pi * n * position[:, 1]
        scale = SPEED * amplitude / np.hypot(m, n)
        velocity[:, 0] += scale * n * np.sin(phase_x) * np.cos(phase_y)
        velocity[:, 1] -= scale * m * np.cos(phase_x) * np.sin(phase_y)
    return velocity


Motion = tuple[Floats, Floats]
"""Positions [length] and velocities [length/frame], shape [particle, 2]."""


def make_pair(truth: Motion, prediction: Motion, placement: Placement) -> FramePair:
    """Return the pair of a true and a predicted frame."""
    position, velocity = truth
    predicted_position, predicted_velocity = prediction
    config = TaskConfig(
        grid=Grid(40, placement),
        input_frames=2,
        horizon=1,
        frames_of_interest=(2,),
        attribute_std=(0.3, 0.3, SPEED, SPEED),
        radius=0.03,
    )
    given_positions = np.stack([position - 2 * velocity, position - velocity])
    scenario = Scenario(
        config=config,
        input_positions=given_positions,
        material=np.zeros(len(position), np.int8),
        particle_mass=1.0 / len(position),
        area=1.0 if config.is_full_box else 0.12,
    )
    true_snapshot = scenario.snapshot(position, position - velocity)
    predicted_snapshot = scenario.snapshot(
        predicted_position, predicted_position - predicted_velocity
    )
    return FramePair(scenario, 2, true_snapshot, predicted_snapshot)


def format_scores(pair: FramePair) -> str:
    """Return the shown scores of a pair, one line each."""
    names = SHOWN[Placement(pair.scenario.config.grid.placement)]
    metrics = select(names)
    scores = aggregate(metrics, {0: tally([pair], metrics, (2,))})
    lines = []
    for name in names:
        value = round(scores[name].mean, 12)
        lines.append(f"{name.replace('_', ' ')} {value:.2g}")
    return "\n".join(lines)


def full_box(rng: np.random.Generator) -> dict[str, FramePair]:
    """Return predictions of a box full of eddies."""
    axis = (np.arange(90) + 0.5) / 90
    lattice = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    jitter = rng.uniform(-0.004, 0.004, lattice.shape)
    position = np.clip(lattice + jitter, 0.0, 1.0)
    velocity = flow(position)
    order = rng.permutation(len(position))
    predicted_flows: dict[str, Callable[[Floats], Floats]] = {
        "truth": flow,
        "good: 7 % too fast": lambda x: 1.07 * flow(x),
        "shifted by 6 %": lambda x: flow(x, shift=0.06),
        "smoothed": lambda x: flow(x, largest=4),
    }
    predictions: dict[str, Motion] = {}
    for name, predicted_flow in predicted_flows.items():
        # the positions after ten frames with such an error
        velocity_error = predicted_flow(position) - velocity
        predicted = np.clip(position + 10.0 * velocity_error, 0.0, 1.0)
        predictions[name] = predicted, predicted_flow(predicted)
    predictions["particles permuted"] = position[order], velocity[order]
    truth = position, velocity
    return {
        name: make_pair(truth, prediction, Placement.CELL_CENTRES)
        for name, prediction in predictions.items()
    }


POOL = 900
DROP = 300  # particles of the pool and of the drop


def splash(rng: np.random.Generator) -> dict[str, FramePair]:
    """Return predictions of a splash: a pool and a drop."""
    pool = rng.uniform((0.05, 0.05), (0.95, 0.17), (POOL, 2))
    radius = 0.08 * np.sqrt(rng.random(DROP))
    angle = rng.uniform(0, 2 * np.pi, DROP)
    drop_x = 0.35 + radius * np.cos(angle)
    drop_y = 0.5 + radius * np.sin(angle)
    position = np.concatenate([pool, np.stack([drop_x, drop_y], axis=1)])
    velocity = np.zeros_like(position)
    order = rng.permutation(len(position))
    smear = rng.normal(0.0, 0.05, position.shape)
    # 1 for particles of the drop, shape [particle, 1]
    is_drop = np.concatenate([np.zeros((POOL, 1)), np.ones((DROP, 1))])
    predictions: dict[str, Floats] = {
        "truth": position,
        "good: drop 2 % low": position - is_drop * [0.0, 0.02],
        "drop shifted by 25 %": position + is_drop * [0.25, 0.0],
        "smeared": np.clip(position + smear, 0.0, 1.0),
        "particles permuted": position[order],
    }
    truth = position, velocity
    return {
        name: make_pair(truth, (predicted, velocity), Placement.NODES)
        for name, predicted in predictions.items()
    }


def draw_prediction(axes: Axes, pair: FramePair, limit: float) -> None:
    """Draw the vorticity of a full box, or the particles on a free surface."""
    if pair.scenario.config.is_full_box:
        axes.imshow(
            pair.predicted_fields.vorticity.T,
            origin="lower",
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
        )
    else:
        x, y = pair.prediction.position.T
        axes.scatter(x, y, s=1.2, c="#20639b", linewidths=0)
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")


def main() -> int:
    """Draw the figure."""
    rng = np.random.Generator(np.random.PCG64(1))
    rows = (full_box(rng), splash(rng))
    figure, all_axes = plt.subplots(2, 5, figsize=(11, 5.9), layout="constrained")
    limit = float(np.max(np.abs(rows[0]["truth"].true_vorticity)))
    for line, row in zip(all_axes, rows, strict=True):
        for axes, (name, pair) in zip(line, row.items(), strict=True):
            draw_prediction(axes, pair, limit)
            axes.set(xticks=[], yticks=[])
            axes.set_title(name, fontsize=9)
            if name != "truth":
                axes.set_xlabel(format_scores(pair), fontsize=8)
    all_axes[0, 0].set_ylabel("full box: vorticity", fontsize=9)
    all_axes[1, 0].set_ylabel("free surface: particles", fontsize=9)
    PATH.parent.mkdir(exist_ok=True)
    figure.savefig(PATH, dpi=110)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
