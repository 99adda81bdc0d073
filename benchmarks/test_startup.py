"""Processor time of starting lagbench, beside what an import of xarray alone takes.

pytest benchmarks/test_startup.py -s
"""

import os
import subprocess
import sys

SPENT = {
    "lagbench --help": ["-m", "lagbench", "--help"],
    "import lagbench": ["-c", "import lagbench"],
    "import xarray": ["-c", "import xarray"],
}
LIMITS = {"lagbench --help": 0.3, "import lagbench": 0.5}


def _seconds(arguments: list[str]) -> float:
    """Return the processor time of a fresh interpreter, best of five [s]."""
    times = []
    for _ in range(5):
        process = subprocess.Popen(
            [sys.executable, *arguments], stdout=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        times.append(usage.ru_utime + usage.ru_stime)
    return min(times)


def test_startup() -> None:
    """Help and import stay within the targets of design section 13."""
    seconds = {name: _seconds(arguments) for name, arguments in SPENT.items()}
    for name, spent in seconds.items():
        print(
            f"{name}: {spent:.3f} s, {spent / seconds['import xarray']:.2f} x "
            f"import xarray"
        )
    assert all(seconds[name] <= limit for name, limit in LIMITS.items())
