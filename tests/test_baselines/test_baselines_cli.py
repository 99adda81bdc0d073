"""The commands train, predict and bench, as users and clusters call them."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import netCDF4
import pytest
from command_line import CliRunner, Result
from onnx_files import straight_on
from turns import of_this_turn

from lagbench.baselines.catalogue import list_names
from lagbench.baselines.checkpoint import load
from lagbench.cli.model_options import data_option
from lagbench.cli.program import app
from lagbench.errors import DataError, WorkFailedError
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.submission.validation import validate
from lagbench.work.machine import processor_name

Command = Callable[..., Result]


HUGE = ("--set", f"training.steps={10**40}")
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
    """Return the baselines that the tiny data of a full box can train."""
    return [name for name in list_names() if name != "hybrid-coarse"]


@pytest.mark.parametrize("baseline", of_this_turn(of_full_boxes(), turns=3))
def test_every_baseline_trains_and_predicts(lagbench: Command, baseline: str) -> None:
    """Two commands lead from a baseline's name to predictions that are valid and say
    their cost.
    """
    steps = ["--set", "training.steps=2", "--set", "training.validate_every=0"]
    is_fitted = baseline.startswith("var") or baseline == "hybrid-projection"
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
    assert validate("predictions.nc", isolated=False).valid


@pytest.mark.slow
def test_from_a_name_to_scores_in_words(lagbench: Command) -> None:
    """Without --json each command says what it did and which one comes next, down to
    the scores.
    """
    train = (
        "train",
        "curl-noise",
        "--size",
        "tiny",
        "--baseline",
        "gns",
        "--set",
        "training.steps=1",
    )
    trained = lagbench(*train)
    assert (
        "next: lagbench predict runs/curl-noise/tiny/gns-0/weights.safetensors"
        in trained.stdout
    )
    assert "hint: tiny is for tests" in trained.stdout
    assert "was over before" in lagbench(*train).stdout
    assert "was over before" not in trained.stdout
    predict = (
        "predict",
        "runs/curl-noise/tiny/gns-0/weights.safetensors",
        "--threads",
        "1",
        "--no-bench",
    )
    assert lagbench(*predict, "--set", "model.latent=7").exit_code == 2
    predicted = lagbench(*predict, "--set", "model.clamp=false")
    with netCDF4.Dataset("predictions.nc") as data:
        assert "model.clamp=false" in data.getncattr("training")
    assert "without the neighbour search" in predicted.stdout
    assert "in place of" not in predicted.stdout
    refused = lagbench(*predict)
    assert refused.exit_code == 2
    assert "--overwrite" in refused.stderr
    assert "in place of" in lagbench(*predict, "--overwrite").stdout
    assert "next: lagbench score predictions.nc" in predicted.stdout
    scored = lagbench("score", "predictions.nc", "--workers", "1", "--json")
    assert "position_rmse" in json.loads(scored.stdout)["rows"]["submission"]
    silent = ("--no-bench", "--quiet", "--threads", "1", "--overwrite")
    assert (
        lagbench(
            "predict", "runs/curl-noise/tiny/gns-0/checkpoint.safetensors", *silent
        ).stdout
        == ""
    )


def test_the_speed_up_needs_the_solver(
    lagbench: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without Taichi, predict prints that it knows no speed-up, and goes on."""
    lagbench("train", "--baseline", "gns", *TINY, "--set", "training.steps=1")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *rest: None if name == "taichi" else find(name, *rest),
    )
    predicted = lagbench(
        "predict", "runs/curl-noise/tiny/gns-0/weights.safetensors", "--threads", "1"
    )
    assert predicted.exit_code == 0
    assert "no speed-up" in predicted.stderr
    assert (
        json.loads(Path("predictions.json").read_text())["solver_seconds_per_frame"]
        is None
    )
    assert "lagbench[generate]" in predicted.stderr


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--baseline", "supergatt", *TINY), 2, "did you mean 'supergat'"),
        (TINY, 2, "--baseline gns"),
        (("--baseline", "gns", "--split", "curl-nose"), 2, "did you mean 'curl-noise'"),
        (
            ("--baseline", "gns", *TINY, "--set", "model.latant=3"),
            2,
            "did you mean 'model.latent'",
        ),
        (("--baseline", "gns", *TINY, "--recipe", "shrt"), 2, "no recipe"),
        (("--baseline", "gns", *TINY, *HUGE), 2, "training.steps"),
        (("--baseline", "gns", *TINY, "--device", "tpu"), 2, "no device 'tpu'"),
        (
            ("--baseline", "gns", "--split", "cavity", "--size", "mini"),
            4,
            "lagbench generate",
        ),
        (("--baseline", "gns", *TINY, "--output", "/proc/none"), 5, "--output"),
    ],
)
def test_mistakes_of_train(
    lagbench: Command,
    words: tuple[str, ...],
    code: int,
    message: str,
) -> None:
    """Every mistake has its exit code, and a message that says how to mend it. None
    leaves a folder.
    """
    result = lagbench("train", *words)
    assert result.exit_code == code
    assert message in result.stderr
    assert not Path("runs").exists()


