"""Run programs that may open no file that its mode forbids, also as the superuser."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path


def lose_permissions() -> None:
    """Let the program that this process becomes open no file that its mode forbids.

    The superuser may open all files by two capabilities; others do not have them.
    """
    drop_capability = 24  # PR_CAPBSET_DROP of <linux/prctl.h>
    libc = ctypes.CDLL(None)
    for capability in (1, 2):  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH
        libc.prctl(drop_capability, capability, 0, 0, 0)


def run_without_permissions(
    *words: object, folder: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run Python with these words; relative paths of the words begin in the folder."""
    return subprocess.run(
        [sys.executable, *map(str, words)],
        preexec_fn=lose_permissions,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
