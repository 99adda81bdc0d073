"""The commands around submissions: template, validate, score, compare."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest
import typer
from conftest import SIZE, SPLIT
from typer.main import get_command
from typer.testing import Result

import lagbench
from lagbench import submission
from lagbench.cli.app import app
from lagbench.make.generate import GenerationResult
from lagbench.scoring import score
from lagbench.submission import validation

Run = Callable[..., Result]


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, generated: GenerationResult) -> Run:
    """A function that runs lagbench on the generated data set with no recorded hashes."""
    monkeypatch.setenv("LAGBENCH_ROOT", str(generated.root))
    return run


@pytest.fixture
def predictions(run: Run, tmp_path: Path) -> Path:
    """The template of a submission."""
    path = tmp_path / "predictions.nc"
    assert run("template", "--split", SPLIT, "--size", SIZE, "-o", path).exit_code == 0
    return path


def test_from_template_to_tables(run: Run, predictions: Path) -> None:
    """A template validates, scores, and its tables name floors, undefined frames, flags and files."""
    assert run("validate", predictions).exit_code == 0
    result = run("score", predictions)
    assert result.exit_code == 0
    for word in (
        "persistence",
        "velocity",
        "vorticity_rmse",
        "vorticity_pearson 40",
        "1/frame",
        "flag copy_suspect",
        "scores.nc",
    ):
        assert word in result.stdout
    assert all("scenarios" in line for line in result.stderr.splitlines())  # progress, on a slow machine


def test_json_is_the_file(run: Run, predictions: Path) -> None:
    """Score --json prints what scores.json holds; --output moves both files; --quiet prints nothing."""
    folder = predictions.parent / "scores"
    result = run("score", predictions, "--json", "--output", folder)
    assert json.loads(result.stdout) == json.loads((folder / "scores.json").read_text())
    assert {path.name for path in folder.iterdir()} == {"scores.json", "scores.nc"}
    assert not (predictions.parent / "scores.json").exists()
    assert run("score", predictions, "--quiet").stdout == ""


def test_a_template_keeps_what_is_there(run: Run, predictions: Path) -> None:
    """Predictions are not replaced unless one says so."""
    predictions.write_bytes(b"the work of a week")
    words = ("template", "--split", SPLIT, "--size", SIZE, "-o", predictions)
    assert run(*words).exit_code == 2
    assert predictions.read_bytes() == b"the work of a week"
    assert run(*words, "--overwrite").exit_code == 0
    assert run("validate", predictions).exit_code == 0


def test_the_only_size_there_is_the_default(run: Run, tmp_path: Path) -> None:
    """One size lies here; where there is none, the message has sizes and the command."""
    target = tmp_path / "t.nc"
    assert run("template", SPLIT, "-o", target).exit_code == 0
    assert target.is_file()
    nothing = run("template", SPLIT, "-o", tmp_path / "u.nc", "--root", tmp_path / "empty")
    assert nothing.exit_code == 2
    assert f"lagbench generate --split {SPLIT} --size" in nothing.stderr


def test_scores_are_called_as_their_predictions(run: Run, predictions: Path) -> None:
    """Scores of gns.nc lie in gns/; those of another method are never written over."""
    other = predictions.with_name("gns.nc")
    shutil.copy(predictions, other)
    with h5py.File(other, "a") as file:
        file.attrs["method"] = "gns"
    assert run("score", predictions).exit_code == 0
    assert run("score", predictions).exit_code == 0
    kept = predictions.with_name("scores.json").read_bytes()
    assert run("score", other).exit_code == 0
    assert (predictions.parent / "gns" / "scores.nc").is_file()
    refused = run("score", other, "--output", predictions.parent)
    assert refused.exit_code == 2
    assert "persistence" in refused.stderr
    assert predictions.with_name("scores.json").read_bytes() == kept


def test_files_of_ours_that_are_no_predictions_are_named(
    run: Run, predictions: Path, generated: GenerationResult
) -> None:
    """One finding says what scores.nc and a scenario file are, and nothing else is said of them."""
    run("score", predictions)
    scenario = next(generated.folder.glob("test/*.nc"))
    for path in (predictions.with_name("scores.nc"), scenario):
        result = submission.validate(path)
        assert [finding.check for finding in result.findings] == ["readable"]
        assert result.exit_code == 3
        assert run("validate", path).exit_code == 3


def too_wide(text: str) -> list[str]:
    """Return lines wider than 80 columns, colours left out, but paths and remarks."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", text).split("\n")
    return [line for line in lines if len(line.rstrip()) > 80 and not re.search(r":|\w/\w+/", line)]


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands take their output for a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda _: True))


@pytest.mark.usefixtures("terminal")
def test_tables_fit_eighty_columns(run: Run, predictions: Path) -> None:
    """No line of any table is wider, with every metric and every floor too."""
    run("score", predictions)
    board = Path(lagbench.__file__).parents[1] / "leaderboard"
    for words in (
        ("score", predictions),
        ("score", predictions, "--all", "--all-floors"),
        ("compare", predictions.parent, "analog", "--all"),
        ("list",),
        ("info", "cavity"),
        ("info", SPLIT, "--size", SIZE),
        ("verify", SPLIT, "--size", SIZE),
        ("leaderboard", "show", "--board", board),
    ):
        result = run(*words)
        assert result.exit_code == 0, result.output
        assert result.stdout
        assert (words, too_wide(result.stdout)) == (words, [])


