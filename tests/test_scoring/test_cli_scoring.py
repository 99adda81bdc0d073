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
from lagbench.__main__ import app
from lagbench.make.generate import GenerationResult
from lagbench.scoring import score
from lagbench.submission import validation

Run = Callable[..., Result]


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, generated: GenerationResult) -> Run:
    """A function that runs lagbench on the generated data set with no recorded
    hashes.
    """
    monkeypatch.setenv("LAGBENCH_ROOT", str(generated.root))
    return run


@pytest.fixture
def predictions(run: Run, tmp_path: Path) -> Path:
    """The template of a submission."""
    path = tmp_path / "predictions.nc"
    assert run("template", "--split", SPLIT, "--size", SIZE, "-o", path).exit_code == 0
    return path


def test_from_template_to_tables(run: Run, predictions: Path) -> None:
    """A template validates, scores, and its tables name floors, undefined frames, flags
    and files.
    """
    assert run("validate", predictions).exit_code == 0
    result = run("score", predictions)
    assert result.exit_code == 0
    words = (
        "persistence",
        "vorticity_rmse",
        "vorticity_pearson 40",
        "1/frame",
        "flag copy_suspect",
        "scores.nc",
    )
    assert [word for word in words if word not in result.stdout] == []
    assert all(
        "scenarios" in line for line in result.stderr.splitlines()
    )  # progress, on a slow machine


def test_json_is_the_file(run: Run, predictions: Path) -> None:
    """Score --json prints what scores.json holds; --output moves both files; --quiet
    prints nothing.
    """
    folder = predictions.parent / "scores"
    result = run("score", predictions, "--json", "--output", folder)
    assert json.loads(result.stdout) == json.loads((folder / "scores.json").read_text())
    assert {path.name for path in folder.iterdir()} == {"scores.json", "scores.nc"}
    assert not (predictions.parent / "scores.json").exists()
    assert run("score", predictions, "--quiet").stdout == ""


def test_a_template_keeps_what_is_there(
    run: Run, predictions: Path, tmp_path: Path
) -> None:
    """Predictions are not replaced unless one says so; the only size that is here is
    the default.
    """
    predictions.write_bytes(b"the work of a week")
    words = ("template", SPLIT, "-o", predictions)
    assert run(*words).exit_code == 2
    assert predictions.read_bytes() == b"the work of a week"
    assert run(*words, "--overwrite").exit_code == 0
    assert run("validate", predictions).exit_code == 0
    assert run("template", SPLIT, "-o", tmp_path, "--overwrite").exit_code == 2
    nothing = run(
        "template", SPLIT, "-o", tmp_path / "u.nc", "--root", tmp_path / "empty"
    )
    assert nothing.exit_code == 2
    assert f"lagbench generate --split {SPLIT} --size" in nothing.stderr


def test_scores_are_called_as_their_predictions(run: Run, predictions: Path) -> None:
    """Scores of gns.nc lie in gns/; those of another method are never written over."""
    other = predictions.with_name("gns.nc")
    shutil.copy(predictions, other)
    with h5py.File(other, "a") as file:
        file.attrs["method"] = "gns"
    assert [run("score", predictions).exit_code for _ in range(2)] == [0, 0]
    kept = predictions.with_name("scores.json").read_bytes()
    assert run("score", other).exit_code == 0
    assert (predictions.parent / "gns" / "scores.nc").is_file()
    refused = run("score", other, "--output", predictions.parent)
    assert refused.exit_code == 2
    assert "persistence" in refused.stderr
    assert predictions.with_name("scores.json").read_bytes() == kept


