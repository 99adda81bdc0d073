"""The commands design-list, design-info and design-judge."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from statistics import mean

from lagbench.design.judge import judge
from lagbench.design.tasks import load_task, task_names
from lagbench.figures.tables import Table

from .options import JsonFlag, QuietFlag, WorkersOption
from .output import print_json, print_line, print_tables


def list_command(*, as_json: JsonFlag = False) -> None:
    """List all design tasks."""
    tasks = [load_task(name) for name in task_names()]
    if as_json:
        print_json([{"task": task.name, "goal": task.goal} for task in tasks])
        return
    rows = []
    for task in tasks:
        count = str(len(task.parameters))
        rows.append((task.name, count, task.goal))
    columns = ("task", "parameters", "goal")
    print_tables([Table("Design tasks", columns, tuple(rows))])


def info_command(task: str, *, as_json: JsonFlag = False) -> None:
    """Show the goal of a design task, and its parameters with their bounds.

    Args:
        task: Name of the task, as in pour-03.
    """
    chosen = load_task(task)
    parameters = [asdict(parameter) for parameter in chosen.parameters]
    if as_json:
        print_json(
            {
                "task": chosen.name,
                "split": chosen.split,
                "goal": chosen.goal,
                "unit": chosen.unit,
                "frames": chosen.frames,
                "parameters": parameters,
            }
        )
        return
    print_line(f"{chosen.name} ({chosen.split} mini): {chosen.goal}")
    rows = []
    for each in chosen.parameters:
        rows.append((each.name, each.unit, f"{each.low:g}", f"{each.high:g}"))
    columns = ("parameter", "unit", "least", "greatest")
    print_tables([Table("Parameters", columns, tuple(rows))])


def judge_command(
    entry: Path,
    *,
    results: Path | None = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Simulate the parameters of an entry and measure what they reach.

    Args:
        entry: JSON file of an entry.
        results: JSON file of judgements; an interrupted call goes on from it.
    """
    judgements = judge(
        entry, workers=workers or 1, results=results, quiet=quiet or as_json
    )
    if as_json:
        lines = []
        for judgement in judgements:
            line = asdict(judgement)
            if math.isinf(judgement.error):
                line["error"] = None
            lines.append(line)
        print_json(lines)
        return
    rows = []
    for each in judgements:
        rows.append(
            (each.task, f"{each.error:.4g}", f"{each.score:.3f}", each.sha256[:16])
        )
    columns = ("task", "error", "score", "sha256")
    print_tables([Table("Judgements", columns, tuple(rows))])
    if judgements:
        average = mean(judgement.score for judgement in judgements)
        print_line(f"mean score of {len(judgements)} tasks: {average:.3f}")
