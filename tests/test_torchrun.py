"""Training started by torchrun, as on several nodes."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from lagbench.make.generate import GenerationResult

torch = pytest.importorskip("torch", reason="the extra 'baselines' is not installed")

TRAIN = ("-m", "lagbench", "train", "--baseline", "mlp", "--split", "curl-noise", "--size", "tiny")


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return int(held.getsockname()[1])


@pytest.mark.slow
def test_two_nodes_make_the_weights_of_one_process(
    generated: GenerationResult, unmeasured_path: Path, tmp_path: Path
) -> None:
    """Two torchrun agents of one process each, three windows a step: the weights of six on one process.

    The gradient is the mean over the processes; by the linear scaling rule the one process takes
    twice the learning rate.
    """
    from lagbench.baselines.checkpoint import load

    there = {**os.environ, "LAGBENCH_REGISTRY": str(unmeasured_path), "CUDA_VISIBLE_DEVICES": ""}
    there |= {"OMP_NUM_THREADS": "1", "LAGBENCH_ROOT": str(generated.root)}
    common = [*TRAIN, "--threads", "1", "--set", "model.widths=[32]", "--set", "training.steps=8"]
    common += [
        "--set",
        "training.validate_every=0",
        "--set",
        "training.schedule=constant",
        "--set",
        "model.noise_std=0",
    ]

    def start(*words: str) -> subprocess.Popen[str]:
        pipe = subprocess.PIPE
        return subprocess.Popen(
            [sys.executable, *words], env=there, cwd=tmp_path, stdout=pipe, stderr=pipe, text=True
        )

    address = f"127.0.0.1:{free_port()}"
    rendezvous = ["--rdzv-backend", "c10d", "--rdzv-endpoint", address, "--rdzv-id", "lagbench"]
    nodes = [
        start(
            *("-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1", *rendezvous),
            *(*common, "-o", "shared", "--set", "training.batch=3", "--set", "training.learning_rate=0.001"),
        )
        for _ in range(2)
    ]
    told = [node.communicate() for node in nodes]
    assert [node.returncode for node in nodes] == [0, 0], told
    assert "".join(out for out, _ in told).count("finished, step 8 of 8") == 1
    alone = start(
        *(*common, "-o", "alone", "--set", "training.batch=6", "--set", "training.learning_rate=0.002")
    )
    told.append(alone.communicate())
    assert alone.returncode == 0, told[-1]
    shared, one = (load(tmp_path / name / "checkpoint.pt").weights for name in ("shared", "alone"))
    assert json.loads((tmp_path / "shared" / "training.json").read_text())["processes"] == 2
    for name, value in one.items():
        # Adam's step where a gradient is nearly nothing follows its rounding: compare norms, not numbers.
        assert (shared[name] - value).norm() <= 1e-4 * value.norm(), name
