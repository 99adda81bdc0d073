"""Attack the readers of lagbench with mutated files, from a seed.

    python -m validation.attack --seed 43 --cases 600 --root DATA --work FOLDER

Each case copies valid files, mutates one of them (bytes, place in the file system,
values, types, shapes, names) and runs a command of the shipped command line on it in a
fork of this process. A case fails if the command shows a traceback, ends with an
undocumented exit code, leaves something half-written, takes more than 4 GB or 60 s
(beside the time that a rollout of an ONNX model is granted),
accepts a file that must have other bytes, or scores a changed prediction as the old
one. Prints a table of targets and counts, and the number of every failed case;
``--only N`` repeats one of them. ``--valid`` runs every command on the valid files,
which must succeed. Exit code 0: no case failed; 1: some did; 2: bad options.

With the same seed and targets, case N is the same whatever the number of cases is.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagbench.errors import UsageError, suggest_name
from lagbench.figures.tables import Table

from .mutations import allow_removal, copy_tree
from .running import Outcome, find_failures, run_command, take_snapshot
from .targets import Target, list_targets, make_valid_files

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class AttackCase:
    """A case and how it ended."""

    number: int
    target: Target
    mutation: str
    command: str
    outcome: Outcome
    failures: tuple[str, ...]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    numbers = [options.seed, options.cases, options.first, *(options.only or ())]
    if min(numbers) < 0:
        parser.error("a seed, a number of a case or a number of cases is negative")
    os.environ["LAGBENCH_ROOT"] = str(options.root.resolve())
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _import_libraries()
    work = options.work.resolve()
    valid = work / "valid"
    make_valid_files(valid, options.root, REPOSITORY / "leaderboard")
    targets = list_targets(valid)
    if options.target:
        try:
            targets = choose_targets(targets, options.target)
        except UsageError as error:
            sys.stderr.write(f"error: {error}\n")
            return error.exit_code
    if options.valid:
        return _try_valid_files(targets, valid, work)
    plan = _plan(targets, options.seed)

    case_numbers: Sequence[int] = range(options.first, options.first + options.cases)
    if options.only is not None:
        case_numbers = options.only
    counts: dict[str, Counter[str]] = {}
    failed = []
    for number in case_numbers:
        target = plan[number % len(plan)]
        case = _run_case(number, target, options.seed, valid, work)
        counter = counts.setdefault(target.name, Counter())
        counter["cases"] += 1
        counter[_ending(case)] += 1
        counter.update(case.failures)
        if case.failures:
            failed.append(case)
        if case.failures or options.verbose:
            _print_case(case, is_full=options.only is not None)
    _print_table(counts)
    sys.stdout.write(f"{len(failed)} of {len(case_numbers)} cases failed\n")
    return int(bool(failed))


def choose_targets(targets: Sequence[Target], names: Sequence[str]) -> list[Target]:
    """Return the targets of some names.

    Raises:
        UsageError: there is no target of a name.
    """
    known_names = [target.name for target in targets]
    for name in names:
        if name not in known_names:
            raise UsageError(
                f"no target {name!r}",
                where="--target",
                expected=", ".join(known_names),
                got=ascii(name),
                fix=suggest_name(name, known_names),
            )
    return [target for target in targets if target.name in names]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m validation.attack", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--cases", type=int, default=600)
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of cases")
    parser.add_argument("--root", type=Path, required=True, help="data, tiny")
    parser.add_argument("--work", type=Path, required=True, help="scratch folder")
    parser.add_argument(
        "--valid", action="store_true", help="run the commands on the valid files"
    )
    parser.add_argument(
        "--target", action="append", help="name of a target, instead of all; repeatable"
    )
    parser.add_argument("--verbose", action="store_true", help="print every case")
    return parser


def _import_libraries() -> None:
    """Import what commands import, so that forks need not; torch gets one thread."""
    import netCDF4  # noqa: F401
    import onnxruntime  # noqa: F401
    import torch

    import lagbench.baselines.predict
    import lagbench.board.build
    import lagbench.board.check
    import lagbench.cli.program
    import lagbench.scoring.score  # noqa: F401

    torch.set_num_threads(1)


def _plan(targets: Sequence[Target], seed: int) -> list[Target]:
    """Return a round of targets, each as often as its weight, in a seeded order."""
    plan = []
    for target in targets:
        plan += [target] * target.weight
    rng = np.random.Generator(np.random.PCG64(seed))
    return [plan[i] for i in rng.permutation(len(plan))]


def _try_valid_files(targets: Sequence[Target], valid: Path, work: Path) -> int:
    """Run every command once on files that are not mutated: all must succeed."""
    exit_code = 0
    for target in targets:
        for command in dict.fromkeys(target.commands):
            folder = _copy_valid_files(valid / target.source, work)
            words = (*command, *target.read_words(folder))
            outcome = run_command(words, folder, work, is_installed=target.is_installed)
            sys.stdout.write(f"{target.name}: `{' '.join(command)}`: {outcome.code}\n")
            if outcome.code != 0:
                exit_code = 1
                sys.stdout.write(f"{outcome.output[:3000]}{outcome.errors[:3000]}\n")
            sys.stdout.flush()
    return exit_code


def _copy_valid_files(source: Path, work: Path) -> Path:
    """Return the working folder of a case, with nothing but the valid files."""
    folder = work / "case"
    if folder.exists():
        allow_removal(folder)
        shutil.rmtree(folder)
    copy_tree(source, folder)
    return folder


def _run_case(
    number: int, target: Target, seed: int, valid: Path, work: Path
) -> AttackCase:
    """Mutate the valid files of a target and run a command on them."""
    rng = np.random.Generator(np.random.PCG64([seed, number]))
    mutation = target.mutations[int(rng.integers(len(target.mutations)))]
    command = target.commands[int(rng.integers(len(target.commands)))]
    source = valid / target.source
    folder = _copy_valid_files(source, work)
    victim = folder / target.victim
    mutation(victim, rng)

    before = take_snapshot(folder)
    outcome = run_command(
        (*command, *target.read_words(folder)),
        folder,
        work,
        model_seconds=target.model_seconds,
        is_installed=target.is_installed,
    )
    failures = find_failures(outcome, before, take_snapshot(folder))
    if outcome.code == 0:
        if target.is_hashed:
            failures.append("a changed file was accepted")
        if target.check is not None:
            wrong = target.check(source, folder, outcome.output)
            if wrong is not None:
                failures.append(wrong)
    return AttackCase(
        number=number,
        target=target,
        mutation=mutation.__name__,
        command=" ".join(command),
        outcome=outcome,
        failures=tuple(failures),
    )


def _ending(case: AttackCase) -> str:
    if case.outcome.code == 0:
        return "accepted"
    return "refused"


def _print_case(case: AttackCase, *, is_full: bool) -> None:
    outcome = case.outcome
    sys.stdout.write(
        f"case {case.number}: {case.target.name}, {case.mutation}, "
        f"`{case.command[:60]}`: code {outcome.code}, {outcome.seconds:.1f} s, "
        f"{outcome.peak_bytes / 2**20:.0f} MiB; {', '.join(case.failures) or 'good'}\n"
    )
    if is_full:
        sys.stdout.write(f"{outcome.output[:3000]}\n{outcome.errors[:6000]}\n")
    sys.stdout.flush()


def _print_table(counts: dict[str, Counter[str]]) -> None:
    """Print targets and counts as Markdown."""
    rows = []
    total: Counter[str] = Counter()
    for name, counter in counts.items():
        total.update(counter)
        rows.append(_row(name, counter))
    rows.append(_row("all", total))
    columns = ("target", "cases", "refused", "accepted", "failed")
    table = Table("attack", columns, tuple(rows))
    sys.stdout.write(_markdown(table) + "\n")


def _row(name: str, counter: Counter[str]) -> tuple[str, ...]:
    kinds = []
    for kind, count in sorted(counter.items()):
        if kind not in ("cases", "refused", "accepted"):
            kinds.append(f"{kind}: {count}")
    counts = [str(counter[kind]) for kind in ("cases", "refused", "accepted")]
    return (name, *counts, "; ".join(kinds) or "0")


def _markdown(table: Table) -> str:
    lines = [
        f"| {' | '.join(table.columns)} |",
        f"|{'---|' * len(table.columns)}",
    ]
    for row in table.rows:
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    started = time.monotonic()
    code = main()
    sys.stdout.write(f"{time.monotonic() - started:.0f} s\n")
    sys.exit(code)
