"""The commands train, predict and bench, as users and clusters call them."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from command_line import CliRunner, Result
from onnx_files import straight_on
from turns import of_this_turn

from lagbench.baselines.catalogue import list_names
from lagbench.baselines.checkpoint import load
from lagbench.cli.program import app
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.submission.validation import validate

Command = Callable[..., Result]


TINY = ("--split", "curl-noise", "--size", "tiny", "--threads", "1")


@pytest.fixture
def lagbench(
    generated: GenerationResult,
    unmeasured_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Command:
    """Run a command on the tiny curl-noise data, in an empty folder."""
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(unmeasured_path))
    monkeypatch.setenv("LAGBENCH_ROOT", str(generated.root))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.chdir(tmp_path)

    def call(*words: str) -> Result:
        return CliRunner().invoke(app, list(words))

    return call


def of_full_boxes() -> list[str]:
    """Return the baselines that are trained; nothing fits hybrids any more.

    VAR takes a minute, and is fitted as VAR-stable is.
    """
    names = []
    for name in list_names():
        if name != "var" and not name.startswith("hybrid"):
            names.append(name)
    return names


@pytest.mark.parametrize("baseline", of_this_turn(of_full_boxes(), turns=3))
def test_every_baseline_trains_and_predicts(lagbench: Command, baseline: str) -> None:
    """Two commands lead from a baseline's name to predictions that are valid and say
    their cost.
    """
    steps = ["--set", "training.steps=2", "--set", "training.validate_every=0"]
    is_fitted = baseline.startswith("var")
    settings = [] if is_fitted else steps
    trained = lagbench("train", "--baseline", baseline, *TINY, *settings, "--json")
    assert trained.exit_code == 0, trained.output
    result = json.loads(trained.stdout)
    assert result["folder"] == f"runs/curl-noise/tiny/{baseline}-0"
    predicted = lagbench(
        "predict", result["weights"], "--threads", "1", "--no-bench", "--json"
    )
    assert predicted.exit_code == 0, predicted.output
    assert json.loads(predicted.stdout)["seconds_per_frame"] > 0
    assert validate("predictions.nc").valid


@pytest.mark.slow
def test_a_local_split_is_predicted_by_its_folder(
    lagbench: Command, original: LocalSplit, tmp_path: Path
) -> None:
    """--split names the folder, for weights and for ONNX; another split is refused."""
    folder = f"{original.folder}/"
    recipe = "{format: 1, recipes: {own/full: {training: {steps: 1}}}}"
    (tmp_path / "recipe.yaml").write_text(recipe)
    trained = lagbench(
        *("train", "--baseline", "mlp", "--split", folder, "--threads", "1"),
        *("--recipe", "recipe.yaml", "--set", "training.validate_every=0", "-o", "run"),
    )
    assert trained.exit_code == 0, trained.output
    assert (
        f"next: lagbench predict run/weights.safetensors --split {folder} "
        in trained.stdout
    )
    weights = ("predict", "run/weights.safetensors", "--threads", "1", "--overwrite")
    lost = lagbench(*weights)
    assert lost.exit_code == 4
    assert "--split FOLDER" in lost.stderr
    straight_on(tmp_path / "lines.onnx")
    for words in (weights, ("predict", "lines.onnx", "--overwrite")):
        predicted = lagbench(*words, "--split", folder)
        assert predicted.exit_code == 0, predicted.output
        assert f"next: lagbench score predictions.nc --split {folder}" in (
            predicted.stdout
        )
        root = original.folder.parent
        assert validate("predictions.nc", root=root).valid
    other = lagbench(*weights, "--split", "curl-noise")
    assert other.exit_code == 2
    assert "where: --split" in other.stderr


def command(*words: str) -> subprocess.CompletedProcess[str]:
    """Run Python's module in a process of its own, on one thread."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", *words]
    return subprocess.run(
        line,
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
    )


SHARED = (
    "model.widths=[8]",
    "model.noise_std=0",
    "training.steps=8",
    "training.validate_every=0",
)
"""A training that takes no time."""


def launched(*words: str, nodes: int) -> list[subprocess.CompletedProcess[str]]:
    """Return what one or two torchrun agents, of two processes, made of a command."""
    with socket.socket() as held:  # a port that nobody listens on
        held.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{held.getsockname()[1]}"
    agent = [
        "torch.distributed.run",
        "--nnodes",
        str(nodes),
        "--nproc-per-node",
        str(2 // nodes),
        "--rdzv-id",
        "lagbench",
    ]
    agent += [
        "--rdzv-backend",
        "c10d",
        "--rdzv-endpoint",
        address,
        "-m",
        "lagbench",
        *words,
    ]
    with ThreadPoolExecutor() as both:
        return list(both.map(lambda _: command(*agent), range(nodes)))


@pytest.mark.slow
@pytest.mark.parametrize("nodes", of_this_turn([1, 2], turns=2))
def test_two_processes_make_the_weights_of_one(
    lagbench: Command,
    tmp_path: Path,
    nodes: int,
) -> None:
    """Three windows on each of two gloo processes give the weights of six on one, at
    twice the rate.

    The gradient is the mean over processes (thesis section 5.7.3).
    """

    def options(folder: str, batch: int, rate: float) -> tuple[str, ...]:
        keys = (*SHARED, "training.schedule=constant", f"training.batch={batch}")
        settings = [
            word
            for key in (*keys, f"training.learning_rate={rate}")
            for word in ("--set", key)
        ]
        return "train", "--baseline", "mlp", *TINY, "-o", folder, *settings

    together = options("shared", 3, 1e-3)
    shared = launched(*together, nodes=nodes)
    assert [one.returncode for one in shared] == [0] * nodes, [
        one.stderr for one in shared
    ]
    assert "".join(one.stdout for one in shared).count("finished, step 8 of 8") == 1
    assert (
        json.loads((tmp_path / "shared" / "training.json").read_text())["processes"]
        == 2
    )
    assert lagbench(*options("alone", 6, 2e-3)).exit_code == 0
    one, other = (
        load(tmp_path / name / "checkpoint.safetensors").weights
        for name in ("shared", "alone")
    )
    assert one.keys() == other.keys()
    for name, value in one.items():
        # Adam's step where a gradient is nearly nothing follows its rounding: compare
        # norms, not numbers.
        assert (value - other[name]).norm() <= 1e-4 * value.norm(), name
