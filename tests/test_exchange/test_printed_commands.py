"""The commands that `adopt` prints train a model on any data that it takes."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Result
from exchange_readers import straight_runs

from lagbench.baselines.catalogue import list_names

Run = Callable[..., Result]

FEW_STEPS = (
    "--set",
    "training.steps=1",
    "--set",
    "training.validation_frames=2",
    "--set",
    "training.validation_scenarios=1",
)

KINDS = {
    "walls": "",
    "a periodic square": "--periodic x,y --bounds 0,1,0,1",
    "a cube": "",
    "a periodic cube": "--periodic x,y,z --bounds 0,1,0,1,0,1",
    "unequal counts": "",
    "several materials": "",
}
"""Options of `adopt` by the kind of data."""


def write_runs(folder: Path, kind: str) -> list[Path]:
    """Write twelve trajectories of a kind."""
    paths = []
    for number, run in enumerate(straight_runs(12, frames=20, particles=200)):
        positions = run
        if "cube" in kind:
            positions = np.concatenate([run, run[..., :1]], axis=-1)
        if kind == "unequal counts":
            positions = run[:, : 180 + number]
        path = folder / f"run{number:02d}.npz"
        material = np.zeros(positions.shape[1], np.int8)
        if kind == "several materials":
            # jelly in even runs, snow in odd ones, and liquid in all
            material[::2] = 1 + number % 2
        np.savez(path, position=positions, material=material)
        paths.append(path)
    return paths


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_printed_commands_train(
    kind: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NeuralMPM and a graph network learn from walls, periods, cubes, any counts, and
    any materials.
    """
    monkeypatch.chdir(tmp_path)
    paths = write_runs(tmp_path, kind)
    options = ("--radius", "0.1", "--frame-interval", "0.1", *KINDS[kind].split())
    adopted = run("adopt", *paths, "-o", "own", *options)
    assert adopted.exit_code == 0, adopted.stderr

    commands = [line.strip() for line in adopted.stdout.splitlines()]
    (recipe_command,) = [line for line in commands if line.startswith("echo ")]
    subprocess.run(recipe_command, shell=True, check=True)
    train_commands = [line for line in commands if line.startswith("lagbench train ")]
    baselines = set()
    for command in train_commands:
        words = shlex.split(command)[1:]
        trained = run(*words, *FEW_STEPS)
        assert trained.exit_code == 0, trained.stderr
        baselines.add(words[words.index("--baseline") + 1])
    assert baselines == {"gns", "neuralmpm"}


@pytest.mark.slow
@pytest.mark.parametrize("baseline", list_names())
def test_every_baseline_takes_the_printed_recipe(
    baseline: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recipe fitted graph networks only.

    The baselines that contain a solver refuse these data: one knows full boxes, the
    other the free surfaces of lagbench.
    """
    monkeypatch.chdir(tmp_path)
    paths = write_runs(tmp_path, "walls")
    options = ("--radius", "0.1", "--frame-interval", "0.1")
    adopted = run("adopt", *paths, "-o", "own", *options)
    assert adopted.exit_code == 0, adopted.stderr

    commands = [line.strip() for line in adopted.stdout.splitlines()]
    (recipe_command,) = [line for line in commands if line.startswith("echo ")]
    subprocess.run(recipe_command, shell=True, check=True)
    train_command = next(
        line for line in commands if line.startswith("lagbench train ")
    )
    words = shlex.split(train_command)[1:]
    words[words.index("--baseline") + 1] = baseline
    is_fitted = baseline.startswith(("var", "hybrid"))  # without steps
    few_steps = () if is_fitted else FEW_STEPS
    trained = run(*words, *few_steps)
    if baseline == "hybrid-projection":
        assert trained.exit_code == 2
        assert "full boxes only" in trained.stderr
    elif baseline == "hybrid-coarse":
        assert trained.exit_code == 2
        assert "free surfaces of lagbench only" in trained.stderr
    else:
        assert trained.exit_code == 0, trained.stderr


def test_a_model_of_whole_frames_refuses_unequal_counts(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """VAR failed over the shapes of its arrays."""
    monkeypatch.chdir(tmp_path)
    paths = write_runs(tmp_path, "unequal counts")
    adopted = run(
        "adopt", *paths, "-o", "own", "--radius", "0.1", "--frame-interval", "0.1"
    )
    assert adopted.exit_code == 0, adopted.stderr
    recipe = "{format: 1, recipes: {own/full: {}}}"
    (tmp_path / "recipe.yaml").write_text(recipe)
    for baseline in ("var", "var-stable"):
        words = ("--baseline", baseline, "--split", "own/", "--recipe", "recipe.yaml")
        trained = run("train", *words)
        assert trained.exit_code == 4
        assert "neuralmpm" in trained.stderr
