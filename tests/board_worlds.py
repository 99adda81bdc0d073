"""Made-up boards, for tests of the page."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.board.entry import (
    DataSet,
    Entry,
    EntryBudget,
    EntryCost,
    EntryFlag,
    Prediction,
    ScoreBlock,
    ScoredFile,
    Verification,
)
from lagbench.board.model import (
    Board,
    BoardRow,
    Curve,
    Histogram,
    Pictures,
    ReferenceRow,
    Tab,
    Value,
)
from lagbench.data.registry import load
from lagbench.metrics import METRICS
from lagbench.references.predictor import Kind
from lagbench.scoring.score_file_checks import reported_frames
from lagbench.submission.task_checks import frames_to_predict

Floats = NDArray[np.float64]

DAY = datetime.date(2026, 1, 31)
HASH = "0123456789abcdef" * 4

METHODS = (
    *(
        "GNS",
        "SuperGAT",
        "Transformer",
        "GATv2",
        "GAT",
        "PointNet",
        "LSTM+MLP",
        "LSTM",
        "MLP",
        "VAR",
    ),
    *(
        "SEGNN",
        "SuperGAT link",
        "Neural SPH",
        "GNS six terms",
        "Point Mamba",
        "Equivariant flow",
    ),
)
"""Names, best first."""

GONE: tuple[dict[str, Any], ...] = (
    {"status": "superseded", "superseded_by": "gns", "reason": "Trained for longer."},
    {"status": "withdrawn", "reason": "Trained on test scenarios by mistake."},
)
"""What the last two of eight entries or more have become."""

REFERENCES = ("held-still", "straight-on")
COLUMNS = {
    "box": (
        "vorticity_rmse",
        "vorticity_pearson",
        "stable_frames",
        "position_rmse",
        "energy_error",
    ),
    "free": ("mse_avg", "mse_end", "position_rmse", "velocity_rmse", "energy_error"),
}
CURVES = {
    "box": (
        "vorticity_rmse",
        "position_rmse",
        "velocity_rmse",
        "vorticity_pearson",
        "energy_ratio",
    ),
    "free": ("attribute_mse", "position_rmse", "velocity_rmse", "energy_ratio"),
}


def make_board(
    sizes: Sequence[tuple[str, str]] = (
        ("cavity", "full"),
        ("cavity", "mini"),
        ("fluid", "full"),
    ),
    *,
    entries: int = 8,
    nodes: int = 40,
    skill: bool = True,
) -> Board:
    """Return a board with so many entries on each split and size, and two floors."""
    tabs = tuple(
        make_tab(*name, entries=entries, nodes=nodes, seed=i, skill=skill)
        for i, name in enumerate(sizes)
    )
    names = {name for tab in tabs for row in tab.lines for name in row.values}
    metrics = {name: metric for name, metric in METRICS.items() if name in names}
    return Board(tabs=tabs, empty=(("multimaterial", "mini"),), metrics=metrics)


def make_tab(
    split: str, size: str, *, entries: int, nodes: int, seed: int, skill: bool
) -> Tab:
    """Return one tab."""
    kind = "box" if split in ("cavity", "curl-noise") else "free"
    described = load().size(split, size)
    frames = tuple(frames_to_predict(described))
    shown = frames if len(frames) <= 120 else frames[:: len(frames) // 100]
    world = _World(
        kind,
        shown,
        nodes,
        seed,
        reported_frames(described),
        len(described.subsets["test"]),
    )
    names = [METHODS[i] if i < len(METHODS) else f"Method {i}" for i in range(entries)]
    rows = [
        world.row(name, i, split, size, skill=skill) for i, name in enumerate(names)
    ]
    rows.sort(key=lambda row: row.values[COLUMNS[kind][0]].mean)
    gone = (
        [with_entry(row, **GONE[i]) for i, row in enumerate(rows[-2:])]
        if entries >= 8
        else []
    )
    live = rows[: len(rows) - len(gone)]
    ranked = [
        replace(row, rank=i + 1, tied=i == 1, p=np.nan if i == 0 else row.p)
        for i, row in enumerate(live)
    ]
    return Tab(
        size=described,
        title={"cavity": "Lid-driven cavity", "fluid": "Free-surface liquid"}.get(
            split, split
        ),
        scenarios=tuple(described.subsets["test"]),
        frames=frames,
        marked=world.truth.map_frames,
        ranking=COLUMNS[kind][0],
        decided=True,
        columns=COLUMNS[kind],
        curves=CURVES[kind],
        energy=world.banded(3.1e-3 * (1 - 0.3 * world.share), 0.1),
        truth=world.truth,
        rows=(*ranked, *gone),
        references=tuple(world.floor(name) for name in REFERENCES),
    )


def with_entry(row: BoardRow, **changes: Any) -> BoardRow:
    """Return a row whose entry says something else, checked or not."""
    return replace(row, entry=row.entry.model_copy(update=changes))


@dataclass
class _World:
    """What all rows of a tab share."""

    kind: str
    frames: tuple[int, ...]
    nodes: int
    seed: int
    marked: tuple[int, ...]
    scenarios: int

    def __post_init__(self) -> None:
        self.share = np.linspace(0, 1, len(self.frames))  # of the horizon
        self.truth = self.pictures(strength=1.0, noise=0.0)

    def banded(self, mean: Floats, width: float) -> Curve:
        """Return a curve with its band."""
        return Curve(
            frames=self.frames,
            mean=mean,
            low=(1 - width) * mean,
            high=(1 + width) * mean,
        )

    def floor(self, name: str) -> ReferenceRow:
        """Return a floor."""
        return ReferenceRow(
            name=name,
            kind=Kind.NAIVE,
            definition=f"What {name} says.",
            **self.scores(name, 6.0, name == REFERENCES[0]),
        )

    def scores(self, name: str, bad: float, still: bool) -> dict[str, Any]:
        """Return values, curves and energy of a method that is so bad."""
        rng = np.random.Generator(
            np.random.PCG64([self.seed, int(100 * bad), len(name)])
        )
        f = self.share
        values = {
            metric: self.value(metric, bad, still, rng)
            for metric in _metrics(self.kind)
        }
        curves = {
            metric: self.curve(metric, bad, still, rng) for metric in CURVES[self.kind]
        }
        moved = 3.1e-3 * (1 - 0.3 * f) * (1 + 0.03 * bad * f * np.sin(9 * f))
        energy = self.banded(np.full(len(f), 1e-9) if still else moved, 0.1)
        return {"values": values, "curves": curves, "energy": energy}

    def row(
        self, name: str, place: int, split: str, size: str, *, skill: bool
    ) -> BoardRow:
        """Return the row of the method in a place."""
        bad = 1.0 + 0.35 * place
        rng = np.random.Generator(np.random.PCG64([self.seed, place]))
        scores = self.scores(name, bad, still=False)
        drawn = self.pictures(strength=1.0 - 0.03 * bad, noise=0.03 * bad)
        residual = [
            p - t for p, t in zip(drawn.vorticity, self.truth.vorticity, strict=True)
        ]
        mean = 1.0 - 0.1 * bad
        known = replace(
            scores["values"]["position_rmse"],
            mean=mean,
            low=mean - 0.1,
            high=mean + 0.1,
        )
        return BoardRow(
            entry=make_entry(
                name, place, split, size, None if place % 7 == 6 else _cost(bad, rng)
            ),
            current=True,
            rank=None,
            tied=False,
            p=0.03125 * bad,
            verified=Verification(scores=(HASH,), lagbench="0.2.0", date=DAY)
            if place % 3 == 0
            else None,
            skill=known if skill else None,
            against_classical=None,
            solver=None,
            seed_means=(4e-3 * bad,) * (3 if place % 2 == 0 else 1),
            pictures=drawn,
            residuals=tuple(
                _histogram(r, float(np.nanmax(np.abs(r))) or 1.0) for r in residual
            ),
            **scores,
        )

    def value(
        self, name: str, bad: float, still: bool, rng: np.random.Generator
    ) -> Value:
        """Return a metric of a method that is so bad."""
        nothing = still and "pearson" in name
        base = {
            "vorticity_pearson": 1 - 0.03 * bad,
            "stable_frames": 95 - 6 * bad,
            "energy_ratio": 1 + 0.1 * bad,
        }
        middle = np.nan if nothing else base.get(name, 4e-3 * bad)
        per = middle * (0.7 + 0.6 * rng.random(self.scenarios))
        mean = float(np.mean(per))
        spread = 0.2 * abs(middle)
        return Value(
            mean=mean,
            std=0.01 * abs(middle) if rng.random() < 0.5 else np.nan,
            low=mean - spread,
            high=mean + spread,
            per_scenario=tuple(per.tolist()),
            at=dict.fromkeys(self.marked if METRICS[name].per_frame else (), middle),
            undefined=90
            if nothing
            else (3 if name == "vorticity_pearson" and bad > 4 else 0),
        )

    def curve(
        self, metric: str, bad: float, still: bool, rng: np.random.Generator
    ) -> Curve:
        """Return the curve of a metric of a method that is so bad."""
        f = self.share
        wobble = 1 + 0.05 * np.cumsum(rng.random(len(f)) - 0.5)
        if metric == "vorticity_pearson":
            mean = (
                np.full(len(f), np.nan)
                if still
                else np.exp(-0.1 * bad * f) * wobble.clip(0.9, 1.0)
            )
            high = np.minimum(1.0, mean + 0.05 * f)
            return Curve(frames=self.frames, mean=mean, low=mean - 0.1 * f, high=high)
        mean = 2e-3 * bad * (0.02 + f) * wobble
        if metric == "energy_ratio":
            mean = np.zeros(len(f)) if still else 1 + 0.03 * bad * f * np.sin(9 * f)
        return Curve(frames=self.frames, mean=mean, low=0.7 * mean, high=1.4 * mean)

    def pictures(self, *, strength: float, noise: float) -> Pictures:
        """Return maps and a film of four eddies, or of a falling, turning block."""
        film_frames = tuple(
            np.linspace(self.frames[0], self.frames[-1], 45).astype(int).tolist()
        )
        x, y = np.meshgrid(*[np.linspace(0, 2 * np.pi, self.nodes)] * 2, indexing="ij")
        rng, again = (np.random.Generator(np.random.PCG64(self.seed)) for _ in range(2))
        eddies = [_eddies(x, y, frame, strength, noise, rng) for frame in self.marked]
        maps = np.stack(eddies).astype(np.float32)
        maps[:, :2] = maps[:, -2:] = np.nan
        maps[:, :, :2] = maps[:, :, -2:] = np.nan
        top = float(np.nanmax(np.abs(maps))) or 1.0
        return Pictures(
            scenario=54,
            map_frames=self.marked,
            vorticity=maps,
            histograms=tuple(_histogram(m, top) for m in maps),
            film_frames=film_frames,
            material=(
                np.arange(200) % 4 if self.kind == "free" else np.zeros(200)
            ).astype(np.int8),
            film=_film(self.kind, len(film_frames), strength, noise, again).astype(
                np.float32
            ),
        )


def make_entry(
    name: str, place: int, split: str, size: str, cost: EntryCost | None
) -> Entry:
    """Return an entry that says a little of everything."""
    seeds: list[int | None] = [0, 1, 2] if place % 2 == 0 else [None]
    hashes = [f"{k}f" * 32 for k in range(len(seeds))]
    flags = {
        4: EntryFlag(name="physics", reasons=("14 times the truth's kinetic energy",))
    }
    flags[6] = EntryFlag(
        name="copy_suspect", reasons=("the error drops within one frame",)
    )
    outside = EntryFlag(
        name="in_domain", reasons=("41 positions lie outside the box",), share=0.059
    )
    files = [
        ScoredFile(
            sha256=sha256,
            predictions_sha256=sha256,
            flags=(flags[place],) if place in flags else (),
            warnings=(outside,) if place == 3 else (),
            diverged_at={54: 7, 55: 9} if place == 5 and i == 0 else {},
        )
        for i, sha256 in enumerate(hashes)
    ]
    method = name.lower().replace("+", "-").replace(" ", "-")
    return Entry(
        format=2,
        split=split,
        size=size,
        method=method,
        name=name,
        authors=("Ada Byron", "Émilie du Châtelet", "Osborne Reynolds")[
            : 1 + len(name) % 3
        ],
        affiliation="University of Examples",
        licence="MIT",
        code="https://example.org/code",
        paper="https://example.org/paper" if place % 3 == 0 else None,
        weights="https://example.org/weights" if place % 4 == 0 else None,
        date=datetime.date(2026, 1 + len(name) % 12, 14),
        notes="Weights of the best of three seeds.",
        training="48 train scenarios, 20000 steps, batch 2, bf16",
        budget=EntryBudget(
            track="equal compute",
            windows=40_000 * (place + 1),
            epochs=1.5,
            cpu_hours=0.25,
        ),
        parameters=int(1.6e6 * (1 + place**2)),
        hardware="NVIDIA H200, 1.2 h",
        command=f"lagbench train --baseline {method} --split cavity --seed 0\n"
        "lagbench predict --checkpoint runs/cavity/full/checkpoint.pt -o "
        "predictions.nc",
        dataset=DataSet(version="1.0.0", sha256="ab12" * 16),
        predictions=tuple(
            Prediction(
                seed=seed,
                sha256=sha256,
                url=f"https://example.org/{i}.nc",
                bytes=21_500_000,
            )
            for i, (seed, sha256) in enumerate(zip(seeds, hashes, strict=True))
        ),
        cost=cost,
        score=ScoreBlock(
            lagbench="0.1.0",
            dataset_sha256="ab12" * 16,
            ranking_metric="vorticity_rmse",
            files=tuple(files),
            metrics={},
        ),
    )


def _cost(bad: float, rng: np.random.Generator) -> EntryCost:
    seconds = 0.08 / bad**1.2 * (0.5 + rng.random())
    device = "NVIDIA H200" if rng.random() < 0.5 else "AMD EPYC 9354, 2 cores"
    return EntryCost(
        seconds_per_frame=seconds, device=device, solver_seconds_per_frame=0.21
    )


def _metrics(kind: str) -> list[str]:
    elastic = ("jelly", "snow", "rope", "shape", "connectivity", "sinkhorn")
    return [
        name
        for name in METRICS
        if not any(word in name for word in elastic)
        and (kind == "free" or not name.endswith("_liquid"))
    ]


def _eddies(
    x: Floats,
    y: Floats,
    frame: int,
    strength: float,
    noise: float,
    rng: np.random.Generator,
) -> Floats:
    phase = frame / 95
    smooth = np.sin(x + phase) * np.sin(y) + 0.4 * np.sin(2 * x - phase) * np.sin(
        3 * y + phase
    )
    wrong = np.sin(3 * x + 2 * phase) * np.sin(2 * y) + 0.5 * (
        rng.random(x.shape) - 0.5
    )
    return 0.06 * (strength * smooth + noise * phase * wrong)


def _film(
    kind: str, frames: int, strength: float, noise: float, rng: np.random.Generator
) -> Floats:
    if kind == "free":
        block = 0.35 * rng.random((200, 2)) + [0.1, 0.45]
        t = np.linspace(0, 1, frames)[:, None, None]
        fallen = (
            block
            + t * [0.5 * strength, 0]
            - t**2 * [0, 0.9]
            + noise * t * (block - 0.3)
        )
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
