"""The commands around submissions: template, validate, score, compare."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT
from typer.testing import CliRunner, Result

from lagbench.cli.app import app
from lagbench.generation import GenerationResult

COMMANDS = ["template", "validate", "score", "compare"]
Run = Callable[..., Result]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, unmeasured_path: Path, generated: GenerationResult) -> Run:
    """A function that runs lagbench on the generated data set with no recorded hashes."""
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(unmeasured_path))
    monkeypatch.setenv("LAGBENCH_ROOT", str(generated.root))
    monkeypatch.delenv("LAGBENCH_DEBUG", raising=False)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def predictions(run: Run, tmp_path: Path) -> Path:
    """The template of a submission."""
    path = tmp_path / "predictions.nc"
    assert run("template", "--split", SPLIT, "--size", SIZE, "-o", path).exit_code == 0
    return path


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example(run: Run, name: str) -> None:
    """Each command's help ends with an example of it."""
    assert f"Example: lagbench {name} " in run(name, "--help").stdout


def test_from_template_to_tables(run: Run, predictions: Path) -> None:
    """A template validates, scores, and its tables name floors, undefined frames, flags and files."""
    assert run("validate", predictions).exit_code == 0
    result = run("score", predictions)
    assert result.exit_code == 0
    for word in (
        "persistence",
        "velocity",
        "vorticity_rmse",
        "40 of 40",
        "1/frame",
        "flag copy_suspect",
        "scores.nc",
    ):
        assert word in result.stdout
    assert result.stderr == ""


def test_json_is_the_file(run: Run, predictions: Path) -> None:
    """Score --json prints what scores.json holds; --output moves both files; --quiet prints nothing."""
    folder = predictions.parent / "scores"
    result = run("score", predictions, "--json", "--output", folder)
    assert json.loads(result.stdout) == json.loads((folder / "scores.json").read_text())
    assert {path.name for path in folder.iterdir()} == {"scores.json", "scores.nc"}
    assert not (predictions.parent / "scores.json").exists()
    assert run("score", predictions, "--quiet").stdout == ""


def test_all_shows_every_metric(run: Run, predictions: Path) -> None:
    """The short tables leave metrics out that --all shows."""
    assert "vorticity_residual_p05" not in run("score", predictions).stdout
    assert "vorticity_residual_p05" in run("score", predictions, "--all").stdout


def test_compare_says_that_two_scenarios_are_few(run: Run, predictions: Path) -> None:
    """With two scenarios no significance is claimed, in words and as null in JSON."""
    run("score", predictions)
    result = run("compare", predictions.parent, "constant-velocity")
    assert result.exit_code == 0
    assert "no significance is claimed under 6" in result.stdout
    said = json.loads(run("compare", predictions.parent, "constant-velocity", "--json").stdout)
    assert said["metrics"]["vorticity_rmse"]["p"] is None
    assert run("compare", predictions.parent, "constant-velocity", "--metric", "mse").exit_code == 2


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda path: path.write_text("text"), 3),
        (lambda path: path.unlink(), 3),
        (lambda path: path.write_bytes(path.read_bytes()[:20_000]), 3),
    ],
)
def test_unreadable_files(run: Run, predictions: Path, make: Callable[[Path], object], code: int) -> None:
    """Score and validate agree on the exit code of a bad file, and say what to do, not where it broke."""
    make(predictions)
    scored, validated = run("score", predictions), run("validate", predictions)
    assert scored.exit_code == validated.exit_code == code
    assert "fix:" in scored.stderr
    assert "Traceback" not in scored.stderr + scored.stdout


def test_a_root_without_data(run: Run, predictions: Path, tmp_path: Path) -> None:
    """Scoring without the test subset exits with 4 and names the command that generates it."""
    result = run("score", predictions, "--root", tmp_path / "empty")
    assert result.exit_code == 4
    assert "lagbench generate" in result.stderr
