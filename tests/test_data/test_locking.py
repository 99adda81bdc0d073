"""One writer at a time; a dead one blocks nobody."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lagbench.data.layout import dataset_folder
from lagbench.data.lock import HOLDER_NAME, dataset_lock
from lagbench.errors import WorkFailedError

HOLD = """
import sys, time
from pathlib import Path
from lagbench.data.lock import dataset_lock
with dataset_lock(Path(sys.argv[1]), "cavity", "tiny", 1):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lock until a line reaches its input."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_writer_learns_who_holds_the_lock(
    tmp_path: Path, other: subprocess.Popen[str]
) -> None:
    """With timeout 0 the error names process, host and time at once, exit code 5.
    Another size or MAJOR version of the split can be written meanwhile.
    """
    start = time.monotonic()
    with (
        pytest.raises(WorkFailedError) as caught,
        dataset_lock(tmp_path, "cavity", "tiny", 1, timeout=0),
    ):
        pass
    assert time.monotonic() - start < 5
    assert caught.value.exit_code == 5
    holder = (
        rf"process {other.pid} on {re.escape(os.uname().nodename)}, since 20..-..-..T"
    )
    assert re.search(holder, str(caught.value))
    with (
        dataset_lock(tmp_path, "cavity", "mini", 1, timeout=0),
        dataset_lock(tmp_path, "cavity", "tiny", 2, timeout=0),
    ):
        assert other.poll() is None


def test_a_second_writer_waits(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    """Without a timeout it says whom it waits for and goes on when the first one
    ends.
    """
    told: list[str] = []

    def release(holder: str) -> None:
        told.append(holder)
        other.stdin.write("\n")
        other.stdin.flush()

    with dataset_lock(tmp_path, "cavity", "tiny", 1, on_wait=release):
        folder = dataset_folder(tmp_path, "cavity", "tiny", 1)
        assert f"process {os.getpid()} " in (folder / HOLDER_NAME).read_text()
    assert len(told) == 1
    assert f"process {other.pid}" in told[0]


def test_a_killed_writer_blocks_nobody(
    tmp_path: Path, other: subprocess.Popen[str]
) -> None:
    """After kill -9 the holder file is stale, and the lock is free all the same."""
    other.send_signal(signal.SIGKILL)
    other.wait()
    holder = dataset_folder(tmp_path, "cavity", "tiny", 1) / HOLDER_NAME
    assert f"process {other.pid} " in holder.read_text()
    with dataset_lock(tmp_path, "cavity", "tiny", 1, timeout=0):
        pass
    assert not holder.exists()


def test_whatever_ends_the_block_frees_the_lock(tmp_path: Path) -> None:
    """A root that cannot hold folders gives exit code 5 with the remedy."""
    with pytest.raises(KeyboardInterrupt), dataset_lock(tmp_path, "cavity", "tiny", 1):
        raise KeyboardInterrupt
    with dataset_lock(tmp_path, "cavity", "tiny", 1, timeout=0):
        pass
    (tmp_path / "fluid").write_text("in the way")
    with (
        pytest.raises(WorkFailedError) as caught,
        dataset_lock(tmp_path, "fluid", "tiny", 1),
    ):
        pass
    assert caught.value.where.endswith("fluid/tiny/v1")
