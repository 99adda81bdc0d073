"""Make the tables and figures of the thesis at one size: train, predict, score, draw.

    python -m lagbench.baselines.reproduce --size mini --root DATA --runs runs [--only table_5_4,fig_5_5]

What is there is not made again; interrupted, it goes on. Writes Markdown, CSV and PNG
to ``RUNS/reproduce/<size>/`` and prints the Markdown. ``--list`` says what there is,
``--dry-run`` what would be trained; ``--no-training`` shows what the runs that are
there allow, and what committed weights do, whose predictions are made on the spot, and
committed studies.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from lagbench.data.local import resolve_root, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, load
from lagbench.errors import LagbenchError, UsageError, suggest_name
from lagbench.work.pool import worker_count

from .catalogue import FIGURES
from .drawing import Figure, write_sheet
from .evidence import STUDIES, WEIGHTS, budget
from .plan import TABLES, Plan
from .runs import Run, complain, make_runs, make_studies, note, outlook, score_committed
from .thesis import EXPECTED, ROSTER, Model, label, number


def main(
    arguments: Sequence[str] | None = None, *, registry: Registry | None = None
) -> int:
    """Make what the arguments name; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m lagbench.baselines.reproduce",
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
    add(
        "--split",
        help="only what is about this split, and all models that are meant for it",
    )
    add("--root", type=Path, help="folder of all data sets")
    add("--runs", type=Path, default=Path("runs"), help="folder of runs")
    add("--output", "-o", type=Path, help="RUNS/reproduce/<size> by default")
    add("--weights", type=Path, default=WEIGHTS, help="folder of committed weights")
    add(
        "--studies",
        type=Path,
        default=STUDIES,
        help="folder of committed results that are no entries",
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
        help="train nothing: runs that are there, what is committed",
    )
    add(
        "--dry-run", action="store_true", help="make nothing, say what would be trained"
    )
    add(
        "--list",
        action="store_true",
        help="list tables and figures, and what they need",
    )
    given = parser.parse_args(arguments)
    try:
        figures = _chosen(given.only, given.split)
        if given.list:
            for figure in figures:
                needs = [
                    f"{split}: {' '.join(names)}"
                    for split, names in figure.needs.items()
                    if names
                ]
                needs += [f"trainings of {figure.studies}"] if figure.studies else []
                _say(
                    f"{figure.name:14} {figure.title}; needs "
                    f"{'; '.join(needs) or 'no training'}"
                )
            return 0
        (registry or load()).size("cavity", given.size)
        plan = Plan(
            size=given.size,
            root=resolve_root(given.root),
            runs=given.runs,
            output=given.output or given.runs / "reproduce" / given.size,
            weights=given.weights,
            studies=given.studies,
            seeds=_seeds(given.seeds),
            recipe=given.recipe,
            settings=tuple(given.set),
            device=given.device,
            threads=given.threads,
            registry=registry,
        )
        workers = worker_count(given.workers, default=1)
        if given.dry_run:
            return rehearse(plan, figures, split=given.split)
        return reproduce(
            plan,
            figures,
            split=given.split,
            workers=0 if given.no_training else workers,
        )
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command goes on where it stopped\n")
        return 130  # as every command of ours
    except LagbenchError as error:
        complain(error)
        return error.exit_code


def reproduce(
    plan: Plan, figures: Sequence[Figure], *, split: str | None = None, workers: int = 1
) -> int:
    """Make figures; what fails is said, and the others are made. Return 0, or the last
    error's code.

    ``workers`` trainings run side by side; with 0 there are none.
    """

    def draw(figure: Figure) -> None:
        _say(
            write_sheet(
                figure.draw(plan, figure), plan.output, figure.name, _head(plan, figure)
            )
        )

    def jobs() -> Iterator[tuple[str, Callable[[], None]]]:
        if workers:
            for study in _studies(plan, figures):
                note(f"studies of {study}")
                yield "", partial(make_studies, plan, study)
        else:
            for where, name in _wanted(figures, split):
                yield "", partial(score_committed, plan, where, ROSTER[name])
        yield from ((figure.name, partial(draw, figure)) for figure in figures)

    if workers:
        made = make_runs(plan, _runs(plan, figures, split), workers=workers)
    else:
        made = 0
    code = _each(jobs()) or made
    for path in plan.stale:
        note(f"{path}: scores of another version of the data; left out")
    return code


