"""Generation when something goes wrong: bad input, full disks, kills, Ctrl-C,
blow-ups.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from conftest import SIZE, SPLIT

from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Registry
from lagbench.errors import WorkFailedError
from lagbench.make.generate import GenerationResult, generate


def files(root: Path) -> list[str]:
    """Return the names of all regular files below a folder, locks left out."""
    return sorted(
        p.name
        for p in root.rglob("*")
        if p.is_file() and not p.name.startswith(".lock")
    )


def partial_files(root: Path) -> list[Path]:
    """Return the unfinished scenario files below a folder."""
    return list(root.rglob(".*.nc.*.partial"))


def scenario_files(root: Path) -> list[str]:
    """Return the names of the finished scenario files."""
    return sorted(path.name for path in root.rglob("[!.]*.nc"))


def manifest_of(root: Path) -> Manifest:
    """Return the manifest of the tiny data set."""
    manifest = read_manifest(root, SPLIT, SIZE, 2)
    assert manifest is not None
    return manifest


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 320 KiB: room for one and a half scenarios."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=320k", "none", str(disk)]
    if (
        shutil.which("mount") is None
        or subprocess.run(mount, capture_output=True, check=False).returncode
    ):
        pytest.skip("a tmpfs cannot be mounted here: it takes root rights")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_too_small_is_refused_at_once(
    small_disk: Path, unmeasured: Registry
) -> None:
    """The message states bytes needed and free; nothing is written."""
    with pytest.raises(WorkFailedError) as caught:
        generate(SPLIT, SIZE, root=small_disk, registry=unmeasured)
    assert caught.value.where.endswith("/disk")
    assert caught.value.exit_code == 5
    assert files(small_disk) == []


def test_two_generations_at_once(
    tmp_path: Path, unmeasured: Registry, generated: GenerationResult
) -> None:
    """The second waits, names the process that it waits for, and then finds all
    files.
    """
    told: list[str] = []
    options: dict[str, Any] = {
        "root": tmp_path,
        "workers": 1,
        "registry": unmeasured,
        "on_wait": told.append,
    }
    with ThreadPoolExecutor() as threads:
        with dataset_lock(tmp_path, SPLIT, SIZE, 2):
            second = threads.submit(generate, SPLIT, SIZE, **options)
            while not told and not second.done():
                time.sleep(0.01)
            shutil.copytree(
                generated.folder, tmp_path / SPLIT / SIZE / "v2", dirs_exist_ok=True
            )
        result = second.result(timeout=60)
    assert f"process {os.getpid()} on" in told[0]
    assert result.simulated == ()
    assert result.dataset_sha256 == generated.dataset_sha256


CALL = "from lagbench.__main__ import app; app()"

INTERRUPTED = f"""
import os, signal
# a shell's background jobs ignore it
signal.signal(signal.SIGINT, signal.default_int_handler)
from lagbench.make import generate
write = generate.write_manifest
def write_first(*arguments):
    generate.write_manifest = write
    write(*arguments)
    os.killpg(0, signal.SIGINT)
generate.write_manifest = write_first
{CALL}
"""


def start(
    root: Path, registry: Path, *options: str, program: str = CALL
) -> subprocess.Popen[str]:
    """Start a generation as a process group of its own, as a shell does."""
    command = [
        "generate",
        "--split",
        SPLIT,
        "--size",
        SIZE,
        "--root",
        str(root),
        *options,
    ]
    return subprocess.Popen(
        [sys.executable, "-c", program, *command],
        env={**os.environ, "LAGBENCH_REGISTRY": str(registry)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )


def wait_for(condition: Callable[[], object], process: subprocess.Popen[str]) -> None:
    """Wait until a condition holds while a process runs."""
    end = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


def children(process: int) -> list[int]:
    """Return the process ids of the living children."""
    listing = Path(f"/proc/{process}/task/{process}/children")
    return [int(word) for word in listing.read_text().split()]


@pytest.mark.slow
def test_control_c_is_resumable(
    tmp_path: Path,
    unmeasured_path: Path,
    unmeasured: Registry,
    generated: GenerationResult,
) -> None:
    """SIGINT to the whole group after the first file: exit 130, whole files and a
    manifest that says so.
    """
    with start(
        tmp_path, unmeasured_path, "--workers", "1", program=INTERRUPTED
    ) as process:
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert partial_files(tmp_path) == []
    assert manifest_of(tmp_path).complete is False
    rest = generate(SPLIT, SIZE, root=tmp_path, registry=unmeasured)
    assert rest.kept != ()
    assert rest.simulated != ()
    assert rest.dataset_sha256 == generated.dataset_sha256


@pytest.mark.slow
def test_a_killed_worker_is_replaced(
    tmp_path: Path,
    unmeasured_path: Path,
    generated: GenerationResult,
    unmeasured: Registry,
) -> None:
    """SIGKILL of a worker costs time, nothing else: exit 0 and the same data set
    hash.
    """
    with start(tmp_path, unmeasured_path, "--workers", "2") as process:
        wait_for(lambda: partial_files(tmp_path), process)
        os.kill(children(process.pid)[0], signal.SIGKILL)
        output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert generated.dataset_sha256 is not None
    assert generated.dataset_sha256 in output
    assert partial_files(tmp_path) == []


@pytest.mark.slow
def test_a_killed_parent_is_resumed(
    tmp_path: Path,
    unmeasured_path: Path,
    generated: GenerationResult,
    unmeasured: Registry,
) -> None:
    """SIGKILL of the parent ends its workers; the second call keeps what is whole and
    completes it.
    """
    with start(tmp_path, unmeasured_path, "--workers", "2") as process:
        wait_for(
            lambda: len(scenario_files(tmp_path)) >= 1 and partial_files(tmp_path),
            process,
        )
        workers = children(process.pid)
        process.kill()
        process.wait()
    end = time.monotonic() + 30
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < end, "a worker outlived its parent"
        time.sleep(0.02)
    result = generate(SPLIT, SIZE, root=tmp_path, workers=1, registry=unmeasured)
    assert result.kept != ()
    assert result.dataset_sha256 == generated.dataset_sha256
    assert partial_files(tmp_path) == []
    found, whole = (
        read_manifest(root, SPLIT, SIZE, 2) for root in (tmp_path, generated.root)
    )
    assert found is not None
    assert whole is not None
    assert found.files == whole.files  # with what each simulation went through
