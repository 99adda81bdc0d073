"""Made-up boards for tests of the page: plausible numbers, fields and films, seeded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.board.model import (
    Board,
    Cost,
    Curve,
    Detail,
    Histogram,
    Pictures,
    Prediction,
    RaisedFlag,
    Row,
    Tab,
    Value,
)
from lagbench.metrics import METRICS

Floats = NDArray[np.float64]

METHODS = (
    *("GNS", "SuperGAT", "Transformer", "GATv2", "GAT", "PointNet", "LSTM+MLP", "LSTM", "MLP", "VAR"),
    *("SEGNN", "SuperGAT link", "Neural SPH", "GNS six terms", "Point Mamba", "Equivariant flow"),
)
"""Names, best first."""

GONE: tuple[dict[str, Any], ...] = (
    {"status": "superseded", "superseded_by": "gns", "reason": "Trained for longer."},
    {"status": "withdrawn", "reason": "Trained on test scenarios by mistake."},
)
"""What the last two of eight entries or more have become."""

FLOORS = ("persistence", "constant-velocity")
COLUMNS = {
    "box": ("vorticity_rmse", "vorticity_pearson", "stable_frames", "position_rmse", "energy_error"),
    "free": ("mse_avg", "mse_end", "position_rmse", "velocity_rmse", "energy_error"),
}
CURVES = {
    "box": ("vorticity_rmse", "position_rmse", "velocity_rmse", "vorticity_pearson", "energy_ratio"),
    "free": ("attribute_mse", "position_rmse", "velocity_rmse", "energy_ratio"),
}


def make_board(
    sizes: Sequence[tuple[str, str]] = (("cavity", "full"), ("cavity", "mini"), ("fluid", "full")),
    *,
    entries: int = 8,
    nodes: int = 40,
) -> Board:
    """Return a board with so many entries on each split and size, and the two floors."""
    tabs = tuple(make_tab(*name, entries=entries, nodes=nodes, seed=i) for i, name in enumerate(sizes))
    names = {name for tab in tabs for row in tab.rows for name in row.values}
    return Board(tabs=tabs, metrics={name: metric for name, metric in METRICS.items() if name in names})


def make_tab(split: str, size: str, *, entries: int, nodes: int, seed: int) -> Tab:
    """Return one tab."""
    kind = "box" if split in ("cavity", "curl-noise") else "free"
    frames = tuple(range(6, 96)) if kind == "box" else tuple(range(2, 300))
    shown = frames if len(frames) <= 120 else frames[:: len(frames) // 100]
    truth = pictures(kind, nodes, seed, strength=1.0, noise=0.0)
    names = [METHODS[i] if i < len(METHODS) else f"Method {i}" for i in range(entries)]
    rows = [make_row(kind, name, i, shown, truth, nodes, seed) for i, name in enumerate(names)]
    floors = [make_row(kind, name, None, shown, truth, nodes, seed) for name in FLOORS]
    rows.sort(key=lambda row: row.values[COLUMNS[kind][0]].mean)
    gone = [replace(row, **GONE[i]) for i, row in enumerate(rows[-2:])] if entries >= 8 else []
    live = rows[: len(rows) - len(gone)]
    ranked = [replace(row, rank=1 if i < 2 else i + 1, shared=i < 2) for i, row in enumerate(live)]
    f = np.linspace(0, 1, len(shown))
    energy = 3.1e-3 * (1 - 0.3 * f)
    return Tab(
        split=split,
        size=size,
        title={"cavity": "Lid-driven cavity", "fluid": "Free-surface liquid"}.get(split, split),
        dataset_version="1.0.0",
        dataset_sha256="ab12" * 16,
        particles=8192,
        input_frames=frames[0],
        frames=frames,
        frames_of_interest=truth.map_frames,
        frame_interval=0.1,
        scenarios=tuple(range(54, 60)),
        ranking=COLUMNS[kind][0],
        decided=True,
        columns=COLUMNS[kind],
        curves=CURVES[kind],
        energy=Curve(frames=shown, mean=energy, low=0.9 * energy, high=1.1 * energy),
        truth=truth,
        rows=(*ranked, *gone, *floors),
    )


def make_row(
    kind: str, name: str, place: int | None, frames: tuple[int, ...], truth: Pictures, nodes: int, seed: int
) -> Row:
    """Return the row of the method in a place, or of a floor where there is none."""
    still = name == "persistence"
    bad = 1.0 + 0.35 * place if place is not None else 6.0
    rng = np.random.Generator(np.random.PCG64([seed, int(100 * bad), len(name)]))
    drawn = pictures(kind, nodes, seed, strength=0.0 if still else 1.0 - 0.03 * bad, noise=0.03 * bad)
    return Row(
        id=f"{name.lower().replace('+', '-').replace(' ', '-')}",
        name=name,
        authors=("Ada Byron", "Émilie du Châtelet", "Osborne Reynolds")[: 1 + len(name) % 3],
        affiliation="" if place is None else "University of Examples",
        licence="MIT",
        code="https://example.org/code" if place is not None else None,
        paper="https://example.org/paper" if place is not None and place % 3 == 0 else None,
        date=f"2026-{1 + len(name) % 12:02d}-14",
        floor=place is None,
        status="active",
        superseded_by=None,
        reason="",
        current=True,
        dataset_version="1.0.0",
        rank=None,
        shared=False,
        p=0.03125 * bad,
        seeds=3 if place is not None and place % 2 == 0 else 1,
        parameters=None if place is None else int(1.6e6 * (1 + place**2)),
        cost=None if place is None or place % 7 == 6 else _cost(bad, rng),
        flags=_flags(place),
        warnings=(RaisedFlag(name="in_domain", reasons=("41 particles leave the box",)),)
        if place == 3
        else (),
        diverged=2 if place == 5 else 0,
        values={m: _value(m, bad, still, rng) for m in _metrics(kind)},
        detail=_detail(kind, bad, still, frames, drawn, truth, rng, name),
    )


def _cost(bad: float, rng: np.random.Generator) -> Cost:
    seconds = 0.08 / bad**1.2 * (0.5 + rng.random())
    return Cost(
        seconds_per_frame=seconds,
        device="NVIDIA H200" if rng.random() < 0.5 else "AMD EPYC 9354, 2 cores",
        solver_seconds_per_frame=0.21,
        speed_up=0.21 / seconds,
    )


def _flags(place: int | None) -> tuple[RaisedFlag, ...]:
    if place == 4:
        return (RaisedFlag(name="physics", reasons=("14 times the truth's kinetic energy",)),)
    if place == 6:
        return (RaisedFlag(name="copy_suspect", reasons=("the error drops within one frame",)),)
    return ()


def _metrics(kind: str) -> list[str]:
    elastic = ("jelly", "snow", "rope", "shape", "connectivity", "sinkhorn")
    return [
        name
        for name in METRICS
        if not any(word in name for word in elastic) and (kind == "free" or not name.endswith("_liquid"))
    ]


def _value(name: str, bad: float, still: bool, rng: np.random.Generator) -> Value:
    nothing = still and "pearson" in name
    base = {
        "vorticity_pearson": 1.0 - 0.03 * bad,
        "stable_frames": 95 - 6 * bad,
        "energy_ratio": 1 + 0.1 * bad,
    }
    middle = np.nan if nothing else base.get(name, 4e-3 * bad)
    per = middle * (0.7 + 0.6 * rng.random(6))
    spread = 0.2 * abs(middle)
    return Value(
        mean=float(np.mean(per)),
        std=0.01 * abs(middle) if rng.random() < 0.5 else np.nan,
        low=float(np.mean(per)) - spread,
        high=float(np.mean(per)) + spread,
        per_scenario=tuple(per.tolist()),
        at=dict.fromkeys(range(300) if METRICS[name].per_frame else (), middle),
        undefined=90 if nothing else (3 if name == "vorticity_pearson" and bad > 4 else 0),
    )


def _detail(
    kind: str,
    bad: float,
    still: bool,
    frames: tuple[int, ...],
    drawn: Pictures,
    truth: Pictures,
    rng: np.random.Generator,
    name: str,
) -> Detail:
    f = np.linspace(0, 1, len(frames))
    curves = {metric: _curve(metric, frames, f, bad, still, rng) for metric in CURVES[kind]}
    energy = np.full(len(f), 1e-9) if still else 3.1e-3 * (1 - 0.3 * f) * (1 + 0.03 * bad * f * np.sin(9 * f))
    residual = [p - t for p, t in zip(drawn.vorticity, truth.vorticity, strict=True)]
    return Detail(
        curves=curves,
        energy=Curve(frames=frames, mean=energy, low=0.9 * energy, high=1.1 * energy),
        pictures=drawn,
        residuals=tuple(_histogram(r, float(np.nanmax(np.abs(r))) or 1.0) for r in residual),
        command=f"lagbench train --baseline {name.lower()} --split cavity --seed 0\n"
        "lagbench predict --checkpoint runs/cavity/full/checkpoint.pt -o predictions.nc",
        training="48 train scenarios, 20000 steps, batch 2, bf16",
        hardware="NVIDIA H200, 1.2 h",
        notes="Weights of the best of three seeds.",
        predictions=tuple(
            Prediction(
                seed=k,
                sha256=f"{k}f" * 32,
                url=f"https://example.org/{k}/predictions.nc",
                path=None,
                size=21_500_000,
                score_file=f"scores/{k}.nc",
                mean=4e-3 * bad,
            )
            for k in range(3)
        ),
        scored_by="the lagbench authors",
        lagbench_version="0.1.0",
    )


def _curve(
    metric: str, frames: tuple[int, ...], f: Floats, bad: float, still: bool, rng: np.random.Generator
) -> Curve:
    wobble = 1 + 0.05 * np.cumsum(rng.random(len(f)) - 0.5)
    if metric == "vorticity_pearson":
        mean = np.full(len(f), np.nan) if still else np.exp(-0.1 * bad * f) * wobble.clip(0.9, 1.0)
        return Curve(frames=frames, mean=mean, low=mean - 0.1 * f, high=np.minimum(1.0, mean + 0.05 * f))
    if metric == "energy_ratio":
        mean = np.zeros(len(f)) if still else 1 + 0.03 * bad * f * np.sin(9 * f)
    else:
        mean = 2e-3 * bad * (0.02 + f) * wobble
    return Curve(frames=frames, mean=mean, low=0.7 * mean, high=1.4 * mean)


def pictures(kind: str, nodes: int, seed: int, *, strength: float, noise: float) -> Pictures:
    """Return maps and a film of four eddies, or of a falling, turning block."""
    frames = (6, 9, 18, 21, 48, 51, 54, 95) if kind == "box" else (60, 299)
    film_frames = (
        tuple(np.linspace(6, 95, 45).astype(int).tolist()) if kind == "box" else tuple(range(2, 299, 7))
    )
    x, y = np.meshgrid(*[np.linspace(0, 2 * np.pi, nodes)] * 2, indexing="ij")
    rng = np.random.Generator(np.random.PCG64(seed))
    maps = np.stack([_eddies(x, y, frame, strength, noise, rng) for frame in frames]).astype(np.float32)
    maps[:, :2] = maps[:, -2:] = np.nan
    maps[:, :, :2] = maps[:, :, -2:] = np.nan
    film = _film(kind, len(film_frames), strength, noise, np.random.Generator(np.random.PCG64(seed)))
    top = float(np.nanmax(np.abs(maps))) or 1.0
    return Pictures(
        scenario=54,
        map_frames=frames,
        vorticity=maps,
        histograms=tuple(_histogram(m, top) for m in maps),
        film_frames=film_frames,
        material=(np.arange(200) % 4 if kind == "free" else np.zeros(200)).astype(np.int8),
        film=film.astype(np.float32),
    )


def _eddies(
    x: Floats, y: Floats, frame: int, strength: float, noise: float, rng: np.random.Generator
) -> Floats:
    phase = frame / 95
    smooth = np.sin(x + phase) * np.sin(y) + 0.4 * np.sin(2 * x - phase) * np.sin(3 * y + phase)
    wrong = np.sin(3 * x + 2 * phase) * np.sin(2 * y) + 0.5 * (rng.random(x.shape) - 0.5)
    return 0.06 * (strength * smooth + noise * phase * wrong)


def _film(kind: str, frames: int, strength: float, noise: float, rng: np.random.Generator) -> Floats:
    if kind == "free":
        block = 0.35 * rng.random((200, 2)) + [0.1, 0.45]
        t = np.linspace(0, 1, frames)[:, None, None]
        fallen = block + t * [0.5 * strength, 0] - t**2 * [0, 0.9] + noise * t * (block - 0.3)
        return np.clip(fallen, 0.05, 0.95)
    p = rng.random((200, 2))
    film = [p]
    for _ in range(frames - 1):
        a, b = 2 * np.pi * film[-1].T
        step = np.stack([np.sin(a) * np.cos(b), -np.cos(a) * np.sin(b)], axis=1)
        film.append(np.clip(film[-1] + 0.012 * strength * step + 0.002 * noise, 0, 1))
    return 0.0625 + 0.875 * np.stack(film)


def _histogram(field: NDArray[np.floating], top: float) -> Histogram:
    counts, _ = np.histogram(field[np.isfinite(field)], bins=64, range=(-top, top))
    return Histogram(low=-top, high=top, shares=counts / max(1, counts.sum()))
