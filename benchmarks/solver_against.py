"""The solver of this tree against that of another commit, on one core, in one run.

    python benchmarks/solver_against.py --against main~20

checks the other commit out beside this one, runs both alternately in processes of their
own and prints, per split, the particle-substeps per second of processor time (best of
the rounds) of both and their ratio. ``lagbench bench`` times frames as
generation makes them, with the checks and the positions read out after each; the row
``kernels`` is ``whole_frame.py``, substeps alone. ``--cases`` names rows, also those of
other splits that both commits have::

    python benchmarks/solver_against.py --against main~20 --cases curl-noise-3d fluid-3d
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lagbench.baselines.machine import hardware

HERE = Path(__file__).resolve().parent.parent
CASES = ("kernels", "cavity", "curl-noise", "fluid", "multimaterial")


def on_one_core(tree: Path, *arguments: str, **variables: str) -> str:
    """Run Python in a tree, on one core; return what it prints."""
    core = min(os.sched_getaffinity(0))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree), **variables},
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout


def is_commit(revision: str) -> bool:
    """Return whether git knows a commit of that name."""
    command = ["git", "-C", str(HERE), "rev-parse", "--quiet", "--verify"]
    command += ["--end-of-options", f"{revision}^{{commit}}"]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    return done.returncode == 0


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """Yield a folder with another commit, which is gone afterwards."""
    worktree = ["git", "-C", str(HERE), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        add = [*worktree, "add", "--quiet", "--detach", str(other), revision]
        remove = [*worktree, "remove", "--force", str(other)]
        subprocess.run(add, check=True)
        try:
            yield other
        finally:
            subprocess.run(remove, check=True)


def rate(tree: Path, case: str, size: str) -> float:
    """Return the particle-substeps per second of processor time that a tree reaches."""
    command = ["benchmarks/whole_frame.py"]
    if case != "kernels":
        command = ["-m", "lagbench", "bench", "solver", "--json"]
        command += ["--split", case, "--size", size]
    printed = on_one_core(tree, *command)
    start = printed.index("{")
    speed: dict[str, Any] = json.loads(printed[start:])
    if case == "kernels":
        return float(speed["per_processor_second"])
    particle_substeps = speed["particles"] * speed["substeps"]  # of one frame
    return float(particle_substeps / speed["seconds_per_frame"])


def main() -> int:
    """Check the other commit out, run both trees alternately and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", required=True, metavar="REV")
    parser.add_argument("--size", default="mini")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="CASE")
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error("--rounds: 1 or more")
    if not is_commit(options.against):
        parser.error(f"--against: git knows no commit {options.against!r}")
    print(
        f"{hardware()['processor']}, size {options.size}; M particle-substeps/s of "
        f"processor time"
    )
    print(f"| case | {options.against} | this tree | ratio |\n|---|---|---|---|")
    with checked_out(options.against) as other:
        for case in options.cases:
            best = dict.fromkeys((other, HERE), 0.0)
            for _ in range(options.rounds):
                for tree, best_rate in best.items():
                    new_rate = rate(tree, case, options.size)
                    best[tree] = max(best_rate, new_rate)
            theirs = best[other] / 1e6
            ours = best[HERE] / 1e6
            print(
                f"| {case} | {theirs:.1f} | {ours:.1f} | {ours / theirs:.2f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