def too_wide(text: str) -> list[str]:
    """Return lines wider than 80 columns, colours left out, but paths and remarks."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", text).split("\n")
    return [
        line
        for line in lines
        if len(line.rstrip()) > 80 and not re.search(r":|\w/\w+/", line)
    ]


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands take their output for a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda _: True))


@pytest.mark.slow
@pytest.mark.usefixtures("terminal")
def test_tables_fit_eighty_columns(run: Run, predictions: Path) -> None:
    """No line of any table is wider, with every metric and every floor too."""
    run("score", predictions)
    board = Path(lagbench.__file__).parents[1] / "leaderboard"
    here = f"{SPLIT} --size {SIZE}"
    for line in (
        f"score {predictions}",
        f"score {predictions} --all --all-floors",
        f"compare {predictions.parent} analog --all",
        "list",
        "info cavity",
        f"info {here}",
        f"verify {here}",
        f"leaderboard show --board {board}",
    ):
        result = run(*line.split())
        assert result.exit_code == 0, result.output
        assert result.stdout
        assert line == line
        assert too_wide(result.stdout) == []


def commands(group: Any, *before: str) -> Iterator[tuple[str, ...]]:
    """Yield the words of every command below a group."""
    for name, command in group.commands.items():
        yield from (
            commands(command, *before, name)
            if hasattr(command, "commands")
            else [(*before, name)]
        )


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(
    "words", [(), ("leaderboard",), *commands(get_command(app))], ids=" ".join
)
def test_help_fits_eighty_columns(run: Run, words: tuple[str, ...]) -> None:
    """The help of each command, and of those above, is told in 80 columns."""
    result = run(*words, "--help")
    assert result.exit_code == 0
    assert [
        line for line in result.stdout.split("\n") if too_wide(line.replace(":", "."))
    ] == []


def test_compare_says_that_two_scenarios_are_few(run: Run, predictions: Path) -> None:
    """With two scenarios no significance is claimed, in words and as null in JSON."""
    run("score", predictions)
    result = run("compare", predictions.parent, "constant-velocity")
    assert result.exit_code == 0
    assert "no significance is claimed under 6" in result.stdout
    said = json.loads(
        run("compare", predictions.parent, "constant-velocity", "--json").stdout
    )
    assert said["metrics"]["vorticity_rmse"]["p"] is None
    assert (
        run(
            "compare", predictions.parent, "constant-velocity", "--metric", "mse"
        ).exit_code
        == 2
    )


def test_unreadable_files(
    run: Run, predictions: Path, generated: GenerationResult
) -> None:
    """Score and validate agree on the exit code and say what to do; one finding tells
    files of ours.
    """
    run("score", predictions)
    for path in (
        predictions.with_name("scores.nc"),
        next(generated.folder.glob("test/*.nc")),
    ):
        assert [finding.check for finding in submission.validate(path).findings] == [
            "readable"
        ]
        assert run("validate", path).exit_code == 3
    whole = predictions.read_bytes()
    for content in (b"text", whole[:20_000], None):
        predictions.unlink() if content is None else predictions.write_bytes(content)
        scored = run("score", predictions)
        validated = run("validate", predictions)
        assert scored.exit_code == validated.exit_code == 3
        assert "fix:" in scored.stderr
        assert "Traceback" not in scored.stderr + scored.stdout


@pytest.mark.parametrize("method", ["[/b]", "[red]x[/red]", "a [link=http://b]"])
def test_names_are_no_markup(run: Run, predictions: Path, method: str) -> None:
    """A method's name with square brackets is printed as it is, in titles and heads of
    columns.
    """
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


@pytest.fixture
def two(predictions: Path) -> list[Path]:
    """Copies of a submission under one name in two folders."""
    paths = [predictions.parent / name / "p.nc" for name in "ab"]
    for path in paths:
        path.parent.mkdir()
        shutil.copyfile(predictions, path)
    return paths


FAILING = """
from lagbench.metrics import METRICS, Direction, Metric

def statistic(pair):
    if pair.frame == 10:
        raise ValueError("my own mistake")
    return 1.0

