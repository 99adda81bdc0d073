"""The commands design list, design info and design judge."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from statistics import mean
from typing import Any

from lagbench.design.judge import judge, scale_error
from lagbench.design.tasks import load_task, task_names
from lagbench.work.machine import worker_count

from .options import JsonFlag, QuietFlag, WorkersOption
from .output import print_json, print_line, print_table, progress_bar


def list_command(*, as_json: JsonFlag = False) -> None:
    """List all design tasks."""
    tasks = [load_task(name) for name in task_names()]
    if as_json:
        lines = [{"task": task.name, "goal": task.goal} for task in tasks]
        print_json({"tasks": lines})
        return
    rows = [(task.name, len(task.parameters), task.goal) for task in tasks]
    print_table("Design tasks", ("task", "parameters", "goal"), rows)


def info_command(task: str, *, as_json: JsonFlag = False) -> None:
    """Show the goal of a design task, and its parameters with their bounds.

    Args:
        task: Name of the task, as in pour-03.
    """
    chosen = load_task(task)
    if as_json:
        print_json(
            {
                "task": chosen.name,
                "split": chosen.split,
                "goal": chosen.goal,
                "unit": chosen.unit,
                "frames": chosen.frames,
                "parameters": [asdict(each) for each in chosen.parameters],
            }
        )
        return
    print_line(f"{chosen.name} ({chosen.split} mini): {chosen.goal}")
    rows = []
    for each in chosen.parameters:
        rows.append((each.name, each.unit, f"{each.low:g}", f"{each.high:g}"))
    print_table("Parameters", ("parameter", "unit", "least", "greatest"), rows)


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
        results: File for the entry with its verdicts; an interrupted call goes on
            from it.
    """
    with progress_bar(quiet=quiet, unit="tasks") as progress:
        verdicts = judge(
            entry, workers=worker_count(workers), results=results, progress=progress
        )
    lines: list[dict[str, Any]] = []
    rows = []
    for name, verdict in verdicts.items():
        score = scale_error(name, verdict.error)
        lines.append({"task": name, "score": score, **verdict.model_dump()})
        error = "failed" if verdict.error is None else f"{verdict.error:.4g}"
        score_text = "–" if score is None else f"{score:.3f}"
        rows.append((name, error, score_text, verdict.sha256[:16]))
    scores = [line["score"] for line in lines if line["score"] is not None]
    mean_score = mean(scores) if scores else None
    if as_json:
        print_json({"mean_score": mean_score, "verdicts": lines})
        return
    print_table("Verdicts", ("task", "error", "score", "sha256"), rows)
    if mean_score is not None and not quiet:
        print_line(f"mean score of {len(scores)} tasks: {mean_score:.3f}")
