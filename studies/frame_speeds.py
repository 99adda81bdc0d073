"""Print how fast models are beside the simulator that made the data.

    python -m studies.frame_speeds [--board leaderboard]

A speed-up is the time of the simulator for a frame over that of a model, both on one
core and measured in one run (``leaderboard/verified.yaml``). At 2 the model is twice as
fast, at 0.5 half as fast. A row has the least and the greatest one of the active
entries of a kind of model.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from lagbench.board.entry import Entry, Status
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.board.verified import read_verified, verification_of
from lagbench.errors import LagbenchError
from lagbench.figures.tables import markdown
from lagbench.references.predictor import Kind

from .thesis.published import OPERATORS
from .thesis.split_results import BOARD

AVERAGED = "-averaged"
"""End of the id of an entry that averages predictions over mirror images."""

README_NETWORK = "readme-network"
"""Method of the entry that the program of README.md trains."""


def kind_of_model(entry: Entry) -> str:
    """Return the kind of model that an entry is listed under."""
    if entry.kind is Kind.HYBRID:
        return "hybrid"
    if entry.method == README_NETWORK:
        return "small grid network"
    family, *_ = entry.method.split("-")
    if family in OPERATORS:
        return "graph network"
    if family == "neuralmpm" and entry.method.endswith(AVERAGED):
        return "NeuralMPM, mirror-averaged"
    if family == "neuralmpm":
        return "NeuralMPM"
    return family.upper()


def read_speed_ups(folder: Folder) -> dict[tuple[str, str], list[float]]:
    """Return the measured speed-ups of active entries by size and kind of model."""
    verified = read_verified(folder)
    speed_ups: dict[tuple[str, str], list[float]] = {}
    for path in folder.entries():
        entry = read_entry(folder.path / path)
        verification = verification_of(entry, verified)
        if entry.status is not Status.ACTIVE or verification is None:
            continue
        cost = verification.cost
        if cost is None or cost.speed_up is None:
            continue
        key = (entry.size, kind_of_model(entry))
        speed_ups.setdefault(key, []).append(cost.speed_up)
    return speed_ups


def table(speed_ups: Mapping[tuple[str, str], Sequence[float]]) -> str:
    """Return a row per size and kind of model, as Markdown."""
    heads = ("size", "kind of model", "entries", "least speed-up", "greatest speed-up")
    rows = []
    for size, kind in sorted(speed_ups):
        values = speed_ups[size, kind]
        least = f"{min(values):.2g}"
        greatest = f"{max(values):.2g}"
        rows.append((size, kind, len(values), least, greatest))
    return markdown(heads, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.frame_speeds",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--board", type=Path, default=BOARD)
    options = parser.parse_args(arguments)
    folder = Folder(options.board)
    try:
        folder.require()
        speed_ups = read_speed_ups(folder)
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{table(speed_ups)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
