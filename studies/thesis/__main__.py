"""Make the tables and figures of the thesis at one size: train, predict, score, draw.

    python -m studies.thesis --size mini --root DATA --runs runs [--only NAMES]

Complete runs are kept, so an interrupted command can be repeated. It writes Markdown,
CSV and PNG to ``RUNS/reproduce/<size>/`` and prints the Markdown.

``--list`` lists tables and figures, ``--dry-run`` says what would be trained.
``--no-training`` shows complete runs, results in the folder ``--studies`` and
committed weights, whose predictions it makes.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lagbench.data.local import resolve_root, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, load
from lagbench.errors import (
    LagbenchError,
    UsageError,
    WorkFailedError,
    suggest_name,
)
from lagbench.work.machine import worker_count

from .catalogue import ITEMS
from .formatting import number
from .items import ThesisItem, write_sheet
from .plan import TABLES, Plan
from .roster import EXPECTED, ROSTER, RosterModel, label
from .runs import (
    Run,
    complain,
    describe_run,
    make_runs,
    make_studies,
    note,
    score_committed,
)
from .split_results import WEIGHTS, format_budget


def main(
    arguments: Sequence[str] | None = None, *, registry: Registry | None = None
) -> int:
    """Make the tables and figures that the arguments name; return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        items = _chosen_items(options.only, options.split)
        if options.list:
            _list_items(items)
            return 0

        (registry or load()).size("cavity", options.size)  # refuses unknown sizes
        default_output = options.runs / "reproduce" / options.size
        plan = Plan(
            size=options.size,
            root=resolve_root(options.root),
            runs=options.runs,
            output=options.output or default_output,
            weights=options.weights,
            studies=options.studies,
            seeds=_parse_seeds(options.seeds),
            recipe=options.recipe,
            settings=tuple(options.set),
            device=options.device,
            threads=options.threads,
            registry=registry,
        )
        workers = worker_count(options.workers, default=1)
        if options.dry_run:
            return rehearse(plan, items, split=options.split)
        if options.no_training:
            workers = 0
        return reproduce(plan, items, split=options.split, workers=workers)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command goes on where it stopped\n")
        return 130  # as every command of the package
    except LagbenchError as error:
        complain(error)
        return error.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m studies.thesis",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--size", default="mini", help="tiny, mini or full")
    add(
        "--only",
        metavar="NAMES",
        help="tables and figures, as in table_5_4,fig_5_5; all by default",
    )
    add("--split", help="only items about this split, and all models meant for it")
    add("--root", type=Path, help="folder of all data sets")
    add("--runs", type=Path, default=Path("runs"), help="folder of runs")
    add("--output", "-o", type=Path, help="RUNS/reproduce/<size> by default")
    add("--weights", type=Path, default=WEIGHTS, help="folder of committed weights")
    add(
        "--studies",
        type=Path,
        help="folder of results without an entry, beside those of --runs",
    )
    add("--seeds", default="0", help="seeds of every training, as in 0,1")
    add("--recipe", metavar="NAME", help="variant of the recipes, as in short")
    add(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change every recipe; repeatable",
    )
    add("--device", default="auto", help="cpu, cuda or auto")
    add(
        "--threads",
        type=int,
        help="CPU threads of a training; one per core by default, one with --workers",
    )
    add(
        "--workers",
        type=int,
        help="trainings side by side, on one GPU or many cores; 1 by default",
    )
    add(
        "--no-training",
        action="store_true",
        help="train nothing: show complete runs and committed results",
    )
    add(
        "--dry-run", action="store_true", help="make nothing, say what would be trained"
    )
    add("--list", action="store_true", help="list tables and figures with their models")
    return parser


def _list_items(items: Sequence[ThesisItem]) -> None:
    """Print the name, title and needed models of items."""
    for item in items:
        needs = []
        for split, names in item.needs.items():
            if names:
                needs.append(f"{split}: {' '.join(names)}")
        if item.studies:
            needs.append(f"trainings of {item.studies}")
        all_needs = "; ".join(needs) or "no training"
        _print(f"{item.name:14} {item.title}; needs {all_needs}")


