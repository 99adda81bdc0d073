"""The demo: data, model, scores and a leaderboard page from nothing, and once more."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from command_line import Result
from conftest import SIZE, SPLIT
from turns import PROGRAMS

from lagbench.cli import demo
from lagbench.cli.solver_bench import SolverBench
from lagbench.data.registry import Registry, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UsageError, WorkFailedError
from lagbench.references import references_of

Run = Callable[..., Result]

# On data without shipped scores the scorer measures the naive predictors only.
NAIVE_NAMES = [
    reference.name
    for reference in references_of(load().size(SPLIT, SIZE))
    if reference.counts
]

SOLVER_BENCH = SolverBench(
    split=SPLIT,
    size=SIZE,
    particles=1,
    substeps=1,
    frames=1,
    seconds_per_frame=0.5,
)


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """A function that runs lagbench in an empty folder, without recorded hashes."""
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return run


@pytest.fixture
def small_registry(
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
    unmeasured_path: Path,
    tmp_path: Path,
) -> Registry:
    """A registry of two splits, of which one has a size tiny; the demo uses it.

    Its model trains quickly.
    """
    registry = read_yaml(unmeasured_path)
    small = registry["splits"][SPLIT]
    large = {**small, "sizes": {"full": small["sizes"]["full"]}}
    splits = {"large": large, SPLIT: small}
    path = tmp_path / "datasets.yaml"
    # JSON is YAML
    path.write_text(json.dumps({**registry, "splits": splits}))
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(path))
    monkeypatch.setattr(demo, "MODEL_SPLIT", SPLIT)
    monkeypatch.setattr(demo, "SETTINGS", ("training.steps=2", "model.width=4"))
    monkeypatch.setattr(demo, "bench_in_own_process", lambda *_: SOLVER_BENCH)
    return load(path)


@pytest.fixture
def no_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let torch be missing."""

    def refuse(_: tuple[str, ...]) -> None:
        raise UsageError("torch is not installed", fix="pip install it")

    monkeypatch.setattr(demo, "require_libraries", refuse)


def run_demo(root: Path, run: Run) -> Any:
    """Return what the demo prints with --json."""
    result = run("demo", "--root", root, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_the_demo_takes_the_splits_of_size_tiny(small_registry: Registry) -> None:
    assert demo.demo_splits(small_registry) == [SPLIT]
    assert demo.explain_missing_model(small_registry) is None


def test_a_registry_without_the_model_split_gives_no_model(
    small_registry: Registry,
) -> None:
    registry = Registry({"large": small_registry.split("large")}, {})
    reason = demo.explain_missing_model(registry)
    assert f"{SPLIT} {SIZE}" in str(reason)


def test_a_solver_that_cannot_be_timed_gives_no_speed_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: str) -> SolverBench:
        raise WorkFailedError("the solver could not be timed")

    monkeypatch.setattr(demo, "bench_in_own_process", fail)
    assert demo.bench_demo_solver() is None


@pytest.mark.slow
@pytest.mark.usefixtures("small_registry", "no_torch")
def test_without_torch_the_demo_makes_data_only(
    run: Run, copied: Callable[[], Path]
) -> None:
    """One line says how to install the rest; no leaderboard is made."""
    root = copied()
    result = run("demo", "--root", root)
    assert result.exit_code == 0, result.output
    hints = [line for line in result.stdout.splitlines() if "pip install" in line]
    assert any("torch" in hint for hint in hints)
    assert not (root / "leaderboard").exists()

    data = run_demo(root, run)
    assert data["model"] is None
    assert "torch" in data["model_left_out"]
    assert list(data["splits"]) == [SPLIT]
    split = data["splits"][SPLIT]
    assert split["generation"]["kept"] == [0, 1, 2, 3, 4]
    assert Path(split["picture"]).is_file()


@pytest.mark.usefixtures("small_registry")
@pytest.mark.slow
def test_the_demo_ends_with_a_leaderboard_of_its_own(
    run: Run, copied: Callable[[], Path]
) -> None:
    """Model and references are on its page, and the current folder stays empty.

    A second run gives the same entry.
    """
    root = copied()
    first = run_demo(root, run)["model"]
    result = run("demo", "--root", root)
    assert result.exit_code == 0, result.output
    page = root / "leaderboard" / "index.html"
    assert f"leaderboard page: {page}" in result.stdout.splitlines()
    html = page.read_text()
    for name in (*NAIVE_NAMES, "NeuralMPM, 2 steps"):
        assert name in html
    assert list(Path.cwd().iterdir()) == []

    submissions = root / "leaderboard" / "submissions"
    entry = yaml.safe_load((submissions / SPLIT / SIZE / "neuralmpm.yaml").read_text())
    assert entry["cost"]["solver_seconds_per_frame"] == 0.5
    checked = run("leaderboard", "check", "--board", root / "leaderboard")
    assert checked.exit_code == 0, checked.output

    second = run_demo(root, run)["model"]
    first_step = first["training"]["step"]
    assert second["training"] == {**first["training"], "first_step": first_step}
    card = second["card"]
    assert card["predictions_sha256"] == first["card"]["predictions_sha256"]
    assert card["rows"] == first["card"]["rows"]
    assert second["page"]["rows"] == 1
    assert second["page"]["tabs"] == 1
    ranking_score = card["rows"]["submission"][card["ranking_metric"]]
    assert second["entry"]["mean"] == pytest.approx(ranking_score["mean"], rel=1e-5)


@pytest.mark.usefixtures("small_registry")
@pytest.mark.slow
def test_a_training_of_another_version_is_trained_anew(
    copied: Callable[[], Path],
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A damaged checkpoint, and one of another recipe, are no errors."""
    root = copied()
    run_demo(root, run)
    checkpoint = root / "runs" / f"{SPLIT}-neuralmpm" / "checkpoint.safetensors"
    checkpoint.write_bytes(b"damaged")
    assert demo.demo_model(root=root).training.state == "finished"

    monkeypatch.setattr(demo, "SETTINGS", ("training.steps=3", "model.width=4"))
    training = demo.demo_model(root=root).training
    assert training.state == "finished"
    assert training.step == training.steps == 3
    assert torch.load(training.weights, weights_only=True)


def test_another_leaderboard_is_refused_before_the_work(
    run: Run, tmp_path: Path
) -> None:
    """A folder with entries of another size is left alone, and nothing is generated."""
    submissions = tmp_path / "leaderboard" / "submissions"
    entry = submissions / "cavity" / "mini" / "mine.yaml"
    entry.parent.mkdir(parents=True)
    entry.touch()
    result = run("demo", "--root", tmp_path)
    assert result.exit_code == 2, result.output
    assert "submissions/cavity/mini/mine.yaml" in result.stderr
    assert not (tmp_path / "cavity").exists()


@pytest.mark.slow
@pytest.mark.skipif("demo" not in PROGRAMS, reason="not in this turn")
def test_the_whole_demo_from_nothing(run: Run, tmp_path: Path) -> None:
    """It gives four verified data sets, and a model that beats the naive baselines."""
    data = run_demo(tmp_path / "demo", run)
    splits = data["splits"]
    assert list(splits) == ["cavity", "curl-noise", "fluid", "multimaterial"]
    for split in splits.values():
        assert split["verification"]["problems"] == []
    model = data["model"]
    assert model["training"]["split"] == "cavity"
    assert model["solver"]["seconds_per_frame"] > 0
    assert model["card"]["skill"]["value"] > 0.2
    page = model["page"]
    assert page["rows"] == 1
    assert page["tabs"] == 1
    assert Path(page["page"]).stat().st_size == page["bytes"]
