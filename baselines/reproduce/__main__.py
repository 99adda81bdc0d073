"""Make the tables and figures of the thesis at one size: train, predict, score, draw.

    python -m lagbench.baselines.reproduce --size mini --root DATA --runs runs [--only table_5_4,fig_5_5]

What is there is not made again; interrupted, it goes on. Writes Markdown, CSV and PNG to
``RUNS/reproduce/<size>/`` and prints the Markdown. ``--list`` says what there is, ``--dry-run`` what
would be trained; ``--no-training`` shows what the runs that are there allow.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from lagbench.data.layout import resolve_root
from lagbench.data.registry import Registry, load
from lagbench.errors import LagbenchError, UsageError, nearest

from .catalogue import ITEMS, Item
from .making import make_run, outlook
from .mlp_studies import TABLES, make_studies
from .plan import Plan
from .roster import EXPECTED, ROSTER, Model, label
from .sheet import write_sheet
from .spending import budget

__all__ = ["main", "reproduce"]


def main(arguments: Sequence[str] | None = None, *, registry: Registry | None = None) -> int:
    """Make what the arguments name; return the exit code."""
    given = _parser().parse_args(arguments)
    try:
        items = _chosen(given.only, given.split)
        if given.list:
            _say("\n".join(_lines(items)))
            return 0
        known = registry or load()
        known.size("cavity", given.size)
        root = resolve_root(given.root)
        plan = Plan(
            size=given.size,
            root=root,
            runs=given.runs,
            output=given.output or given.runs / "reproduce" / given.size,
            seeds=_seeds(given.seeds),
            recipe=given.recipe,
            settings=tuple(given.set),
            device=given.device,
            threads=given.threads,
            registry=registry,
        )
        if given.dry_run:
            return rehearse(plan, items, split=given.split)
        return reproduce(plan, items, training=not given.no_training, split=given.split)
    except LagbenchError as error:
        _complain(error)
        return error.exit_code


def reproduce(plan: Plan, items: Sequence[Item], *, training: bool = True, split: str | None = None) -> int:
    """Make items; what fails is said, and the others are made. Return 0, or the last error's code."""
    code = 0
    if training:
        for error in _make_all(plan, items, split):
            _complain(error)
            code = error.exit_code
    for item in items:
        try:
            sheet = item.make(plan)
            _say(write_sheet(sheet, plan.output, item.name, _head(plan, item)))
        except LagbenchError as error:
            _complain(error, item.name)
            code = error.exit_code
    for path in plan.stale:
        _note(f"{path}: scores of another version of the data; left out")
    return code


def rehearse(plan: Plan, items: Sequence[Item], *, split: str | None = None) -> int:
    """Say what :func:`reproduce` would train, predict and score; return 0, or the last error's code."""
    code = 0
    for where, model, seed in _runs(plan, items, split):
        try:
            _say(f"{where} {plan.size} {model.name}-{seed}: {outlook(plan, where, model, seed)}")
        except LagbenchError as error:
            _complain(error)
            code = error.exit_code
    for study in _studies(plan, items):
        _say(f"studies of {study}")
    return code


def _make_all(plan: Plan, items: Sequence[Item], split: str | None) -> Iterator[LagbenchError]:
    """Make every run that items need, one seed after the other; yield what went wrong."""
    for where, model, seed in _runs(plan, items, split):
        try:
            _note(f"{where} {plan.size} {model.name}-{seed}")
            make_run(plan, where, model, seed, say=_note)
        except LagbenchError as error:
            yield error
    for study in _studies(plan, items):
        try:
            _note(f"studies of {study}")
            make_studies(plan, study)
        except LagbenchError as error:
            yield error


def _runs(plan: Plan, items: Sequence[Item], split: str | None) -> list[tuple[str, Model, int]]:
    """Return split, model and seed of every run that items need, one seed after the other.

    Models without the variant of the recipes are left out, with a note: their plain recipe may take
    days where the variant takes minutes. A variant that no model has is a mistake, which training tells.
    """
    wanted = {(where, name): None for item in items for where, names in item.needs.items() for name in names}
    wanted |= {(split, name): None for name in EXPECTED.get(split or "", ()) if split}
    having = [(where, name) for where, name in wanted if plan.has_recipe(where, ROSTER[name])]
    for where, name in wanted if having else ():
        if (where, name) not in having:
            _leave_out(plan, f"{where} {plan.size} {name}", ROSTER[name].baseline)
    return [(where, ROSTER[name], seed) for seed in plan.seeds for where, name in having or wanted]


