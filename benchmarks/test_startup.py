"""Processor time of starting lagbench, beside that of importing xarray.

pytest benchmarks/test_startup.py -s

The limits are ratios within one run, so they hold on slow and on busy machines.
"""

import os
import subprocess
import sys

REPEATS = 5
YARDSTICK = "import xarray"
ARGUMENTS = {
    "lagbench --help": ["-m", "lagbench", "--help"],
    "import lagbench": ["-c", "import lagbench"],
    YARDSTICK: ["-c", YARDSTICK],
}
LIMITS = {"lagbench --help": 0.5, "import lagbench": 0.15}
"""Greatest processor time over that of the yardstick."""


def _processor_seconds(arguments: list[str]) -> float:
    """Return the processor time of a fresh interpreter [s]."""
    command = [sys.executable, *arguments]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return usage.ru_utime + usage.ru_stime


def test_startup() -> None:
    """Help and import take a small share of the time that importing xarray takes."""
    best: dict[str, float] = {}
    # in turns, so that a busy moment of the machine meets all of them
    for _ in range(REPEATS):
        for name, arguments in ARGUMENTS.items():
            seconds = _processor_seconds(arguments)
            least = best.setdefault(name, seconds)
            best[name] = min(seconds, least)

    for name, seconds in best.items():
        ratio = seconds / best[YARDSTICK]
        print(f"{name}: {seconds:.3f} s, {ratio:.2f} x {YARDSTICK}")
    for name, limit in LIMITS.items():
        assert best[name] <= limit * best[YARDSTICK]
