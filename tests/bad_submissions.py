"""Make faulty prediction files and say what the validator makes of each.

    python tests/bad_submissions.py [FOLDER [FAULT ...]]

writes a small data set and one file per fault into FOLDER (a temporary one by default),
validates each in a child process with limits, and prints check, exit code, computing
time and the child's peak memory. Exit code 1 if any file is not recognised, crashes or
breaks a limit. With names of faults it makes these only.
"""

from __future__ import annotations

import importlib
import os
import resource
import sys
import tempfile
from pathlib import Path

from fault_registry import FAULTS
from submission_data import make_bench

__all__ = ["FAULTS", "main"]

for _part in ("files", "format", "task", "values"):
    importlib.import_module(f"faults_of_{_part}")


def main() -> int:
    """Make and validate those that are named, or all."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
    names = sys.argv[2:] or list(FAULTS)
    bench = make_bench(target)
    failures = 0
    for name in names:
        entry = FAULTS[name]
        path = entry.make(bench)
        started = cpu_seconds()
        result = bench.validate(path, isolated=True)
        seconds = cpu_seconds() - started
        checks = sorted({finding.check for finding in result.errors})
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        is_recognised = (
            entry.check in checks
            and result.exit_code == entry.exit_code
            and seconds < 10
            and peak < 1000
        )
        verdict = "ok"
        if not is_recognised:
            verdict = "NOT RECOGNISED"
            failures += 1
        cost = f"{seconds:5.1f} s {peak:5.0f} MiB"
        line = f"{name:28} {','.join(checks):24} exit {result.exit_code} {cost}"
        print(f"{line} {verdict}")  # noqa: T201
    summary = f"{len(names)} faulty files, {failures} not recognised"
    print(f"{summary}; they lie in {target}")  # noqa: T201
    return 1 if failures else 0


def cpu_seconds() -> float:
    """Computing time of this process and its children: unlike wall time, no matter of
    the load [s].
    """
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


if __name__ == "__main__":
    raise SystemExit(main())
