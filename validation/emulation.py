r"""Run Python on an emulated processor, such as one without AVX2.

    python -m validation.emulation --processor Nehalem -- \
        -m lagbench generate --split cavity --size tiny --root FOLDER

The emulator is the user mode of QEMU: the program ``qemu-x86_64`` of the package
qemu-user. ``qemu-x86_64 -cpu help`` lists its processors. What follows ``--`` are
arguments of Python. All packages are those of the Python that runs this command.

The emulator starts the children of a program on the real processor. So the emulated
Python is a script that starts the emulator, and workers start by this script too.

Exit code: that of the emulated Python; 2: the emulator or the arguments are missing.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from lagbench.errors import LagbenchError, UsageError

EMULATOR = "qemu-x86_64"
"""Program of the emulator."""


def write_python(folder: Path, *, emulator: str, processor: str) -> Path:
    """Write a Python that runs on an emulated processor, and return its path.

    Args:
        folder: an empty folder, which becomes a virtual environment: it shares the
            packages of this Python.
        emulator: path of the emulator.
        processor: the emulator's name of the processor.
    """
    program = Path(sys.executable).resolve()
    settings = f"home = {program.parent}\ninclude-system-site-packages = false\n"
    (folder / "pyvenv.cfg").write_text(settings, encoding="utf-8")
    (folder / "lib").symlink_to(Path(sys.prefix, "lib"), target_is_directory=True)

    python = folder / "bin" / "python"
    python.parent.mkdir()
    # -0 is the path by which the emulated Python starts its children.
    words = [emulator, "-cpu", processor, "-0", str(python), str(program)]
    script = f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n'
    python.write_text(script, encoding="utf-8")
    python.chmod(0o755)
    return python


def find_emulator() -> str:
    """Return the path of the emulator.

    Raises:
        UsageError: it is not installed.
    """
    path = shutil.which(EMULATOR)
    if path is None:
        raise UsageError(
            f"there is no program {EMULATOR}; install the user mode of QEMU: apt-get "
            "install qemu-user",
            where="PATH",
        )
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.emulation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--processor", required=True, metavar="NAME", help="as in Nehalem"
    )
    parser.add_argument(
        "python_arguments", nargs="+", metavar="ARGUMENT", help="arguments of Python"
    )
    options = parser.parse_args(arguments)
    try:
        emulator = find_emulator()
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code

    with tempfile.TemporaryDirectory() as folder:
        python = write_python(
            Path(folder), emulator=emulator, processor=options.processor
        )
        command = [str(python), *options.python_arguments]
        return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