METRICS = (
    Metric(
        name="my_enstrophy", family="mine", unit="1",
        direction=Direction.LOWER, perfect=0.0,
        source="here", summary="fails", statistic=statistic,
    ),
)
"""


def test_where_a_metric_of_a_package_fails(
    run: Run, predictions: Path, package: Callable[..., Path]
) -> None:
    """What a user's own metric raises is told with its line, name, frame and
    scenario.
    """
    module = package("metrics", "failing_metric:METRICS", FAILING)
    with h5py.File(predictions) as file:
        first = min(file["scenario"][:])
    result = run("score", predictions)
    assert result.exit_code == 5
    for told in (f"{module}, line 6", "my_enstrophy", "frame 10", f"scenario {first}"):
        assert told in result.stderr
    assert not predictions.with_name("scores.json").exists()


def test_several_files_keep_their_scores(
    run: Run, two: list[Path], tmp_path: Path
) -> None:
    """Scores go beside each file, the page into the report folder; namesakes are
    compared as (1) and (2).
    """
    result = run("score", *two, "--report", tmp_path / "rep")
    compared = run("compare", *two)
    assert (result.exit_code, compared.exit_code) == (0, 0), (
        result.stderr + compared.stderr
    )
    for number, path in enumerate(two, start=1):
        assert {held.name for held in (path.parent / "p").iterdir()} == {
            "scores.json",
            "scores.nc",
        }
        assert f"({number}): {path}" in compared.stdout
    assert [path.name for path in (tmp_path / "rep").iterdir()] == ["index.html"]


def test_a_reader_that_leaves_early_leaves_the_report(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``score --report R | head`` closes the pipe after ten lines: by then the report
    is there.
    """

    def gone(*_: object, **__: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(typer, "echo", gone)
    assert (
        run("score", predictions, "--report", predictions.parent / "rep").exit_code
        == 141
    )
    assert (predictions.parent / "rep" / "index.html").is_file()


def test_scores_never_share_a_folder(run: Run, two: list[Path], tmp_path: Path) -> None:
    """Two files whose scores would overwrite each other are a usage error before any is
    scored.
    """
    for words in ((*two, "--output", tmp_path / "rep"), (two[0], two[0])):
        result = run("score", *words, "--report", tmp_path / "rep")
        assert result.exit_code == 2
        assert "one folder" in result.stderr
    assert not (tmp_path / "rep").exists()
    assert [path.name for path in two[0].parent.iterdir()] == ["p.nc"]


def test_several_files_are_checked_before_any_is_scored(
    run: Run, two: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another size, or a broken last file, ends the command before the first is
    scored.
    """
    real = validation.validate

    def other(path: Path, **options: Any) -> submission.ValidationResult:
        found = real(path, **options)
        return (
            dataclasses.replace(found, size="mini") if Path(path) == two[1] else found
        )

    with monkeypatch.context() as patch:
        patch.setattr("lagbench.cli.score.validate", other)
        result = run("score", *two, "--report", tmp_path / "rep")
    assert result.exit_code == 2
    assert "two data sets" in result.stderr
    two[1].write_text("text")
    assert run("score", *two, "--report", tmp_path / "rep").exit_code == 3
    assert not (two[0].parent / "p").exists()
    assert not (tmp_path / "rep").exists()


@pytest.mark.parametrize("option", ["--output", "--report"])
def test_an_unusable_folder_is_told_before_the_work(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    """A file in the place of the folder ends the command before any scenario is
    measured.
    """
    monkeypatch.setattr(score, "run_all", None)
    taken = predictions.parent / "taken"
    taken.write_text("")
    result = run("score", predictions, option, taken)
    assert result.exit_code == 5
    assert f"write to: {option}" in result.stderr


@pytest.mark.parametrize("method", ["\x1b[31mred", "bell\a", "x" * 201, " "])
def test_foreign_text_does_not_reach_the_terminal(
    run: Run, predictions: Path, method: str
) -> None:
    """Control characters or endless text in a scores.json make it unreadable; none is
    printed.
    """
    run("score", predictions, "--quiet")
    path = predictions.parent / "scores.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"method": method}))
    result = run("compare", path, "persistence")
    assert result.exit_code == 3
    assert "method" in result.stderr
    assert not set("\x1b\a") & set(result.stdout + result.stderr)
