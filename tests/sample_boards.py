"""Sample boards of made-up methods, for tests of the page."""

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
    "SEGNN",
    "SuperGAT link",
    "Neural SPH",
    "GNS six terms",
    "Point Mamba",
    "Equivariant flow",
)
"""Names, best first."""

INACTIVE: tuple[dict[str, Any], ...] = (
    {
        "status": "superseded",
        "superseded_by": "gns",
        "reason": "Trained for longer.",
    },
    {
        "status": "withdrawn",
        "reason": "Trained on test scenarios by mistake.",
    },
)
"""Changes that make the last two of eight entries or more inactive."""

TITLES = {"cavity": "Lid-driven cavity", "fluid": "Free-surface liquid"}
FILM_PARTICLES = 200

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
    """Return a board with entries on each split and size, and two references."""
    tabs = []
    for seed, (split, size) in enumerate(sizes):
        tab = make_tab(
            split,
            size,
            entries=entries,
            nodes=nodes,
            seed=seed,
            skill=skill,
        )
        tabs.append(tab)

    names = set()
    for tab in tabs:
        for row in tab.lines:
            names |= set(row.values)
    metrics = {name: metric for name, metric in METRICS.items() if name in names}
    empty = (("multimaterial", "mini"),)
    return Board(tabs=tuple(tabs), empty=empty, metrics=metrics)


