"""The commands around submissions: template, validate, score, compare."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import pytest
from command_line import Result
from conftest import SIZE, SPLIT

import lagbench
from lagbench import submission
from lagbench.errors import UsageError
from lagbench.make.generate import GenerationResult
from lagbench.scoring import score
from lagbench.submission import validation

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
    """The output names references, undefined frames, flags and files."""
    assert run("validate", predictions).exit_code == 0
    result = run("score", predictions, "--all")
    assert result.exit_code == 0
    words = (
        "persistence",
        "vorticity_rmse",
        "vorticity_pearson 40",
        "1/frame",
        "speedup: none",
        "flag copy_suspect",
        "scores.nc",
    )
    for word in words:
        assert word in result.stdout
    for line in result.stderr.splitlines():
        assert "scenarios" in line  # progress, on a slow machine


def test_the_short_output_has_the_skill_and_five_rows(
    run: Run, predictions: Path
) -> None:
    """It also says where the files are and how to see more."""
    result = run("score", predictions)
    lines = result.stdout.splitlines()
    rule = next(number for number, line in enumerate(lines) if line[:3] == "───")
    end = next(
        number for number in range(rule, len(lines)) if not lines[number].strip()
    )
    rows = lines[rule + 1 : end]
    assert [row.split()[0] for row in rows][:2] == ["skill", "vorticity_nrmse"]
    assert len(rows) == 6
    assert "against " in result.stdout
    assert str(predictions.with_suffix("") / "scores.json") in result.stdout
    assert "--all" in lines[-1]
    assert "not raised" not in result.stdout


def test_json_is_the_file(run: Run, predictions: Path) -> None:
    """``--json`` prints the content of scores.json; ``--output`` moves both files."""
    folder = predictions.parent / "scores"
    result = run("score", predictions, "--json", "--output", folder)
    content = json.loads((folder / "scores.json").read_text())
    assert json.loads(result.stdout) == content
    names = {path.name for path in folder.iterdir()}
    assert names == {"scores.json", "scores.nc"}
    assert not (predictions.parent / "scores.json").exists()


def test_quiet_prints_nothing(run: Run, predictions: Path) -> None:
    assert run("score", predictions, "--quiet").stdout == ""


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


def test_a_template_is_no_folder(run: Run, tmp_path: Path) -> None:
    result = run("template", SPLIT, "-o", tmp_path, "--overwrite")
    assert result.exit_code == 2


def test_a_template_without_data_names_the_command_that_makes_them(
    run: Run, tmp_path: Path
) -> None:
    output = tmp_path / "predictions.nc"
    result = run("template", SPLIT, "-o", output, "--root", tmp_path / "empty")
    assert result.exit_code == 4
    assert f"lagbench generate --split {SPLIT} --size" in result.stderr


def test_scores_are_called_as_their_predictions(run: Run, predictions: Path) -> None:
    """Scores of gns.nc lie in gns/; a file without suffix keeps its place."""
    for name, folder in (("gns.nc", "gns"), ("gat", "gat-scores")):
        other = predictions.with_name(name)
        shutil.copy(predictions, other)
        result = run("score", other)
        assert result.exit_code == 0, result.stderr
        assert (predictions.parent / folder / "scores.nc").is_file()
        assert other.is_file()


def test_scores_of_another_method_are_not_replaced(run: Run, predictions: Path) -> None:
    """Those of the same method are."""
    assert run("score", predictions).exit_code == 0
    assert run("score", predictions).exit_code == 0
    scores = predictions.with_suffix("") / "scores.json"
    before = scores.read_bytes()
    other = predictions.with_name("gns.nc")
    shutil.copy(predictions, other)
    with h5py.File(other, "a") as file:
        file.attrs["method"] = "gns"
    result = run("score", other, "--output", scores.parent)
    assert result.exit_code == 2
    assert "persistence" in result.stderr
    assert scores.read_bytes() == before


def find_wide_lines(text: str) -> list[str]:
    """Return lines wider than 80 columns except paths and remarks.

    Colours do not count.
    """
    wide_lines = []
    for line in re.sub(r"\x1b\[[0-9;]*m", "", text).split("\n"):
        is_path_or_remark = re.search(r":|\w/\w+/", line)
        if len(line.rstrip()) > 80 and not is_path_or_remark:
            wide_lines.append(line)
    return wide_lines


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands take their output for a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda _: True))


def test_compare_says_that_two_scenarios_are_few(run: Run, predictions: Path) -> None:
    """It claims no significance, in words and as null in JSON."""
    run("score", predictions)
    arguments = ("compare", predictions.parent, "constant-velocity")
    result = run(*arguments)
    assert result.exit_code == 0
    assert "2 scenarios decide nothing" in result.stdout
    content = json.loads(run(*arguments, "--json").stdout)
    assert content["metrics"]["vorticity_rmse"]["p"] is None


def test_compare_refuses_an_unknown_metric(run: Run, predictions: Path) -> None:
    run("score", predictions)
    arguments = ("compare", predictions.parent, "constant-velocity")
    assert run(*arguments, "--metric", "mse").exit_code == 2


@pytest.mark.slow
def test_other_files_of_lagbench_are_no_predictions(
    run: Run, predictions: Path, generated: GenerationResult
) -> None:
    """The validation reports one issue for it."""
    run("score", predictions)
    scores = predictions.with_suffix("") / "scores.nc"
    scenario = next(generated.folder.glob("test/*.nc"))
    for path in (scores, scenario):
        findings = submission.validate(path).findings
        assert [finding.check for finding in findings] == ["readable"]
        assert run("validate", path).exit_code == 3


@pytest.mark.parametrize("damage", ["text", "truncated", "missing"])
def test_score_and_validate_agree_on_unreadable_files(
    run: Run, predictions: Path, damage: str
) -> None:
    """The message has a fix and no traceback."""
    if damage == "text":
        predictions.write_bytes(b"text")
    elif damage == "truncated":
        predictions.write_bytes(predictions.read_bytes()[:20_000])
    else:
        predictions.unlink()
    result = run("score", predictions)
    assert result.exit_code == 3
    assert run("validate", predictions).exit_code == 3
    assert "fix:" in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize("method", ["[/b]", "[red]x[/red]", "a [link=http://b]"])
def test_names_are_no_markup(run: Run, predictions: Path, method: str) -> None:
    """Titles and heads of columns print square brackets as they are."""
    with h5py.File(predictions, "r+") as file:
        file.attrs["method"] = method
    scored = run("score", predictions)
    assert scored.exit_code == 0, scored.stderr
    assert f"{method} on {SPLIT}" in scored.stdout
    compared = run("compare", predictions.parent, "persistence")
    assert compared.exit_code == 0, compared.stderr
    named = [line for line in compared.stdout.splitlines() if method in line]
    assert named[0].startswith(f"{method} against persistence")
    assert any(line.split()[0] == "metric" for line in named)


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


@pytest.mark.slow
def test_a_failing_metric_of_a_package_costs_its_column(
    run: Run, predictions: Path, package: Callable[..., Path]
) -> None:
    """The warning has the line, the metric and the frame, also out of a worker.

    The rest is as without.
    """
    assert run("score", predictions, "-o", predictions.parent).exit_code == 0
    expected = json.loads((predictions.parent / "scores.json").read_text())
    module = package("metrics", "failing_metric:METRICS", FAILING)
    result = run("score", predictions, "--workers", 2)
    assert result.exit_code == 0, result.stderr
    for word in (f"{module}, line 6", "my_enstrophy", "frame 10"):
        assert word in result.stdout
    content = json.loads((predictions.parent / "predictions/scores.json").read_text())
    assert [warning["check"] for warning in content.pop("warnings")] == ["metric"]
    assert not expected.pop("warnings")
    assert content == expected


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


@pytest.mark.slow
def test_namesakes_are_numbered(run: Run, two_submissions: list[Path]) -> None:
    result = run("compare", *two_submissions)
    assert result.exit_code == 0, result.stderr
    for number, path in enumerate(two_submissions, start=1):
        assert f"({number}): {path}" in result.stdout


def test_a_reader_that_leaves_early_leaves_the_report(
    run: Run, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``score --report R | head`` closes the pipe when the report is written."""

    def raise_broken_pipe(*_: object, **__: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr("lagbench.cli.score.print_line", raise_broken_pipe)
    report = predictions.parent / "report"
    assert run("score", predictions, "--report", report).exit_code == 141
    assert (report / "index.html").is_file()


def test_two_files_never_share_a_folder_of_scores(
    run: Run, two_submissions: list[Path], tmp_path: Path
) -> None:
    """It is a usage error before any is scored."""
    report = tmp_path / "report"
    first, second = two_submissions
    for arguments in (
        (first, second, "--output", report),
        (first, first),
    ):
        result = run("score", *arguments, "--report", report)
        assert result.exit_code == 2
        assert "one folder" in result.stderr
    assert not report.exists()
    assert [path.name for path in first.parent.iterdir()] == ["p.nc"]


@pytest.mark.slow
def test_files_of_two_data_sets_are_refused_before_any_is_scored(
    run: Run,
    two_submissions: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    report = tmp_path / "report"
    first, second = two_submissions
    validate = validation.validate

    def validate_second_as_mini(
        path: Path, **options: Any
    ) -> submission.ValidationResult:
        result = validate(path, **options)
        if Path(path) == second:
            result = dataclasses.replace(result, size="mini")
        return result

    monkeypatch.setattr("lagbench.cli.score.validate", validate_second_as_mini)
    result = run("score", first, second, "--report", report)
    assert result.exit_code == 2
    assert "two data sets" in result.stderr
    assert not (first.parent / "p").exists()
    assert not report.exists()


def test_all_files_are_read_before_any_is_scored(
    run: Run, two_submissions: list[Path], tmp_path: Path
) -> None:
    report = tmp_path / "report"
    first, second = two_submissions
    second.write_text("text")
    result = run("score", first, second, "--report", report)
    assert result.exit_code == 3
    assert not (first.parent / "p").exists()
    assert not report.exists()


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
    assert f"write to: {option}" in result.stderr


@pytest.mark.parametrize("method", ["\x1b[31mred", "bell\a", "x" * 201, " "])
def test_foreign_text_does_not_reach_the_terminal(
    run: Run, predictions: Path, method: str
) -> None:
    """Control characters or endless text make a scores.json unreadable."""
    run("score", predictions, "--quiet")
    path = predictions.with_suffix("") / "scores.json"
    content = json.loads(path.read_text()) | {"method": method}
    path.write_text(json.dumps(content))
    result = run("compare", path, "persistence")
    assert result.exit_code == 3
    assert "method" in result.stderr
    assert "\x1b" not in result.output
    assert "\a" not in result.output


def test_a_template_whose_name_is_not_utf_8_is_refused(
    generated: GenerationResult, tmp_path: Path
) -> None:
    """The library of netCDF writes no such file."""
    output = tmp_path / "caf\udce9.nc"
    with pytest.raises(UsageError, match="no netCDF file"):
        lagbench.template(SPLIT, SIZE, output=output, root=generated.root)
    assert not output.exists()
