"""The kernels of this tree against those of another commit or engine, in short turns.

    python benchmarks/solver_turns.py --against main~20 --cases cavity curl-noise-3d
    python benchmarks/solver_turns.py --against quadrants

Per case two processes, one of each side, keep their solvers and advance one scenario
from its start, in turns, on the same core. So both meet the same load of the machine.
The scenario is the first one of test, or the one that ``--scenario`` names.

Prints the medians of the particle-substeps per second of processor time, and of the
ratios of the turns, with quartiles. No positions are read.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.baselines.machine import hardware
from lagbench.data.registry import load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import solver_constants
from lagbench.generators.solver import build
from lagbench.work.engine import ENGINE_VARIABLE, ENGINES

CASES = ("cavity", "curl-noise", "fluid", "multimaterial")
PARTICLE_SUBSTEPS = 2_000_000  # of a turn
HERE = Path(__file__).parents[1]


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """Yield a folder with another commit, which is gone afterwards."""
    worktree = ["git", "-C", str(HERE), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        add = [*worktree, "add", "--quiet", "--detach", str(other), revision]
        subprocess.run(add, check=True)
        try:
            yield other
        finally:
            subprocess.run([*worktree, "remove", "--force", str(other)], check=True)


def serve(split: str, size: str, scenario: int | None) -> None:
    """Advance the solver once per line of stdin; print the rate of each turn."""
    tier = load().size(split, size)
    parameters = solver_constants(tier)
    if scenario is None:
        scenario = tier.subsets["test"][0]
    tier.subset_of(scenario)  # raises if the size has no such scenario
    state = draw_initial_state(tier, scenario)
    solver = build(parameters)
    substeps = max(1, PARTICLE_SUBSTEPS // parameters.particles)
    for _ in sys.stdin:
        solver.load([state])
        solver.advance(1)
        start = time.process_time()
        solver.advance(substeps)
        seconds = time.process_time() - start
        rate = parameters.particles * substeps / seconds
        print(rate, flush=True)


class Side:
    """The process of one commit and engine."""

    def __init__(
        self,
        tree: Path,
        split: str,
        size: str,
        *,
        scenario: int | None,
        engine: str,
    ) -> None:
        core = min(os.sched_getaffinity(0))
        command = [sys.executable, __file__, "--serve", split, "--size", size]
        if scenario is not None:
            command += ["--scenario", str(scenario)]
        # Both sides run the benchmark scripts of HERE; lagbench comes from the tree.
        self._process = subprocess.Popen(
            command,
            cwd=tree,
            env={**os.environ, "PYTHONPATH": str(tree), ENGINE_VARIABLE: engine},
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.take_turn()  # compiles

    def take_turn(self) -> float:
        """Return the particle-substeps per second of processor time of one turn."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def compare(
    other: Path,
    split: str,
    size: str,
    *,
    scenario: int | None,
    turns: int,
    engine: str,
) -> NDArray[np.float64]:
    """Return the rates of both sides, shape [turn, side]; the other's engine first."""
    sides = [
        Side(other, split, size, scenario=scenario, engine=engine),
        Side(HERE, split, size, scenario=scenario, engine=ENGINES[0]),
    ]
    rates = np.empty((turns, 2))
    for turn in range(turns):
        for index, side in enumerate(sides):
            rates[turn, index] = side.take_turn()
    for side in sides:
        side.close()
    return rates


def main() -> int:
    """Compare the two sides case by case and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", metavar="REV|ENGINE")
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="SPLIT")
    parser.add_argument("--size", default="mini")
    parser.add_argument(
        "--scenario",
        type=int,
        metavar="ID",
        help="scenario of all cases; by default the first one of test",
    )
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--serve", metavar="SPLIT", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve, options.size, options.scenario)
        return 0
    if options.against is None:
        parser.error("--against is required")

    scenario = "first scenario of test"
    if options.scenario is not None:
        scenario = f"scenario {options.scenario}"
    print(
        f"{hardware()['processor']}, size {options.size}, {scenario}; "
        "M particle-substeps/s of processor time"
    )
    print(f"| case | {options.against} | this tree | ratio | quartiles |")
    print("|---|---:|---:|---:|---|")
    engine = ENGINES[0]
    tree: AbstractContextManager[Path] = nullcontext(HERE)
    if options.against in ENGINES:
        engine = options.against
    else:
        tree = checked_out(options.against)
    with tree as other:
        for case in options.cases:
            rates = compare(
                other,
                case,
                options.size,
                scenario=options.scenario,
                turns=options.turns,
                engine=engine,
            )
            theirs, ours = np.median(rates, axis=0) / 1e6
            their_rates, our_rates = rates.T
            ratios = our_rates / their_rates
            low, ratio, high = np.quantile(ratios, (0.25, 0.5, 0.75))
            print(
                f"| {case} | {theirs:.1f} | {ours:.1f} | {ratio:.2f} "
                f"| {low:.2f} to {high:.2f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