def make_tab(
    split: str, size: str, *, entries: int, nodes: int, seed: int, skill: bool
) -> Tab:
    """Return one tab."""
    kind = "free"
    if split in ("cavity", "curl-noise"):
        kind = "box"
    described = load().size(split, size)
    frames = tuple(frames_to_predict(described))
    curve_frames = frames
    if len(frames) > 120:
        curve_frames = frames[:: len(frames) // 100]
    world = _World(
        kind=kind,
        frames=curve_frames,
        nodes=nodes,
        seed=seed,
        marked=reported_frames(described),
        scenarios=len(described.subsets["test"]),
    )

    ranking = COLUMNS[kind][0]
    rows = []
    for place in range(entries):
        name = f"Method {place}"
        if place < len(METHODS):
            name = METHODS[place]
        rows.append(world.row(name, place, split, size, skill=skill))
    rows.sort(key=lambda row: row.values[ranking].mean)

    inactive = []
    if entries >= 8:
        for row, changes in zip(rows[-2:], INACTIVE, strict=True):
            inactive.append(with_entry(row, **changes))
    ranked = []
    for place, row in enumerate(rows[: len(rows) - len(inactive)]):
        p = row.p
        if place == 0:
            p = np.nan
        ranked.append(replace(row, rank=place + 1, tied=place == 1, p=p))

    true_energy = 3.1e-3 * (1 - 0.3 * world.share)
    return Tab(
        size=described,
        title=TITLES.get(split, split),
        scenarios=tuple(described.subsets["test"]),
        frames=frames,
        marked=world.truth.map_frames,
        ranking=ranking,
        decided=True,
        columns=COLUMNS[kind],
        curves=CURVES[kind],
        energy=world.with_band(true_energy, 0.1),
        truth=world.truth,
        rows=(*ranked, *inactive),
        references=tuple(world.reference(name) for name in REFERENCES),
    )


def with_entry(row: BoardRow, **changes: Any) -> BoardRow:
    """Return a row with changes of its entry, whose values are not checked."""
    return replace(row, entry=row.entry.model_copy(update=changes))


@dataclass
class _World:
    """The values that all rows of a tab share."""

    kind: str  # box or free
    frames: tuple[int, ...]
    nodes: int
    seed: int
    marked: tuple[int, ...]
    scenarios: int

    def __post_init__(self) -> None:
        self.share = np.linspace(0, 1, len(self.frames))  # of the horizon
        self.truth = self.pictures(strength=1.0, noise=0.0)

    def with_band(self, mean: Floats, width: float) -> Curve:
        """Return a curve with a band of a relative width."""
        low = (1 - width) * mean
        high = (1 + width) * mean
        return Curve(frames=self.frames, mean=mean, low=low, high=high)

    def reference(self, name: str) -> ReferenceRow:
        """Return the row of a reference predictor."""
        is_still = name == REFERENCES[0]
        return ReferenceRow(
            name=name,
            kind=Kind.NAIVE,
            definition=f"What {name} says.",
            **self.scores(name, 6.0, is_still),
        )

    def scores(self, name: str, error: float, is_still: bool) -> dict[str, Any]:
        """Return values, curves and energy of a method with a relative error."""
        seed = [self.seed, int(100 * error), len(name)]
        rng = np.random.Generator(np.random.PCG64(seed))
        values = {}
        for metric in _metrics(self.kind):
            values[metric] = self.value(metric, error, is_still, rng)
        curves = {}
        for metric in CURVES[self.kind]:
            curves[metric] = self.curve(metric, error, is_still, rng)

        energy = np.full(len(self.share), 1e-9)
        if not is_still:
            loss = 1 - 0.3 * self.share
            wave = 1 + 0.03 * error * self.share * np.sin(9 * self.share)
            energy = 3.1e-3 * loss * wave
        return {
            "values": values,
            "curves": curves,
            "energy": self.with_band(energy, 0.1),
        }

    def row(
        self, name: str, place: int, split: str, size: str, *, skill: bool
    ) -> BoardRow:
        """Return the row of the method in a place."""
        error = 1.0 + 0.35 * place
        rng = np.random.Generator(np.random.PCG64([self.seed, place]))
        scores = self.scores(name, error, is_still=False)
        pictures = self.pictures(strength=1.0 - 0.03 * error, noise=0.03 * error)
        residuals = []
        for map_index, true_map in enumerate(self.truth.vorticity):
            residual = pictures.vorticity[map_index] - true_map
            top = float(np.nanmax(np.abs(residual))) or 1.0
            residuals.append(_histogram(residual, top))

        mean_skill = 1.0 - 0.1 * error
        skill_value = None
        if skill:
            skill_value = replace(
                scores["values"]["position_rmse"],
                mean=mean_skill,
                low=mean_skill - 0.1,
                high=mean_skill + 0.1,
            )
        verified = None
        if place % 3 == 0:
            verified = Verification(scores=(HASH,), lagbench="0.2.0", date=DAY)
        cost = None
        if place % 7 != 6:
            cost = _cost(error, rng)
        seed_count = 1
        if place % 2 == 0:
            seed_count = 3
        return BoardRow(
            entry=make_entry(name, place, split, size, cost),
            current=True,
            rank=None,
            tied=False,
            p=0.03125 * error,
            verified=verified,
            skill=skill_value,
            against_classical=None,
            solver=None,
            seed_means=(4e-3 * error,) * seed_count,
            pictures=pictures,
            residuals=tuple(residuals),
            **scores,
        )

    def value(
        self, name: str, error: float, is_still: bool, rng: np.random.Generator
    ) -> Value:
        """Return a metric of a method with a relative error."""
        means = {
            "vorticity_pearson": 1 - 0.03 * error,
            "stable_frames": 95 - 6 * error,
            "energy_ratio": 1 + 0.1 * error,
        }
        middle = means.get(name, 4e-3 * error)
        undefined = 0
        if name == "vorticity_pearson" and error > 4:
            undefined = 3
        if is_still and "pearson" in name:
            middle = np.nan
            undefined = 90
        per_scenario = middle * (0.7 + 0.6 * rng.random(self.scenarios))
        mean = float(np.mean(per_scenario))
        spread = 0.2 * abs(middle)
        std = np.nan
        if rng.random() < 0.5:
            std = 0.01 * abs(middle)
        marked: tuple[int, ...] = ()
        if METRICS[name].per_frame:
            marked = self.marked
        return Value(
            mean=mean,
            std=std,
            low=mean - spread,
            high=mean + spread,
            per_scenario=tuple(per_scenario.tolist()),
            at=dict.fromkeys(marked, middle),
            undefined=undefined,
        )

    def curve(
        self, metric: str, error: float, is_still: bool, rng: np.random.Generator
    ) -> Curve:
        """Return the curve of a metric of a method with a relative error."""
        share = self.share
        frame_count = len(share)
        wobble = 1 + 0.05 * np.cumsum(rng.random(frame_count) - 0.5)
        if metric == "vorticity_pearson":
            mean = np.exp(-0.1 * error * share) * wobble.clip(0.9, 1.0)
            if is_still:
                mean = np.full(frame_count, np.nan)
            low = mean - 0.1 * share
            high = np.minimum(1.0, mean + 0.05 * share)
        else:
            mean = 2e-3 * error * (0.02 + share) * wobble
            if metric == "energy_ratio":
                mean = 1 + 0.03 * error * share * np.sin(9 * share)
                if is_still:
                    mean = np.zeros(frame_count)
            low = 0.7 * mean
            high = 1.4 * mean
        return Curve(frames=self.frames, mean=mean, low=low, high=high)

    def pictures(self, *, strength: float, noise: float) -> Pictures:
        """Return maps and a film of four eddies, or of a falling, turning block."""
        film_frames = np.linspace(self.frames[0], self.frames[-1], 45).astype(int)
        axis = np.linspace(0, 2 * np.pi, self.nodes)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        map_rng = np.random.Generator(np.random.PCG64(self.seed))
        eddies = []
        for frame in self.marked:
            eddies.append(_eddies(x, y, frame, strength, noise, map_rng))
        maps = np.stack(eddies).astype(np.float32)
        maps[:, [0, 1, -2, -1]] = np.nan
        maps[:, :, [0, 1, -2, -1]] = np.nan
        top = float(np.nanmax(np.abs(maps))) or 1.0

        film_rng = np.random.Generator(np.random.PCG64(self.seed))
        film = _film(self.kind, len(film_frames), strength, noise, film_rng)
        material = np.zeros(FILM_PARTICLES)
        if self.kind == "free":
            material = np.arange(FILM_PARTICLES) % 4
        return Pictures(
            scenario=54,
            map_frames=self.marked,
            vorticity=maps,
            histograms=tuple(_histogram(one_map, top) for one_map in maps),
            film_frames=tuple(film_frames.tolist()),
            material=material.astype(np.int8),
            film=film.astype(np.float32),
        )


def make_entry(
    name: str, place: int, split: str, size: str, cost: EntryCost | None
) -> Entry:
    """Return an entry that uses every key somewhere among the places."""
    seeds: list[int | None] = [None]
    if place % 2 == 0:
        seeds = [0, 1, 2]
    hashes = [f"{number}f" * 32 for number in range(len(seeds))]
    method = name.lower().replace("+", "-").replace(" ", "-")
    all_authors = ("Ada Byron", "Émilie du Châtelet", "Osborne Reynolds")
    author_count = 1 + len(name) % 3
    command = (
        f"lagbench train --baseline {method} --split cavity --seed 0\n"
        "lagbench predict --checkpoint runs/cavity/full/checkpoint.safetensors -o "
        "predictions.nc"
    )
    budget = EntryBudget(
        track="equal compute",
        windows=40_000 * (place + 1),
        epochs=1.5,
        cpu_hours=0.25,
    )
    return Entry(
        format=2,
        split=split,
        size=size,
        method=method,
        name=name,
        authors=all_authors[:author_count],
        affiliation="University of Examples",
        licence="MIT",
        code="https://example.org/code",
        paper="https://example.org/paper" if place % 3 == 0 else None,
        weights="https://example.org/weights" if place % 4 == 0 else None,
        date=datetime.date(2026, 1 + len(name) % 12, 14),
        notes="Weights of the best of three seeds.",
        training="48 train scenarios, 20000 steps, batch 2, bf16",
        budget=budget,
        parameters=int(1.6e6 * (1 + place**2)),
        hardware="NVIDIA H200, 1.2 h",
        command=command,
        dataset=DataSet(version="1.0.0", sha256="ab12" * 16),
        predictions=_predictions(seeds, hashes),
        cost=cost,
        score=_score_block(hashes, place),
    )


def _predictions(
    seeds: Sequence[int | None], hashes: Sequence[str]
) -> tuple[Prediction, ...]:
    """Return the predictions of the seeds."""
    predictions = []
    for number, (seed, sha256) in enumerate(zip(seeds, hashes, strict=True)):
        prediction = Prediction(
            seed=seed,
            sha256=sha256,
            url=f"https://example.org/{number}.nc",
            bytes=21_500_000,
        )
        predictions.append(prediction)
    return tuple(predictions)


def _score_block(hashes: Sequence[str], place: int) -> ScoreBlock:
    """Return the scored files, with the flags and the divergence of a place."""
    flags = {
        4: EntryFlag(name="physics", reasons=("14 times the truth's kinetic energy",)),
        6: EntryFlag(
            name="copy_suspect", reasons=("the error drops within one frame",)
        ),
    }
    outside_box = EntryFlag(
        name="in_domain", reasons=("41 positions lie outside the box",), share=0.059
    )
    files = []
    for number, sha256 in enumerate(hashes):
        diverged_at = {}
        if place == 5 and number == 0:
            diverged_at = {54: 7, 55: 9}
        file = ScoredFile(
            sha256=sha256,
            predictions_sha256=sha256,
            flags=(flags[place],) if place in flags else (),
            warnings=(outside_box,) if place == 3 else (),
            diverged_at=diverged_at,
        )
        files.append(file)
    return ScoreBlock(
        lagbench="0.1.0",
        dataset_sha256="ab12" * 16,
        ranking_metric="vorticity_rmse",
        files=tuple(files),
        metrics={},
    )


def _cost(error: float, rng: np.random.Generator) -> EntryCost:
    seconds = 0.08 / error**1.2 * (0.5 + rng.random())
    device = "AMD EPYC 9354, 2 cores"
    if rng.random() < 0.5:
        device = "NVIDIA H200"
    return EntryCost(
        seconds_per_frame=seconds,
        device=device,
        solver_seconds_per_frame=0.21,
    )


def _metrics(kind: str) -> list[str]:
    """Return the names of the metrics of a full box or of a free surface."""
    elastic = ("jelly", "snow", "rope", "shape", "connectivity", "sinkhorn")
    names = []
    for name in METRICS:
        is_elastic = any(word in name for word in elastic)
        is_for_kind = kind == "free" or not name.endswith("_liquid")
        if is_for_kind and not is_elastic:
            names.append(name)
    return names


def _eddies(
    x: Floats,
    y: Floats,
    frame: int,
    strength: float,
    noise: float,
    rng: np.random.Generator,
) -> Floats:
    """Return a vorticity map [1/frame], shape [x node, y node]."""
    phase = frame / 95
    large = np.sin(x + phase) * np.sin(y)
    small = np.sin(2 * x - phase) * np.sin(3 * y + phase)
    smooth = large + 0.4 * small
    wave = np.sin(3 * x + 2 * phase) * np.sin(2 * y)
    rough = wave + 0.5 * (rng.random(x.shape) - 0.5)
    return 0.06 * (strength * smooth + noise * phase * rough)


def _film(
    kind: str, frames: int, strength: float, noise: float, rng: np.random.Generator
) -> Floats:
    """Return positions of shape [frame, particle, 2]."""
    if kind == "free":
        block = 0.35 * rng.random((FILM_PARTICLES, 2)) + [0.1, 0.45]
        time = np.linspace(0, 1, frames)[:, None, None]
        drift = time * [0.5 * strength, 0]
        fall = time**2 * [0, 0.9]
        spread = noise * time * (block - 0.3)
        return np.clip(block + drift - fall + spread, 0.05, 0.95)
    positions = [rng.random((FILM_PARTICLES, 2))]
    for _ in range(frames - 1):
        a, b = 2 * np.pi * positions[-1].T
        swirl_x = np.sin(a) * np.cos(b)
        swirl_y = -np.cos(a) * np.sin(b)
        step = 0.012 * strength * np.stack([swirl_x, swirl_y], axis=1)
        positions.append(np.clip(positions[-1] + step + 0.002 * noise, 0, 1))
    return 0.0625 + 0.875 * np.stack(positions)


def _histogram(field: NDArray[np.floating], top: float) -> Histogram:
    values = field[np.isfinite(field)]
    counts, _ = np.histogram(values, bins=64, range=(-top, top))
    shares = counts / max(1, counts.sum())
    return Histogram(low=-top, high=top, shares=shares)
