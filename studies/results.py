"""Write docs/results.md and results.csv beside it from the leaderboard.

    python -m studies.results [-o docs/results.md] [--board leaderboard] [--check]

No data set is read. The same board gives the same bytes; ``--check`` writes nothing and
fails where a file is stale.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lagbench.figures.tables import escape

Json = Any
MODEL_KINDS = ("learned", "hybrid")
CLASSICAL_KINDS = ("classical", "calibrated")

PAGE = """\
# Results

On this page you find the best network of each data set beside the best naive predictor
and the best row of the classical side (classical solvers, and solvers with fitted
constants). The table
[results.csv](results.csv) has score, skill, cost and training of every method.

`python -m studies.results` writes both files from the [leaderboard](submitting.md).

## Does learning pay?

{finding}

## Best models

Scores are errors ([metrics](scoring.md#metrics)), so lower is better. The brackets
contain the 95 % interval. The time is the processor time of one frame on one core.

{table}
"""


def read_board(board: Path) -> Json:
    """Return the conclusion of a leaderboard, and the rows of every data set."""
    command = [sys.executable, "-m", "lagbench", "leaderboard", "show", "--json"]
    command += ["--board", str(board)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout)


def _mean(statistic: Json) -> object:
    return statistic["mean"] if isinstance(statistic, Mapping) else statistic


def ranking_row(tab: Json, row: Json) -> dict[str, object]:
    """Return score, skill, cost and training of a method."""
    score = row["metrics"][tab["ranking_metric"]]
    speedup = row.get("speedup") or {}
    budget = row.get("budget") or {}
    return {
        "split": tab["split"],
        "size": tab["size"],
        "method": row["id"],
        "kind": row["kind"],
        "rank": row.get("rank"),
        "metric": tab["ranking_metric"],
        "score": score["mean"],
        "low": score["low"],
        "high": score["high"],
        "skill": _mean(row.get("skill")),
        "seconds_per_frame": row.get("seconds_per_frame"),
        "speedup": speedup.get("value"),
        "breakeven": row.get("breakeven"),
        "seeds": row.get("seeds"),
        "parameters": row.get("parameters"),
        "training_cpu_hours": budget.get("cpu_hours"),
        "training_steps": budget.get("steps"),
    }


def ranking_rows(tabs: Json) -> list[dict[str, object]]:
    """Return a row for each method of each data set, references last."""
    rows = []
    for tab in tabs:
        for row in [*tab["rows"], *tab["references"]]:
            rows.append(ranking_row(tab, row))
    return rows


def to_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows as CSV with a heading; nothing without rows."""
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def _best(rows: Sequence[Json], kinds: Sequence[str]) -> Json | None:
    scored = [row for row in rows if row["kind"] in kinds and row["score"] is not None]
    return min(scored, key=lambda row: row["score"], default=None)


def _cell(row: Json | None) -> str:
    """Return name, score with interval, and time of a method."""
    if row is None:
        return "-"
    text = f"{row['method']}: {row['score']:.3g}"
    if row["low"] is not None:
        text += f" ({row['low']:.3g} to {row['high']:.3g})"
    if row["seconds_per_frame"] is not None:
        text += f", {1000 * row['seconds_per_frame']:.3g} ms"
    return text


def summary_table(rows: Sequence[Json]) -> str:
    """Return a row for each data set: the best method of each kind."""
    by_place: dict[str, list[Json]] = {}
    for row in rows:
        by_place.setdefault(f"{row['split']} {row['size']}", []).append(row)
    lines = []
    for place, methods in by_place.items():
        model = _best(methods, MODEL_KINDS)
        speedup = "-"
        if model is not None and model["speedup"] is not None:
            speedup = f"{model['speedup']:.3g}"
        lines.append(
            (
                place,
                methods[0]["metric"],
                _cell(_best(methods, ("naive",))),
                _cell(_best(methods, CLASSICAL_KINDS)),
                _cell(model),
                model["kind"] if model else "-",
                speedup,
            )
        )
    heads = ("data set", "metric", "best naive", "best classical side", "best network")
    head, *others = [
        f"| {' | '.join(map(escape, cells))} |"
        for cells in ((*heads, "kind", "speedup"), *lines)
    ]
    return "\n".join([head, "| " + " | ".join(7 * ["---"]) + " |", *others])


def render(board: Json, page: Path) -> dict[Path, str]:
    """Return the texts of the page and of its table, by file."""
    rows = ranking_rows(board["tabs"])
    finding = " ".join(board["conclusion"])
    text = PAGE.format(finding=finding, table=summary_table(rows))
    return {
        page: text,
        page.with_suffix(".csv"): to_csv(rows),
    }


def main() -> int:
    """Write or check the files; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", "-o", type=Path, default=Path("docs/results.md"))
    parser.add_argument("--board", type=Path, default=Path("leaderboard"))
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    files = render(read_board(options.board), options.output)
    if not options.check:
        for path, text in files.items():
            path.write_text(text)
        return 0
    stale = []
    for path, text in files.items():
        if not path.is_file() or path.read_text() != text:
            stale.append(path)
            sys.stdout.write(f"{path}: stale; run python -m studies.results\n")
    return 1 if stale else 0


if __name__ == "__main__":
    raise SystemExit(main())
