"""The commands submit and leaderboard build, check, show; the stranger's path of
docs/submitting.md.
"""

from __future__ import annotations

import json
import re
import runpy
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import Result
from conftest import SIZE, SPLIT

from lagbench.board.entry import Entry, EntryBudget, Meta
from lagbench.board.issues import CHECKS
from lagbench.make.generate import GenerationResult

DOCS = Path(__file__).parents[2] / "docs"
TOY = DOCS / "examples" / "toy_model"
Run = Callable[..., Result]


@pytest.fixture
def run(
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
    generated: GenerationResult,
    tmp_path: Path,
) -> Run:
    """A function that runs lagbench in an empty folder on the generated data set."""
    monkeypatch.setenv("LAGBENCH_ROOT", str(generated.root))
    monkeypatch.chdir(tmp_path)
    return run


SUBMIT = ("submit", "predictions.nc", "--from", TOY / "meta.yaml")


@pytest.fixture
def toy(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Predictions of the example model, run as its docstring says."""
    words = ["toy_model.py", "--split", SPLIT, "--size", SIZE, "-o", "predictions.nc"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(TOY / "toy_model.py"), run_name="__main__")
    assert end.value.code == 0


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_stranger_can_submit_check_and_show_an_entry(
    run: Run, tmp_path: Path
) -> None:
    """From an own model to a page, each command as documented, nothing asked on
    stdin.
    """
    assert run("validate", "predictions.nc").exit_code == 0
    assert run(*SUBMIT).exit_code == 2
    submitted = run(*SUBMIT, "--new-board")
    assert submitted.exit_code == 0, submitted.output
    assert "toy-model" in submitted.stdout
    assert "vorticity_nrmse" in submitted.stdout
    entry = tmp_path / "leaderboard/submissions" / SPLIT / SIZE / "toy-model.yaml"
    assert yaml.safe_load(entry.read_text())["parameters"] == 1
    assert run("leaderboard", "check").exit_code == 0
    stale = run("leaderboard", "check", "--page")
    assert stale.exit_code == 1
    assert "error [page]" in stale.stderr
    built = run("leaderboard", "build")
    assert built.exit_code == 0, built.output
    assert re.search(r"index.html: 1 entry, 1 tab, .* written", built.stdout)
    assert run("leaderboard", "build", "--check").exit_code == 0
    checked = run("leaderboard", "check", "--page", "--predictions", "predictions.nc")
    assert checked.exit_code == 0, checked.output
    assert "1 entry, nothing wrong" in checked.stdout
    assert f"confirms scores/{SPLIT}/{SIZE}/toy-model.nc of" in checked.stdout
    shown = run("leaderboard", "show", SPLIT, "--size", SIZE)
    assert "toy-model" in shown.stdout
    assert "Toy model" in (tmp_path / "leaderboard" / "index.html").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_machines_are_answered_in_json(run: Run) -> None:
    """Every command has --json; the next step keeps --board; a drifted page fails with
    exit code 1.
    """
    board = ("--board", "trial")
    assert run(*SUBMIT, *board, "--new-board").stdout.count("--board trial") == 2
    assert (
        json.loads(run(*SUBMIT, *board, "--replace", "--json").stdout)["ranking"]
        == "vorticity_nrmse"
    )

    def told(command: str, *words: str) -> Any:
        return json.loads(run("leaderboard", command, *board, *words, "--json").stdout)

    built = told("build")
    assert built["rows"] == 1
    assert built["tabs"] == 1
    seen = told("check", "--page")
    assert seen["findings"] == []
    assert seen["page_checked"]
    again = told("check", "--predictions", "predictions.nc", "--record")
    assert again["recorded"] == [f"submissions/{SPLIT}/{SIZE}/toy-model.yaml"]
    shown = told("show")
    assert shown["tabs"][0]["rows"][0]["verified"] is True
    Path("trial/index.html").write_text("stale")
    result = run("leaderboard", "build", *board, "--check")
    assert result.exit_code == 1
    assert "lagbench leaderboard build" in result.stderr
    assert run("leaderboard", "build", *board, "--quiet").output == ""
    assert run("leaderboard", "check", *board, "--base", "main").exit_code == 2


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["submit"], 2, "FILE"),
        (["submit", "none.nc"], 3, "none.nc"),
        (
            ["submit", "x.nc", "--url", "https://example.org/x.nc"],
            2,
            "--url",
        ),
        (["submit", "x.nc", "--from", "none.yaml"], 3, "none.yaml"),
        (["leaderboard", "build"], 2, "no leaderboard here"),
        (["leaderboard", "check"], 2, "--board FOLDER"),
        (["leaderboard", "check", "--predictions", "none.nc"], 3, "none.nc"),
        (["leaderboard", "show"], 2, "no leaderboard here"),
        (["leaderboard", "reproduce", "--all"], 2, "no leaderboard here"),
        (["leaderboard", "shift", "--all"], 2, "no leaderboard here"),
        (["leaderboard", "picture", "cavity"], 2, "no leaderboard here"),
        (["compare", "cavity/mini/gns", "persistence"], 2, "no leaderboard here"),
    ],
)
def test_errors_have_their_codes(
    run: Run,
    words: list[str],
    code: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One message on stderr, no traceback, the code of docs/scoring.md, nothing
    written.
    """
    monkeypatch.setattr("lagbench.scoring.boards.DEFAULT_BOARDS", (Path("none"),))
    result = run(*words)
    assert result.exit_code == code, result.output
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.output
    assert not list(tmp_path.iterdir())


def test_a_misspelt_description_of_an_entry_is_suggested(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("meta.yaml").write_text("method: small\n")
    result = run("submit", "x.nc", "--from", "meta.yml")
    assert result.exit_code == 3, result.output
    assert "did you mean meta.yaml?" in result.stderr


@pytest.fixture
def clone_board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The leaderboard of a clone, which is not the working folder."""
    board = tmp_path / "clone" / "leaderboard"
    (board / "submissions").mkdir(parents=True)
    boards = (Path("leaderboard"), board)
    monkeypatch.setattr("lagbench.scoring.boards.DEFAULT_BOARDS", boards)
    return board


def test_the_board_of_the_clone_is_found_elsewhere(
    run: Run, clone_board: Path, tmp_path: Path
) -> None:
    """A leaderboard in the working folder comes before it."""
    shown = run("leaderboard", "show")
    assert shown.exit_code == 0
    assert str(clone_board) in shown.stdout
    again = run("leaderboard", "reproduce", "cavity/mini/gns")
    assert "no such entry" in again.stderr
    assert str(clone_board) in again.stderr.replace("\n", "")
    checked = run("leaderboard", "check")
    assert checked.exit_code == 0
    assert str(clone_board) in checked.stdout
    for command in ("reproduce", "shift"):
        none = run("leaderboard", command, "--all", "--split", "cavty")
        assert none.exit_code == 2
        assert "no entries there" in none.stderr
        assert str(clone_board) in none.stderr.replace("\n", "")
        assert "results go to" not in none.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lagbench.cli.leaderboard.shipped", lambda _: None)
        picture = run("leaderboard", "picture", "cavity", "--size", "mini")
    assert "no entries there" in picture.stderr
    assert not (tmp_path / "cost.svg").exists()
    (tmp_path / "leaderboard" / "submissions").mkdir(parents=True)
    assert str(clone_board) not in run("leaderboard", "show").stdout


@pytest.mark.slow
def test_the_page_of_docs_is_true(run: Run) -> None:
    """docs/submitting.md names every check and key; its commands are accepted, its
    example is the file's.
    """
    text = (DOCS / "submitting.md").read_text()
    for name, check in CHECKS.items():
        assert f"| `{name}` | {check.meaning} |" in text
    for key in (*Meta.model_fields, *Entry.model_fields, *EntryBudget.model_fields):
        assert f"`{key}`" in text
    assert (TOY / "meta.yaml").read_text() in text
    blocks = re.findall(r"```(?:bash|console)\n(.*?)```", text, re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    commands = [
        shlex.split(line, comments=True)[1:]
        for line in lines
        if line.startswith("lagbench ")
    ]
    assert len(commands) >= 8
    for words in commands:
        result = run(*words, "--help")
        assert result.exit_code == 0, words


@pytest.mark.usefixtures("toy")
def test_scores_of_earlier_tasks_alone(run: Run, tmp_path: Path) -> None:
    """Scores that do not fit the task of today give no table, but they count as
    entries.
    """
    assert run(*SUBMIT, "--new-board").exit_code == 0
    board = tmp_path / "leaderboard"
    entry = board / "submissions" / SPLIT / SIZE / "toy-model.yaml"
    held = yaml.safe_load(entry.read_text())
    held["dataset"]["version"] = "1.0.0"
    entry.write_text(yaml.safe_dump(held))
    (board / "scores" / SPLIT / SIZE / "toy-model.nc").write_bytes(
        b"of an earlier format"
    )
    for words in ((), (SPLIT, "--size", SIZE)):
        result = run("leaderboard", "show", *words)
        assert result.exit_code == 0, result.output
        assert "lagbench submit" in result.output
    result = run("leaderboard", "show", "fluid")
    assert result.exit_code == 2
    assert f"{SPLIT} {SIZE}" in result.stderr  # what there is


def test_an_empty_board_is_well(run: Run, tmp_path: Path) -> None:
    """Without any entry it is built, checked and shown."""
    (tmp_path / "leaderboard" / "submissions").mkdir(parents=True)
    for words in (["build"], ["check", "--page"], ["show"], ["show", "--json"]):
        result = run("leaderboard", *words)
        assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"tabs": []}


def test_there_is_nothing_to_record_without_predictions(run: Run) -> None:
    """`--record` alone is a mistake of the command line."""
    assert run("leaderboard", "check", "--record").exit_code == 2