def _studies(plan: Plan, items: Sequence[Item]) -> Iterator[str]:
    """Yield the tables of MLPs to train; all are left out where MLPs have no such variant."""
    for study in dict.fromkeys(study for item in items for study in item.studies):
        if plan.has_recipe(TABLES[study][1], ROSTER["mlp"]):
            yield study
        else:
            _leave_out(plan, f"studies of {study}", "mlp")


def _leave_out(plan: Plan, what: str, baseline: str) -> None:
    _note(f"{what}: left out, {baseline} has no recipe {plan.recipe!r} for it; without --recipe it is made")


def _head(plan: Plan, item: Item) -> str:
    """Return the title and what was run: size, budget, seeds, hours."""
    lines = [f"# {item.name.replace('_', ' ')}: {item.title}", "", f"Size {plan.size}."]
    for split, names in item.needs.items():
        known = plan.evidence(split).methods
        for name in names:
            seeds = known[name].seeds if name in known else ()
            if not seeds:
                lines.append(f"- {split}, {label(name)}: no run")
                continue
            hours = sum(held.cpu_hours or 0.0 for held in seeds)
            which = ", ".join(str(held.seed) for held in seeds)
            lines.append(
                f"- {split}, {label(name)}: seeds {which}; {budget(seeds[0].record)} steps x windows;"
                f" {hours:.3g} CPU hours"
            )
    return "\n".join(lines)


def _chosen(only: str | None, split: str | None) -> list[Item]:
    """Return the items that were asked for."""
    if split is not None and split not in EXPECTED:
        raise UsageError(f"no split {split!r}", where="--split", fix=nearest(split, EXPECTED))
    names = only.split(",") if only else list(ITEMS)
    for name in names:
        if name not in ITEMS:
            raise UsageError(f"no table or figure {name!r}", where="--only", fix=nearest(name, ITEMS))
    return [ITEMS[name] for name in names if split is None or split in ITEMS[name].splits]


def _seeds(text: str) -> tuple[int, ...]:
    try:
        seeds = tuple(int(part) for part in text.split(","))
    except ValueError:
        seeds = ()
    if not seeds or min(seeds) < 0:
        raise UsageError("cannot understand the seeds", where="--seeds", expected="as in 0,1", got=text)
    return seeds


def _lines(items: Sequence[Item]) -> Iterator[str]:
    for item in items:
        needs = [f"{split}: {' '.join(names)}" for split, names in item.needs.items()]
        needs += [f"trainings of {study}" for study in item.studies]
        yield f"{item.name:14} {item.title}; needs {'; '.join(needs) or 'no training'}"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


def _note(text: str) -> None:
    sys.stderr.write(f"-- {text}\n")


def _complain(error: LagbenchError, where: str = "") -> None:
    sys.stderr.write(f"error: {where + ': ' if where else ''}{error}\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m lagbench.baselines.reproduce",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--size", default="mini", help="tiny, mini or full")
    add("--only", metavar="NAMES", help="tables and figures, as in table_5_4,fig_5_5; all by default")
    add("--split", help="only what is about this split, and all models that are meant for it")
    add("--root", type=Path, help="folder of all data sets")
    add("--runs", type=Path, default=Path("runs"), help="folder of runs")
    add("--output", "-o", type=Path, help="RUNS/reproduce/<size> by default")
    add("--seeds", default="0", help="seeds of every training, as in 0,1")
    add("--recipe", metavar="NAME", help="variant of the recipes, as in short")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="change every recipe; repeatable")
    add("--device", default="auto", help="cpu, cuda or auto")
    add("--threads", type=int, help="CPU threads; one per core by default")
    add("--no-training", action="store_true", help="make no run, show what is there")
    add("--dry-run", action="store_true", help="make nothing, say what would be trained")
    add("--list", action="store_true", help="list tables and figures, and what they need")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
