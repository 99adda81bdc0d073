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


def flow(x: Floats, *, largest: int = 99, shift: float = 0.0) -> Floats:
    """Return the velocity of the modes up to a wave number [length/frame], shape
    [particle, 2].
    """
    u = np.zeros_like(x)
    for (m, n), amplitude in MODES.items():
        if max(m, n) <= largest:
            a = np.pi * m * (x[:, 0] - shift)
            b = np.pi * n * x[:, 1]
            scale = SPEED * amplitude / np.hypot(m, n)
            u += scale * np.stack(
                [n * np.sin(a) * np.cos(b), -m * np.cos(a) * np.sin(b)], axis=1
            )
    return u


def pair_of(
    x: Floats, u: Floats, y: Floats, v: Floats, placement: Placement
) -> FramePair:
    """Return the pair of a truth (positions, velocities) and a prediction."""
    config = TaskConfig(
        grid=Grid(40, placement),
        input_frames=2,
        horizon=1,
        frames_of_interest=(2,),
        attribute_std=(0.3, 0.3, SPEED, SPEED),
        radius=0.03,
    )
    scenario = Scenario(
        config=config,
        input_positions=np.stack([x - 2 * u, x - u]),
        material=np.zeros(len(x), np.int8),
        particle_mass=1.0 / len(x),
        area=1.0 if config.is_full_box else 0.12,
    )
    return FramePair(
        scenario, 2, scenario.snapshot(x, x - u), scenario.snapshot(y, y - v)
    )


def scores(pair: FramePair) -> str:
    """Return the shown scores of a pair, one line each."""
    names = SHOWN[Placement(pair.scenario.config.grid.placement)]
    metrics = select(names)
    found = aggregate(metrics, {0: tally([pair], metrics, (2,))})
    return "\n".join(
        f"{name.replace('_', ' ')} {round(found[name].mean, 12):.2g}" for name in names
    )


def full_box(rng: np.random.Generator) -> dict[str, FramePair]:
    """Return predictions of a box full of eddies."""
    axis = (np.arange(90) + 0.5) / 90
    x = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    x = np.clip(x + rng.uniform(-0.004, 0.004, x.shape), 0.0, 1.0)
    u = flow(x)
    order = rng.permutation(len(x))
    wrong: dict[str, Callable[[Floats], Floats]] = {
        "truth": flow,
        "good: 7 % too fast": lambda y: 1.07 * flow(y),
        "shifted by 6 %": lambda y: flow(y, shift=0.06),
        "smoothed": lambda y: flow(y, largest=4),
    }
    sides = {}
    for name, predicted in wrong.items():
        # where ten such frames would lead
        y = np.clip(x + 10.0 * (predicted(x) - u), 0.0, 1.0)
        sides[name] = y, predicted(y)
    sides["particles permuted"] = x[order], u[order]
    return {
        name: pair_of(x, u, *side, Placement.CELL_CENTRES)
        for name, side in sides.items()
    }


def cloud(rng: np.random.Generator) -> dict[str, FramePair]:
    """Return predictions of a splash: a pool and a drop."""
    pool = rng.uniform((0.05, 0.05), (0.95, 0.17), (900, 2))
    radius = 0.08 * np.sqrt(rng.random(300))
    angle = rng.uniform(0, 2 * np.pi, 300)
    drop = np.stack(
        [0.35 + radius * np.cos(angle), 0.5 + radius * np.sin(angle)], axis=1
    )
    x = np.concatenate([pool, drop])
    u = np.zeros((1200, 2))
    order = rng.permutation(1200)
    smear = rng.normal(0.0, 0.05, (1200, 2))
    falling = np.where(np.arange(1200)[:, None] < 900, 0.0, 1.0)
    sides: dict[str, Floats] = {
        "truth": x,
        "good: drop 2 % low": x - falling * [0.0, 0.02],
        "drop shifted by 25 %": x + falling * [0.25, 0.0],
        "smeared": np.clip(x + smear, 0.0, 1.0),
        "particles permuted": x[order],
    }
    return {name: pair_of(x, u, y, u, Placement.NODES) for name, y in sides.items()}


def main() -> int:
    """Draw the figure."""
    rng = np.random.Generator(np.random.PCG64(1))
    rows = full_box(rng), cloud(rng)
    figure, axes = plt.subplots(2, 5, figsize=(11, 5.9), layout="constrained")
    limit = float(np.max(np.abs(rows[0]["truth"].true_vorticity)))
    for line, row in zip(axes, rows, strict=True):
        for ax, (name, pair) in zip(line, row.items(), strict=True):
            if pair.scenario.config.is_full_box:
                ax.imshow(
                    pair.predicted_fields.vorticity.T,
                    origin="lower",
                    cmap="RdBu_r",
                    vmin=-limit,
                    vmax=limit,
                )
            else:
                ax.scatter(
                    *pair.prediction.position.T, s=1.2, c="#20639b", linewidths=0
                )
                ax.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
            ax.set(xticks=[], yticks=[])
            ax.set_title(name, fontsize=9)
            ax.set_xlabel("" if name == "truth" else scores(pair), fontsize=8)
    axes[0, 0].set_ylabel("full box: vorticity", fontsize=9)
    axes[1, 0].set_ylabel("free surface: particles", fontsize=9)
    PATH.parent.mkdir(exist_ok=True)
    figure.savefig(PATH, dpi=110)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
