"""What works where modules and functions of Linux are missing, as on Windows and macOS:
all but solving.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from score_bench import ScoreBench, straight

import lagbench
from lagbench.errors import WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.work import machine, pool
from lagbench.work.run import run_all

LESS = """
import os, signal, sys
for name in ("resource", "fcntl", "pwd", "grp", "termios"):
    sys.modules[name] = None
for name in ("sched_getaffinity", "fork", "killpg"):
    delattr(os, name)
del signal.SIGXCPU
opened = os.open
def no_folders(path, *rest, **more):
    if os.path.isdir(path):
        raise PermissionError(13, "folders cannot be opened", path)
    return opened(path, *rest, **more)
os.open = no_folders
"""
"""Run as each interpreter starts: what Windows lacks is taken away from Python."""

COMMANDS = """
import sys
from lagbench.cli.program import app
for line in sys.stdin.read().splitlines():
    assert app(line.split()) == 0, line
assert sys.modules["resource"] is sys.modules["fcntl"] is None
"""

Run = Callable[..., None]


@pytest.fixture
def commands(tmp_path: Path, unmeasured_path: Path, generated: GenerationResult) -> Run:
    """A function that runs commands in an interpreter, with children, that lacks what
    others lack.
    """
    (tmp_path / "less").mkdir()
    (tmp_path / "less" / "sitecustomize.py").write_text(LESS)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(
            [str(tmp_path / "less"), str(Path(lagbench.__file__).parents[1])]
        ),
        "LAGBENCH_REGISTRY": str(unmeasured_path),
        "LAGBENCH_ROOT": str(generated.root),
        "CUDA_VISIBLE_DEVICES": "",
    }

    def call(*lines: str) -> None:
        done = subprocess.run(
            [sys.executable, "-c", COMMANDS],
            input="\n".join(lines),
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr

    return call


@pytest.mark.slow
def test_validating_and_scoring(
    commands: Run, bench: ScoreBench, tmp_path: Path
) -> None:
    """Scores are those of this system to the last digit, though files are read in
    children too.
    """
    bench.submit(tmp_path / "predictions.nc", straight)
    commands(
        "list",
        "info curl-noise",
        "validate predictions.nc",
        "score predictions.nc -o less-scores",
    )
    bench.score(tmp_path / "predictions.nc")
    paths = tmp_path / "less-scores/scores.json", tmp_path / "scores.json"
    actual, expected = (json.loads(path.read_bytes()) for path in paths)
    assert actual == expected


@pytest.mark.slow
def test_training_and_predicting(commands: Run, tmp_path: Path) -> None:
    """A training of two steps, its rollouts and their score."""
    commands(
        "train --baseline mlp --split curl-noise --size tiny --set "
        "training.steps=2 -o run",
        "predict run/weights.safetensors --no-bench",
        "score predictions.nc",
    )
    assert (tmp_path / "predictions/scores.json").is_file()


def test_systems_without_some_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit that the system does not have is not set; macOS refuses that of the
    address space.
    """
    wanted: list[int] = []
    monkeypatch.setattr(machine.sys, "platform", "darwin")
    monkeypatch.setattr(
        machine.resource, "setrlimit", lambda what, _: wanted.append(what)
    )
    machine.limit_process(memory=1, seconds=1)
    assert wanted == [machine.resource.RLIMIT_CORE, machine.resource.RLIMIT_CPU]
    monkeypatch.setattr(machine, "LIMITS", False)
    machine.limit_process(memory=1, seconds=1)
    assert len(wanted) == 2


def test_a_crash_on_windows_is_named_by_its_code() -> None:
    """There a process that reads where it may not ends with the code 0xC0000005, not
    with a signal.
    """
    assert "0xc0000005" in machine.describe_exit(0xC0000005, machine.MEMORY)


def test_where_no_workers_start_jobs_run_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs run in this process; an explicit pool is an error."""
    monkeypatch.setattr(pool, "AVAILABLE", False)
    found = run_all(lambda job, _: (job, os.getpid()), {"a": 1, "b": 2}, workers=2)
    assert found == [(job, os.getpid()) for job in (1, 2)]
    with pytest.raises(WorkFailedError):
        pool.Pool(2)