def reproduce(
    plan: Plan,
    items: Sequence[ThesisItem],
    *,
    split: str | None = None,
    workers: int = 1,
) -> int:
    """Make items, ``workers`` trainings side by side; 0 workers train nothing.

    An item that fails is reported, and the others are made.

    Returns:
        0, or the exit code of the last error.
    """
    training_code = 0
    if workers:
        runs = _needed_runs(plan, items, split)
        training_code = make_runs(plan, runs, workers=workers)
        preparations = _study_jobs(plan, items)
    else:
        preparations = _committed_jobs(plan, items, split)

    jobs = [*preparations]
    for item in items:
        jobs.append((item.name, partial(_draw_item, plan, item)))
    code = _run_each(jobs) or training_code
    for path in plan.stale:
        note(f"{path}: scores of another version of the data; left out")
    return code


Job = tuple[str, Callable[[], None]]
"""Name for messages, and function."""


def _study_jobs(plan: Plan, items: Sequence[ThesisItem]) -> Iterator[Job]:
    """Yield the trainings of MLPs that items need."""
    for study in _needed_studies(plan, items):
        yield "", partial(_make_study, plan, study)


def _make_study(plan: Plan, study: str) -> None:
    note(f"studies of {study}")
    make_studies(plan, study)


def _committed_jobs(
    plan: Plan, items: Sequence[ThesisItem], split: str | None
) -> Iterator[Job]:
    """Yield the runs of committed weights that items need."""
    for where, name in _needed_models(items, split):
        yield "", partial(score_committed, plan, where, ROSTER[name])


def _draw_item(plan: Plan, item: ThesisItem) -> None:
    sheet = item.draw(plan, item)
    text = write_sheet(sheet, plan.output, name=item.name, head=_head(plan, item))
    _print(text)


def rehearse(
    plan: Plan, items: Sequence[ThesisItem], *, split: str | None = None
) -> int:
    """Say what :func:`reproduce` would train, predict and score.

    Missing data are named with the command that makes them.

    Returns:
        0, or the exit code of the last error.
    """
    runs = _needed_runs(plan, items, split)
    for where in dict.fromkeys(run_split for run_split, _, _ in runs):
        tier = plan.tier(where)
        if read_manifest(plan.root, tier.split, tier.name, tier.major) is None:
            fix = suggest_repair(tier, root=plan.root)
            note(f"{tier.split} {tier.name} is not there yet: {fix}")

    jobs: list[Job] = []
    for where, model, seed in runs:
        jobs.append(("", partial(_print_outlook, plan, where, model=model, seed=seed)))
    code = _run_each(jobs)
    for study in _needed_studies(plan, items):
        _print(f"studies of {study}")
    return code


def _print_outlook(plan: Plan, split: str, *, model: RosterModel, seed: int) -> None:
    outlook = describe_run(plan, split, model=model, seed=seed)
    _print(f"{split} {plan.size} {model.name}-{seed}: {outlook}")


def _run_each(jobs: Iterable[Job]) -> int:
    """Run jobs one after the other, and report those that fail.

    Returns:
        0, or the exit code of the last error.
    """
    code = 0
    for name, job in jobs:
        try:
            job()
        except LagbenchError as error:
            complain(error, name)
            code = error.exit_code
    return code


def _needed_models(
    items: Sequence[ThesisItem], split: str | None
) -> list[tuple[str, str]]:
    """Return split and name of every model that items need.

    With a split, all models that it is expected to have are added.
    """
    needed: dict[tuple[str, str], None] = {}  # a set that keeps its order
    for item in items:
        for needed_split, names in item.needs.items():
            for name in names:
                needed[needed_split, name] = None
    if split:
        for name in EXPECTED.get(split, ()):
            needed[split, name] = None
    return list(needed)


