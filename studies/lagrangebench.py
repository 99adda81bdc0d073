"""Print errors of our entries beside published errors of LagrangeBench's models.

    python -m studies.lagrangebench [--board leaderboard]

The errors are defined as LagrangeBench defines them
(:mod:`lagbench.metrics.lagrangebench`), but the data are others: other solvers, speeds,
lengths and frame intervals. So the numbers say of which size such errors are, not which
model is better. Committed files suffice: the entries and their score files, and the
shipped scores of the reference predictors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np

from lagbench.board.entry import Entry, Status
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder, entry_path
from lagbench.data.registry import Size, load
from lagbench.errors import LagbenchError
from lagbench.figures.tables import markdown
from lagbench.metrics.aggregate import score
from lagbench.metrics.lagrangebench import mean_of_every_tenth
from lagbench.metrics.metric import FirstFrames
from lagbench.metrics.table import METRICS
from lagbench.references.shipped import shipped
from lagbench.scoring.score_file import read_statistics

SIZE = "mini"  # of our data sets
FRAMES = 20  # predicted frames of the published errors

HEAD = ("flow", "data", "model", "MSE_20", "MSE of E_kin")


@dataclass(frozen=True)
class PublishedRow:
    """Errors of a model on a data set of LagrangeBench."""

    data: str
    model: str
    mse_20: str
    e_kin_mse: str


@dataclass(frozen=True, kw_only=True)
class ComparedFlow:
    """A flow that both benchmarks have."""

    name: str
    split: str
    methods: tuple[str, ...]  # our entries
    published: tuple[PublishedRow, ...]


def _published(
    data: str, gns: Sequence[str], segnn: Sequence[str]
) -> tuple[PublishedRow, PublishedRow]:
    return (
        PublishedRow(data, "GNS-10-128", *gns),
        PublishedRow(data, "SEGNN-10-64", *segnn),
    )


FLOWS = (
    ComparedFlow(
        name="decaying vortices",
        split="decaying-vortices",
        methods=("neuralmpm", "gns", "hybrid-projection"),
        published=_published("2D TGV", ("5.9e-6", "4.9e-7"), ("4.4e-6", "5.0e-7")),
    ),
    ComparedFlow(
        name="reverse Poiseuille",
        split="poiseuille",
        methods=("neuralmpm", "gns", "hybrid-projection"),
        published=_published("2D RPF", ("4.0e-6", "2.7e-5"), ("3.4e-6", "1.4e-5")),
    ),
    ComparedFlow(
        name="lid-driven cavity",
        split="cavity",
        methods=("neuralmpm", "gns-pushforward", "hybrid-projection"),
        published=_published("2D LDC", ("1.5e-5", "6.1e-7"), ("2.1e-5", "1.6e-5")),
    ),
    ComparedFlow(
        name="dam break and splash",
        split="fluid",
        methods=("neuralmpm", "gns-free-flight", "hybrid-coarse"),
        published=_published("2D DAM", ("3.1e-5", "1.1e-4"), ("4.1e-5", "5.2e-4")),
    ),
    ComparedFlow(
        name="decaying vortices in a cube",
        split="curl-noise-3d",
        methods=("neuralmpm", "hybrid-projection"),
        published=_published("3D TGV", ("5.8e-3", "4.8e-2"), ("5.0e-3", "3.9e-2")),
    ),
    ComparedFlow(
        name="lid-driven cavity in a cube",
        split="cavity-3d",
        methods=("neuralmpm", "hybrid-projection"),
        published=_published("3D LDC", ("4.1e-5", "1.9e-8"), ("4.1e-5", "2.5e-8")),
    ),
)
"""The published errors are those of the table of pretrained models in the README of
https://github.com/tumaer/lagrangebench: 20 steps, the whole test split."""


def table(board: Path) -> str:
    """Return the table of all flows, in Markdown.

    Raises:
        UnreadableFileError: an entry or a score file is missing or damaged.
    """
    rows: list[tuple[str, ...]] = []
    registry = load()
    for flow in FLOWS:
        size = registry.size(flow.split, SIZE)
        rows.extend(_our_rows(flow, size, Folder(board)))
        for row in flow.published:
            rows.append((flow.name, row.data, row.model, row.mse_20, row.e_kin_mse))
    return markdown(HEAD, rows)


def _our_rows(
    flow: ComparedFlow, size: Size, folder: Folder
) -> Iterator[tuple[str, ...]]:
    data = f"{flow.split} {SIZE}"
    references = shipped(size) or {}
    if "constant-velocity" in references:
        scores = references["constant-velocity"].scores
        rmse_20 = scores["position_rmse_20"].values
        mse_20 = float(np.mean(rmse_20**2))
        # the shipped file has no kinetic energy of each frame
        yield flow.name, data, "constant-velocity", _number(mse_20), ""
    for method in flow.methods:
        entry = read_entry(folder.path / entry_path((flow.split, SIZE, method)))
        if entry.status is not Status.ACTIVE:
            continue
        errors = errors_of(entry, folder, size)
        yield (
            flow.name,
            data,
            entry.name,
            _number(errors["position_mse_20"]),
            _number(errors["e_kin_mse"]),
        )


def errors_of(entry: Entry, folder: Folder, size: Size) -> Mapping[str, float]:
    """Return the errors of an entry by name, as LagrangeBench defines them.

    They are means over scenarios and seeds, of the first 20 predicted frames:
    ``position_mse_20`` [length^2] and ``e_kin_mse`` [(length^(d+2)/s^2)^2].
    LagrangeBench has velocities per second, and the mass of a particle is its volume.

    Raises:
        UnreadableFileError: a score file is missing or damaged.
    """
    energy_unit = size.value("density") * size.frame_interval**2
    factors = {"position_mse_20": 1.0, "e_kin_mse": 1.0 / energy_unit**2}
    first_frames = FirstFrames(FRAMES, mean_of_every_tenth)
    e_kin_mse = replace(METRICS["e_kin_mse"], over_frames=first_frames)
    metrics = {**METRICS, "e_kin_mse": e_kin_mse}
    errors = {}
    for name, factor in factors.items():
        of_seeds = []
        for path in entry.score_paths:
            statistics = read_statistics(folder.path / path)
            measured = score(metrics[name], statistics.tallies)
            if measured is not None:
                of_seeds.append(measured.mean)
        errors[name] = factor * fmean(of_seeds)
    return errors


def _number(value: float) -> str:
    return f"{value:.1e}".replace("e-0", "e-")


def main(words: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--board", type=Path, default=Path("leaderboard"))
    options = parser.parse_args(words)
    try:
        text = table(options.board)
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{text}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