def rehearse(plan: Plan, figures: Sequence[Figure], *, split: str | None = None) -> int:
    """Say what :func:`reproduce` would train, predict and score; return 0, or the last
    error's code.

    Data that are not there are named with the command that makes them.
    """

    def say(where: str, model: Model, seed: int) -> None:
        _say(
            f"{where} {plan.size} {model.name}-{seed}: "
            f"{outlook(plan, where, model, seed)}"
        )

    runs = _runs(plan, figures, split)
    for tier in map(plan.tier, dict.fromkeys(where for where, _, _ in runs)):
        if read_manifest(plan.root, tier.split, tier.name, tier.major) is None:
            note(
                f"{tier.split} {tier.name} is not there yet: "
                f"{suggest_repair(tier, root=plan.root)}"
            )
    code = _each(("", partial(say, *run)) for run in runs)
    for study in _studies(plan, figures):
        _say(f"studies of {study}")
    return code


def _each(jobs: Iterable[tuple[str, Callable[[], None]]]) -> int:
    """Do named jobs one after the other; what fails is said. Return 0, or the last
    error's code.
    """
    code = 0
    for name, job in jobs:
        try:
            job()
        except LagbenchError as error:
            complain(error, name)
            code = error.exit_code
    return code


def _wanted(figures: Sequence[Figure], split: str | None) -> list[tuple[str, str]]:
    """Return split and name of every model that figures need, and of all that the
    roster has for a split.
    """
    wanted = {
        (where, name): None
        for figure in figures
        for where, names in figure.needs.items()
        for name in names
    }
    wanted |= {(split, name): None for name in EXPECTED.get(split or "", ()) if split}
    return list(wanted)


def _runs(plan: Plan, figures: Sequence[Figure], split: str | None) -> list[Run]:
    """Return split, model and seed of every run that figures need, one seed after the
    other.

    Models without the variant of the recipes are left out, with a note: their plain
    recipe may take days where the variant takes minutes. A variant that no model has is
    a mistake, which training tells.
    """
    wanted = _wanted(figures, split)
    having = [
        (where, name) for where, name in wanted if plan.has_recipe(where, ROSTER[name])
    ]
    for where, name in wanted if having else ():
        if (where, name) not in having:
            _leave_out(plan, f"{where} {plan.size} {name}", ROSTER[name].baseline)
    return [
        (where, ROSTER[name], seed)
        for seed in plan.seeds
        for where, name in having or wanted
    ]


def _studies(plan: Plan, figures: Sequence[Figure]) -> Iterator[str]:
    """Yield the tables of MLPs to train; all are left out where MLPs have no such
    variant.

    At full their rows have recipes of their own, of no variant.
    """
    for study in dict.fromkeys(figure.studies for figure in figures if figure.studies):
        if plan.has_recipe(TABLES[study][1], ROSTER["mlp"]) and not (
            plan.recipe and plan.size == "full"
        ):
            yield study
        else:
            _leave_out(plan, f"studies of {study}", "mlp")


def _leave_out(plan: Plan, what: str, baseline: str) -> None:
    note(
        f"{what}: left out, {baseline} has no recipe {plan.recipe!r} for it; without "
        f"--recipe it is made"
    )


def _head(plan: Plan, figure: Figure) -> str:
    """Return the title and what was run: size, budget, seeds, hours."""
    lines = [
        f"# {figure.name.replace('_', ' ')}: {figure.title}",
        "",
        f"Size {plan.size}.",
    ]
    for split, names in figure.needs.items():
        if names:
            known = plan.evidence(split).methods
        else:
            known = {}
        for name in names:
            if name not in known:
                lines.append(f"- {split}, {label(name)}: no run")
                continue
            seeds = known[name].seeds
            which = ", ".join(str(held.seed) for held in seeds)
            lines.append(
                f"- {split}, {label(name)}: seeds {which}; {budget(seeds[0].record)} "
                f"steps x windows;"
                f" {number(known[name].hours_per_seed)} CPU hours per seed"
            )
    return "\n".join(lines)


def _chosen(only: str | None, split: str | None) -> list[Figure]:
    """Return the figures that were asked for."""
    if split is not None and split not in EXPECTED:
        raise UsageError(
            f"no split {split!r}", where="--split", fix=suggest_name(split, EXPECTED)
        )
    if only:
        names = only.split(",")
    else:
        names = list(FIGURES)
    for name in names:
        if name not in FIGURES:
            raise UsageError(
                f"no table or figure {name!r}",
                where="--only",
                fix=suggest_name(name, FIGURES),
            )
    return [
        FIGURES[name] for name in names if split is None or split in FIGURES[name].needs
    ]


def _seeds(text: str) -> tuple[int, ...]:
    try:
        seeds = tuple(int(part) for part in text.split(","))
    except ValueError:
        seeds = ()
    if not seeds or min(seeds) < 0:
        raise UsageError(
            "cannot understand the seeds",
            where="--seeds",
            expected="as in 0,1",
            got=text,
        )
    return seeds


def _say(text: str) -> None:
    """Print a text; where the reader has left, as ``head`` does, the work goes on
    without.
    """
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    raise SystemExit(main())
