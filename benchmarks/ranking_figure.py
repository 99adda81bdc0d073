"""Draw docs/figures/ranking.png: what the ranking metrics forgive and what they punish.

    python benchmarks/ranking_figure.py

One frame of a full box and one of a cloud, each with a good, a shifted, a smoothed and
a permuted prediction, and the scores that our own metrics give them.
"""

from __future__ import annotations

import argparse
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
        x = position[:, 0] - shift
        y = position[:, 1]
        phase_x = np.pi * m * x
        phase_y = np.pi * n * y
        wave_number = np.hypot(m, n)
        scale = SPEED * amplitude / wave_number
        scale_x = scale * n
        scale_y = scale * m
        velocity[:, 0] += scale_x * np.sin(phase_x) * np.cos(phase_y)
        velocity[:, 1] -= scale_y * np.cos(phase_x) * np.sin(phase_y)
    return velocity


Motion = tuple[Floats, Floats]
"""Positions [length] and velocities [length/frame], shape [particle, 2]."""


def make_pair(truth: Motion, prediction: Motion, placement: Placement) -> FramePair:
    """Return the pair of a true and a predicted frame."""
    position, velocity = truth
    predicted_position, predicted_velocity = prediction
    particles = len(position)
    config = TaskConfig(
        grid=Grid(40, placement),
        input_frames=2,
        horizon=1,
        frames_of_interest=(2,),
        attribute_std=(0.3, 0.3, SPEED, SPEED),
        radius=0.03,
    )
    before = position - velocity
    two_frames_before = position - 2 * velocity
    area = 0.12
    if config.is_full_box:
        area = 1.0
    scenario = Scenario(
        config=config,
        input_positions=np.stack([two_frames_before, before]),
        material=np.zeros(particles, np.int8),
        particle_mass=1.0 / particles,
        area=area,
    )
    predicted_before = predicted_position - predicted_velocity
    return FramePair(
        scenario,
        2,
        scenario.snapshot(position, before),
        scenario.snapshot(predicted_position, predicted_before),
    )


def format_scores(pair: FramePair) -> str:
    """Return the shown scores of a pair, one line each."""
    grid = pair.scenario.config.grid
    names = SHOWN[Placement(grid.placement)]
    metrics = select(names)
    statistics = tally([pair], metrics, (pair.frame,))
    scores = aggregate(metrics, {0: statistics})
    lines = []
    for name in names:
        score = scores[name]
        # a rounding error would be shown in place of 0
        value = round(score.mean, 12)
        words = name.replace("_", " ")
        lines.append(f"{words} {value:.2g}")
    return "\n".join(lines)


def full_box(rng: np.random.Generator) -> dict[str, FramePair]:
    """Return predictions of a box full of eddies."""
    axis = (np.arange(90) + 0.5) / 90
    coordinates = np.meshgrid(axis, axis, indexing="ij")
    lattice = np.stack(coordinates, axis=-1)
    lattice = lattice.reshape(-1, 2)
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
        moved = position + 10.0 * velocity_error
        predicted_position = np.clip(moved, 0.0, 1.0)
        predicted_velocity = predicted_flow(predicted_position)
        predictions[name] = (predicted_position, predicted_velocity)
    permuted = (position[order], velocity[order])
    predictions["particles permuted"] = permuted

    truth = (position, velocity)
    pairs = {}
    for name, prediction in predictions.items():
        pairs[name] = make_pair(truth, prediction, Placement.CELL_CENTRES)
    return pairs


POOL = 900
DROP = 300  # particles of the pool and of the drop


def splash(rng: np.random.Generator) -> dict[str, FramePair]:
    """Return predictions of a splash: a pool and a drop."""
    pool_low = (0.05, 0.05)
    pool_high = (0.95, 0.17)
    pool = rng.uniform(pool_low, pool_high, (POOL, 2))
    area_share = rng.random(DROP)
    radius = 0.08 * np.sqrt(area_share)
    angle = rng.uniform(0, 2 * np.pi, DROP)
    drop_x = 0.35 + radius * np.cos(angle)
    drop_y = 0.5 + radius * np.sin(angle)
    drop = np.stack([drop_x, drop_y], axis=1)
    position = np.concatenate([pool, drop])
    velocity = np.zeros_like(position)
    order = rng.permutation(len(position))
    smear = rng.normal(0.0, 0.05, position.shape)
    low_drop = position.copy()
    low_drop[POOL:, 1] -= 0.02
    shifted_drop = position.copy()
    shifted_drop[POOL:, 0] += 0.25
    smeared = position + smear
    predictions: dict[str, Floats] = {
        "truth": position,
        "good: drop 2 % low": low_drop,
        "drop shifted by 25 %": shifted_drop,
        "smeared": np.clip(smeared, 0.0, 1.0),
        "particles permuted": position[order],
    }
    truth = (position, velocity)
    pairs = {}
    for name, predicted_position in predictions.items():
        prediction = (predicted_position, velocity)
        pairs[name] = make_pair(truth, prediction, Placement.NODES)
    return pairs


def draw_prediction(axes: Axes, pair: FramePair, limit: float) -> None:
    """Draw the vorticity of a full box, or the particles on a free surface."""
    if pair.scenario.config.is_full_box:
        vorticity = pair.predicted_fields.vorticity
        axes.imshow(
            vorticity.T,
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.parse_args()

    rng = np.random.Generator(np.random.PCG64(1))
    full_box_pairs = full_box(rng)
    splash_pairs = splash(rng)
    true_vorticity = full_box_pairs["truth"].true_vorticity
    magnitude = np.abs(true_vorticity)
    limit = float(magnitude.max())

    figure, all_axes = plt.subplots(2, 5, figsize=(11, 5.9), layout="constrained")
    rows = (full_box_pairs, splash_pairs)
    for row, pairs in enumerate(rows):
        for column, (name, pair) in enumerate(pairs.items()):
            axes = all_axes[row, column]
            draw_prediction(axes, pair, limit)
            axes.set(xticks=[], yticks=[])
            axes.set_title(name, fontsize=9)
            if name != "truth":
                text = format_scores(pair)
                axes.set_xlabel(text, fontsize=8)
    all_axes[0, 0].set_ylabel("full box: vorticity", fontsize=9)
    all_axes[1, 0].set_ylabel("free surface: particles", fontsize=9)
    PATH.parent.mkdir(exist_ok=True)
    figure.savefig(PATH, dpi=110)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
