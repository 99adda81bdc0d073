"""The child process in which an attack runs a command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lagbench.errors import UsageError
from validation.attack.__main__ import choose_targets, main
from validation.attack.running import take_snapshot
from validation.attack.targets import Target

REPOSITORY = Path(__file__).parents[2]

ATTACK = """
import dataclasses, json, sys
from pathlib import Path
from validation.attack.running import run_command

folder = Path(sys.argv[1])
outcome = run_command(["list"], folder / "case", folder, is_installed=True)
print(json.dumps(dataclasses.asdict(outcome)))
"""

ENDING_PATH = """
import sys

class Place:
    def __fspath__(self):
        sys.exit("an odd end")

REGISTRY = Place()
"""

CLOSED_OUTPUT = """
import sys

REGISTRY = "no such file"
sys.stdout.close()
"""


def run_beside(folder: Path, source: str) -> tuple[dict[str, Any], str]:
    """Attack `lagbench list` beside a package; return the outcome and all errors.

    Args:
        folder: scratch folder.
        source: source of the module that the package adds as a split.
    """
    package = folder / "case" / "hostile-1.0.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Name: hostile\nVersion: 1.0\n")
    entry_points = "[lagbench.generators]\nhostile = hostile_split\n"
    (package / "entry_points.txt").write_text(entry_points)
    (folder / "case" / "hostile_split.py").write_text(source)
    done = subprocess.run(
        [sys.executable, "-c", ATTACK, str(folder)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    outcome: dict[str, Any] = json.loads(done.stdout)
    return outcome, done.stderr + outcome["errors"]


def test_an_end_with_a_text_is_the_error_that_python_makes_of_it(
    tmp_path: Path,
) -> None:
    """Python prints the text on stderr, and the exit code is 1."""
    outcome, errors = run_beside(tmp_path, ENDING_PATH)
    assert outcome["code"] == 1
    assert "an odd end" in errors


def test_the_child_of_an_attack_never_becomes_the_attack(tmp_path: Path) -> None:
    """Whatever the command did to its streams: no line of the caller runs there."""
    outcome, errors = run_beside(tmp_path, CLOSED_OUTPUT)
    assert outcome["code"] == 5
    assert "run_command" not in errors


def a_target(name: str) -> Target:
    """Return a target that is never attacked."""
    return Target(name=name, source="", victim="", mutations=(), commands=())


def test_a_misspelt_target_is_refused_beside_others() -> None:
    """Else it would be left out, and no case of it would fail."""
    targets = [a_target("predictions"), a_target("scores"), a_target("recipe")]
    chosen = choose_targets(targets, ["recipe", "predictions"])
    assert [target.name for target in chosen] == ["predictions", "recipe"]
    with pytest.raises(UsageError) as caught:
        choose_targets(targets, ["recipe", "prediction"])
    assert caught.value.where == "--target"


@pytest.mark.parametrize(
    "words",
    [
        ["--seed", "-1"],
        ["--cases", "-1"],
        ["--first", "-1"],
        ["--only", "3", "-1"],
    ],
)
def test_numbers_of_an_attack_are_not_negative(
    tmp_path: Path, words: list[str]
) -> None:
    """They are refused before the valid files are made."""
    work = tmp_path / "work"
    with pytest.raises(SystemExit) as caught:
        main(["--root", str(tmp_path), "--work", str(work), *words])
    assert caught.value.code == 2
    assert not work.exists()


def test_a_snapshot_notices_another_target_of_a_link(tmp_path: Path) -> None:
    """Nothing behind a link is read."""
    link = tmp_path / "link"
    link.symlink_to("first")
    before = take_snapshot(tmp_path)
    assert take_snapshot(tmp_path) == before
    link.unlink()
    link.symlink_to("second")
    after = take_snapshot(tmp_path)
    assert after.keys() == before.keys()
    assert after != before