def commands(group: Any, *before: str) -> Iterator[tuple[str, ...]]:
    """Yield the words of every command below a group."""
    for name, command in group.commands.items():
        yield from commands(command, *before, name) if hasattr(command, "commands") else [(*before, name)]


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("words", [(), ("leaderboard",), *commands(get_command(app))], ids=" ".join)
def test_help_fits_eighty_columns(run: Run, words: tuple[str, ...]) -> None:
    """The help of each command, and of those above, is told in 80 columns."""
    result = run(*words, "--help")
    assert result.exit_code == 0
    assert [line for line in result.stdout.split("\n") if too_wide(line.replace(":", "."))] == []


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


def copies(predictions: Path, *names: str) -> list[Path]:
    """Return copies of a submission under these names beside it."""
    paths = [predictions.parent / name for name in names]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        shutil.copyfile(predictions, path)
    return paths


@pytest.mark.parametrize("method", ["[/b]", "[red]x[/red]", "a [link=http://b]"])
def test_names_are_no_markup(run: Run, predictions: Path, method: str) -> None:
    """A method's name with square brackets is printed as it is, in titles and heads of columns."""
    with h5py.File(predictions, "r+") as file:
        file.attrs["method"] = method
    scored = run("score", predictions)
    assert scored.exit_code == 0, scored.stderr
    assert f"{method} on {SPLIT}" in scored.stdout
    compared = run("compare", predictions.parent, "persistence")
    assert compared.exit_code == 0, compared.stderr
    title, head = (line for line in compared.stdout.splitlines() if method in line)
    assert title.startswith(f"{method} against persistence")
    assert head.split()[0] == "metric"


def test_several_files_keep_their_scores(run: Run, predictions: Path) -> None:
    """Equal names in two folders: scores go beside each file, the page alone into the report folder."""
    paths = copies(predictions, "a/p.nc", "b/p.nc")
    rep = predictions.parent / "rep"
    result = run("score", *paths, "--report", rep)
    assert result.exit_code == 0, result.stderr
    for path in paths:
        assert {held.name for held in (path.parent / "p").iterdir()} == {"scores.json", "scores.nc"}
    assert [path.name for path in rep.iterdir()] == ["index.html"]


def test_a_reader_that_leaves_early_leaves_the_report(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``score --report R | head`` closes the pipe after ten lines: by then the report is there."""

    def gone(*_: object, **__: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(typer, "echo", gone)
    run("score", predictions, "--report", predictions.parent / "rep")
    assert (predictions.parent / "rep" / "index.html").is_file()


def test_scores_never_share_a_folder(run: Run, predictions: Path) -> None:
    """Two files whose scores would overwrite each other are a usage error before any is scored."""
    first, second = copies(predictions, "a/p.nc", "b/p.nc")
    rep = predictions.parent / "rep"
    for words in ((first, second, "--output", rep), (first, first)):
        result = run("score", *words, "--report", rep)
        assert result.exit_code == 2
        assert "one folder" in result.stderr
    assert not rep.exists()
    assert [path.name for path in first.parent.iterdir()] == ["p.nc"]


def test_several_files_are_checked_before_any_is_scored(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another size, or a broken last file, ends the command before the first is scored."""
    first, second = copies(predictions, "a.nc", "b.nc")
    real = validation.validate

    def other(path: Path, **options: Any) -> submission.ValidationResult:
        found = real(path, **options)
        return dataclasses.replace(found, size="mini") if Path(path) == second else found

    rep = predictions.parent / "rep"
    with monkeypatch.context() as patch:
        patch.setattr(validation, "validate", other)
        result = run("score", first, second, "--report", rep)
    assert result.exit_code == 2
    assert "two data sets" in result.stderr
    second.write_text("text")
    assert run("score", first, second, "--report", rep).exit_code == 3
    assert not (predictions.parent / "a").exists()
    assert not rep.exists()


@pytest.mark.parametrize("option", ["--output", "--report"])
def test_an_unusable_folder_is_told_before_the_work(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    """A file in the place of the folder ends the command before any scenario is measured."""

    def measured(*_: object, **__: object) -> None:
        raise AssertionError("scenarios were measured")

    monkeypatch.setattr(score, "run_all", measured)
    taken = predictions.parent / "taken"
    taken.write_text("")
    result = run("score", predictions, option, taken)
    assert result.exit_code == 5
    assert f"write to: {option}" in result.stderr


@pytest.mark.parametrize("method", ["\x1b[31mred", "bell\a", "x" * 201, " "])
def test_foreign_text_does_not_reach_the_terminal(run: Run, predictions: Path, method: str) -> None:
    """Control characters or endless text in a scores.json make it unreadable; none is printed."""
    run("score", predictions, "--quiet")
    path = predictions.parent / "scores.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"method": method}))
    result = run("compare", path, "persistence")
    assert result.exit_code == 3
    assert "method is not printable" in result.stderr
    assert not set("\x1b\a") & set(result.stdout + result.stderr)
