"""The commands around submissions: template, validate, score, compare."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import netCDF4
import pytest
from command_line import Result
from conftest import SIZE, SPLIT

from lagbench.make.generate import GenerationResult
from lagbench.scoring import score

Run = Callable[..., Result]


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, generated: GenerationResult) -> Run:
    """A function that runs lagbench on a generated data set without hashes."""
    monkeypatch.setenv("LAGBENCH_ROOT", str(generated.root))
    return run


@pytest.fixture
def predictions(run: Run, tmp_path: Path) -> Path:
    """The template of a submission."""
    path = tmp_path / "predictions.nc"
    result = run("template", "--split", SPLIT, "--size", SIZE, "-o", path)
    assert result.exit_code == 0
    return path


@pytest.mark.slow
def test_a_template_validates_and_scores(run: Run, predictions: Path) -> None:
    """The output names references, metrics and files."""
    assert run("validate", predictions).exit_code == 0
    result = run("score", predictions, "--all")
    assert result.exit_code == 0
    for word in ("persistence", "vorticity_rmse", "copy_suspect", "scores.nc"):
        assert word in result.stdout


def test_json_is_the_file(run: Run, predictions: Path) -> None:
    """``--json`` prints the content of scores.json; ``--output`` moves both files."""
    folder = predictions.parent / "scores"
    result = run("score", predictions, "--json", "--output", folder)
    content = json.loads((folder / "scores.json").read_text())
    assert json.loads(result.stdout) == content
    names = {path.name for path in folder.iterdir()}
    assert names == {"scores.json", "scores.nc"}
    assert not (predictions.parent / "scores.json").exists()


def test_a_template_replaces_predictions_only_on_request(
    run: Run, predictions: Path
) -> None:
    """The default size is the only one that is on the disk."""
    with netCDF4.Dataset(predictions, "a") as file:
        file.setncattr("method", "the-work-of-a-week")
    before = predictions.read_bytes()
    arguments = ("template", SPLIT, "-o", predictions)
    assert run(*arguments).exit_code == 2
    assert predictions.read_bytes() == before
    assert run(*arguments, "--overwrite").exit_code == 0
    assert predictions.read_bytes() != before
    assert run("validate", predictions).exit_code == 0


@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_score_and_validate_agree_on_unreadable_files(
    run: Run, predictions: Path, damage: str
) -> None:
    """The message is one line, without a traceback, and names the file once."""
    if damage == "truncated":
        predictions.write_bytes(predictions.read_bytes()[:20_000])
    else:
        predictions.unlink()
    result = run("score", predictions)
    assert result.exit_code == 3
    assert run("validate", predictions).exit_code == 3
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.count(str(predictions)) == 1
    assert "Traceback" not in result.output


def test_score_names_every_error_once(run: Run, predictions: Path) -> None:
    with h5py.File(predictions, "r+") as file:
        file.attrs["dataset_version"] = "99.0.0"
        file.attrs["seconds_per_frame"] = -1.0
    result = run("score", predictions)
    assert result.exit_code == 4
    for name in ("dataset_version", "seconds_per_frame"):
        assert result.stderr.count(f"'{name}'") == 1


@pytest.mark.parametrize("method", ["[/b]", "[red]x[/red]"])
def test_names_are_no_markup(run: Run, predictions: Path, method: str) -> None:
    """Titles and heads of columns print square brackets as they are."""
    with h5py.File(predictions, "r+") as file:
        file.attrs["method"] = method
    scored = run("score", predictions)
    assert scored.exit_code == 0, scored.stderr
    assert f"{method} on {SPLIT}" in scored.stdout


@pytest.fixture
def two_submissions(predictions: Path) -> list[Path]:
    """Copies of a submission under one name in two folders."""
    paths = []
    for folder_name in ("a", "b"):
        path = predictions.parent / folder_name / "p.nc"
        path.parent.mkdir()
        shutil.copyfile(predictions, path)
        paths.append(path)
    return paths


@pytest.mark.slow
def test_several_files_keep_their_scores(
    run: Run, two_submissions: list[Path], tmp_path: Path
) -> None:
    """Scores go beside each file, the page into the report folder."""
    report = tmp_path / "report"
    result = run("score", *two_submissions, "--report", report)
    assert result.exit_code == 0, result.stderr
    for path in two_submissions:
        names = {file.name for file in (path.parent / "p").iterdir()}
        assert names == {"scores.json", "scores.nc"}
    assert [path.name for path in report.iterdir()] == ["index.html"]


@pytest.mark.parametrize("option", ["--output", "--report"])
def test_an_unusable_folder_is_an_error_before_the_work(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    """A file is in the place of the folder."""
    monkeypatch.setattr(score, "run_all", None)
    file = predictions.parent / "taken"
    file.write_text("")
    result = run("score", predictions, option, file)
    assert result.exit_code == 5