def test_mistakes_of_predict(lagbench: Command, tmp_path: Path) -> None:
    """A pickle and a missing file are refused with 3."""
    (tmp_path / "bomb.safetensors").write_bytes(pickle.dumps(os.getcwd))
    assert (
        lagbench("predict", "bomb.safetensors").exit_code
        == lagbench("predict", "none.safetensors").exit_code
        == 3
    )


def test_an_onnx_file_predicts_what_the_options_ask_for(
    lagbench: Command, tmp_path: Path
) -> None:
    """The subset and the clock of the solver count; options of other models are
    refused.
    """
    straight_on(tmp_path / "lines.onnx")
    command = ("predict", "lines.onnx", "--split", "curl-noise", "--size", "tiny")
    no_shift = lagbench(*command, "--subset", "shift")
    assert no_shift.exit_code == 2
    assert "no scored subset 'shift'" in no_shift.stderr
    for words in (
        ("--set", "model.average=true"),
        ("--batch", "2"),
        ("--device", "cuda"),
        ("--threads", "2"),
    ):
        refused = lagbench(*command, *words)
        assert refused.exit_code == 2
        assert f"where: {words[0]}" in refused.stderr
    predicted = lagbench(*command, "--no-bench", "--device", "cpu", "--threads", "1")
    assert predicted.exit_code == 0, predicted.output
    assert "next: lagbench score predictions.nc\n" in predicted.stdout
    with netCDF4.Dataset("predictions.nc") as data:
        assert data.getncattr("device") == f"{processor_name()}, 1 thread"


@pytest.mark.slow
def test_an_onnx_file_is_timed_beside_the_solver(
    lagbench: Command, tmp_path: Path
) -> None:
    """The predictions state both times, so an entry can be compared with solvers."""
    straight_on(tmp_path / "lines.onnx")
    predicted = lagbench(
        "predict", "lines.onnx", "--split", "curl-noise", "--size", "tiny"
    )
    assert predicted.exit_code == 0, predicted.output
    assert "the model is" in predicted.stdout
    with netCDF4.Dataset("predictions.nc") as data:
        solver_seconds = data.getncattr("solver_seconds_per_frame")
        seconds = data.getncattr("seconds_per_frame")
    assert 0 < seconds < solver_seconds


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
        assert validate("predictions.nc", root=root, isolated=False).valid
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


@pytest.mark.slow
def test_bench_of_the_solver(lagbench: Command, original: LocalSplit) -> None:
    """The solver is timed in a process of its own; nothing else can be timed, and no
    local split.
    """
    done = command(
        "lagbench",
        "bench",
        "solver",
        "--split",
        "curl-noise",
        "--size",
        "tiny",
        "--frames",
        "3",
        "--json",
    )
    found = json.loads(done.stdout)
    assert found["particles"] == 506
    assert found["substeps"] == 12
    assert found["frames"] >= 3
    assert found["frames"] * found["seconds_per_frame"] >= 0.5
    # 506 particles x 12 substeps at 30 to 40 ns each: a fifth of a millisecond; never a
    # tenth of a second.
    assert 1e-5 < found["seconds_per_frame"] < 0.1
    assert lagbench("bench", "model", "--split", "curl-noise").exit_code == 2
    refused = lagbench("bench", "solver", "--split", str(original.folder))
    assert refused.exit_code == 2
    assert "simulated" in refused.stderr


def test_the_second_process_says_nothing(
    lagbench: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A helper of a training over several processes prints and writes nothing, no error
    either.
    """
    from lagbench.baselines import train
    from lagbench.baselines.machine import is_helper

    def told(error: BaseException, **ranks: str) -> tuple[int, str]:
        for name in ("RANK", "LOCAL_RANK"):
            monkeypatch.setenv(name, ranks.get(name, "0"))
        assert is_helper() == bool(ranks)
        monkeypatch.setattr(train, "train", Mock(side_effect=error))
        result = lagbench("train", "--baseline", "gns", *TINY)
        return result.exit_code, result.output

    full = WorkFailedError("out of memory")
    full.__cause__ = MemoryError()
    for error, code in (
        (KeyboardInterrupt(), 130),
        (WorkFailedError("the loss is not finite"), 5),
    ):
        assert told(error)[0] == code
        assert told(error)[1] != ""
        assert told(error, RANK="1", LOCAL_RANK="1") == (code, "")
    # What befell one process alone, and what another machine lacks, no other process
    # tells.
    assert "out of memory" in told(full, RANK="1", LOCAL_RANK="1")[1]
    assert "no data" in told(DataError("no data"), RANK="1")[1]
    assert told(KeyboardInterrupt(), RANK="1") == (130, "")


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


def test_a_root_with_a_space_is_quoted_in_the_next_command(tmp_path: Path) -> None:
    """A reader copies the command as it stands."""
    root = tmp_path / "my data"
    root.mkdir()
    assert shlex.split(data_option("cavity", root)) == ["--root", str(root)]
