"""Forge a leaderboard as one does who knows how: every hash, aggregate and digest made anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
from board_bench import BoardBench

from lagbench.board.seeds import combine, summarise
from lagbench.board.stored import read_stored
from lagbench.metrics import Tally
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import SUBMISSION
from lagbench.scoring.score_file import write_statistics

SCORES = "scores/cavity/tiny"


def forge(bench: BoardBench, method: str, change: Callable[[Any], object] | None = None) -> Path:
    """Change the score file of an entry, then form block and seal from it as the scorer would."""
    path = bench.folder / SCORES / f"{method}.nc"
    if change is not None:
        with netCDF4.Dataset(path, "r+") as file:
            file.set_auto_maskandscale(False)
            file["preview"].set_auto_maskandscale(False)
            change(file)
    metrics = summarise(combine([read_stored(path).scores]))
    plain = {name: summary.model_dump() for name, summary in metrics.items()}
    bench.edit(method, lambda held: held["score"].update(metrics=plain))
    bench.reseal(method)
    return path


def row_of(file: Any, statistic: str) -> int:
    """Return where a statistic stands in a score file."""
    return int(file.statistics.split().index(statistic))


def scale(statistic: str, factor: float) -> Callable[[Any], object]:
    """Return a change that multiplies a statistic."""

    def change(file: Any) -> None:
        row = row_of(file, statistic)
        file["value"][row] = factor * file["value"][row]

    return change


def rename(statistic: str) -> Callable[[Any], object]:
    """Return a change that leaves a statistic out by giving its row another name."""

    def change(file: Any) -> None:
        file.statistics = file.statistics.replace(statistic, "renamed")

    return change


def unmeasure(statistic: str, frames: slice) -> Callable[[Any], object]:
    """Return a change that says a statistic was not measured at some frames of a scenario."""

    def change(file: Any) -> None:
        file["measured"][row_of(file, statistic), 0, frames] = 0

    return change


def undefine(statistic: str, frames: slice) -> Callable[[Any], object]:
    """Return a change that says a statistic has no value at some frames of a scenario."""

    def change(file: Any) -> None:
        file["value"][row_of(file, statistic), 0, frames] = np.nan

    return change


def repaint(side: int, name: str = "film") -> Callable[[Any], object]:
    """Return a change that moves a picture of the truth (0) or of the prediction (1)."""

    def change(file: Any) -> None:
        held = file["preview"][name][...]
        held[side] = np.clip(held[side].astype(np.int64) + 500, 0, 60_000).astype(np.uint16)
        file["preview"][name][...] = held

    return change


def rewrite(path: Path, card: ScoreCard, change: Callable[[Tally], Tally]) -> None:
    """Write a score file from a card whose tallies are changed."""
    held: Mapping[int, Tally] = {i: change(tally) for i, tally in card.tallies[SUBMISSION].items()}
    write_statistics(replace(card, tallies={SUBMISSION: held}), path)


def with_statistic(name: str) -> Callable[[Tally], Tally]:
    """Return a change that adds a perfect statistic."""

    def change(tally: Tally) -> Tally:
        def more(array: Any, value: int) -> Any:
            return np.concatenate([array, np.full((1, len(tally.frames)), value, array.dtype)])

        parts = more(tally.total, 0), more(tally.weight, 1), more(tally.undefined, 0)
        return Tally((*tally.names, name), tally.frames, *parts)

    return change


def shorter(tally: Tally) -> Tally:
    """Return a tally without the last two frames."""
    parts = (array[:, :-2] for array in (tally.total, tally.weight, tally.undefined))
    return Tally(tally.names, tally.frames[:-2], *parts)