def _needed_runs(
    plan: Plan, items: Sequence[ThesisItem], split: str | None
) -> list[Run]:
    """Return split, model and seed of every run that items need, seed by seed.

    Models without a recipe are left out, with a note. So are models without the variant
    of the recipes: their plain recipe may take days where the variant takes minutes. A
    variant that no model has is a mistake of the user, which the training reports.
    """
    needed = _needed_models(items, split)
    with_recipe = []
    for where, name in needed:
        if plan.has_recipe(where, ROSTER[name]):
            with_recipe.append((where, name))
    if with_recipe:
        for where, name in needed:
            if (where, name) not in with_recipe:
                model = ROSTER[name]
                can_be_made = replace(plan, recipe=None).has_recipe(where, model)
                what = f"{where} {plan.size} {name}"
                _leave_out(what, plan.recipe or model.recipe, can_be_made=can_be_made)

    runs = []
    for seed in plan.seeds:
        for where, name in with_recipe or needed:
            runs.append((where, ROSTER[name], seed))
    return runs


def _needed_studies(plan: Plan, items: Sequence[ThesisItem]) -> Iterator[str]:
    """Yield the tables of MLPs to train.

    All are left out where MLPs do not have the variant of the recipes. At full their
    rows have recipes of their own, which have no variant.
    """
    for study in dict.fromkeys(item.studies for item in items if item.studies):
        _, split = TABLES[study]
        has_variant = plan.has_recipe(split, ROSTER["mlp"])
        has_own_recipes = plan.size == "full"
        if has_variant and not (plan.recipe and has_own_recipes):
            yield study
        else:
            can_be_made = plan.recipe is not None
            _leave_out(f"studies of {study}", plan.recipe, can_be_made=can_be_made)


def _leave_out(what: str, variant: str | None, *, can_be_made: bool) -> None:
    """Report what is left out.

    Args:
        what: a run, or a table of MLPs.
        variant: the variant of the recipes that it does not have; None for the size's
            own recipe.
        can_be_made: whether it is made without the option ``--recipe``.
    """
    text = f"{what}: left out, it has no recipe"
    if variant is not None:
        text += f" {variant!r}"
    if can_be_made:
        text += "; without --recipe it is made"
    note(text)


def _head(plan: Plan, item: ThesisItem) -> str:
    """Return the title of an item and its runs: size, budget, seeds, hours."""
    title = f"# {item.name.replace('_', ' ')}: {item.title}"
    lines = [title, "", f"Size {plan.size}."]
    for split, names in item.needs.items():
        for name in names:
            methods = plan.results(split).methods
            if name not in methods:
                lines.append(f"- {split}, {label(name)}: no run")
                continue
            method = methods[name]
            seeds = ", ".join(str(training.seed) for training in method.trainings)
            budget = format_budget(method.trainings[0].record)
            hours = number(method.hours_per_seed)
            lines.append(
                f"- {split}, {label(name)}: seeds {seeds}; "
                f"{budget} steps x windows; {hours} CPU hours per seed"
            )
    return "\n".join(lines)


def _chosen_items(only: str | None, split: str | None) -> list[ThesisItem]:
    """Return the items that the options name."""
    if split is not None and split not in EXPECTED:
        raise UsageError(
            f"no split {split!r}", where="--split", fix=suggest_name(split, EXPECTED)
        )
    names = only.split(",") if only else list(ITEMS)
    items = []
    for name in names:
        if name not in ITEMS:
            raise UsageError(
                f"no table or figure {name!r}",
                where="--only",
                fix=suggest_name(name, ITEMS),
            )
        if split is None or split in ITEMS[name].needs:
            items.append(ITEMS[name])
    return items


def _parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text, as in 0,1."""
    try:
        seeds = tuple(int(part) for part in text.split(","))
    except ValueError:
        seeds = ()
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise UsageError(
            "cannot understand the seeds",
            where="--seeds",
            expected="whole numbers from 0, each once, as in 0,1",
            got=text,
            fix="give them as in --seeds 0,1",
        )
    return seeds


def _print(text: str) -> None:
    """Print a text; if the reader has left, as ``head`` does, the work goes on.

    Raises:
        WorkFailedError: the text cannot be written, as on a full disk.
    """
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except OSError as error:
        # What is still in the buffer goes nowhere; else Python would complain of it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return
        raise WorkFailedError(
            "cannot print the results",
            where="standard output",
            expected="a place that can be written to",
            got=error,
            fix="free disk space, or send the output elsewhere",
        ) from error


if __name__ == "__main__":
    raise SystemExit(main())
