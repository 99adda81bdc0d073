"""A folder of data that the user may not read: it is named, and hides no other."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT
from permissions import run_without_permissions
from score_bench import ScoreBench, still

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        sys.platform != "linux", reason="capabilities are those of Linux"
    ),
]

PYTHON_CALLS = f"""
import json
import sys
import lagbench
from lagbench.errors import DataError
from lagbench.store.windows import windows
from lagbench.submission import template

root = sys.argv[1]
names = ("{SPLIT}", "{SIZE}")
calls = {{
    "load_manifest": lambda: lagbench.load_manifest(*names, root=root),
    "open_split": lambda: lagbench.open_split(*names, root=root),
    "windows": lambda: windows(*names, root=root)[0],
    "template": lambda: template(*names, root=root),
    "verify": lambda: lagbench.verify(*names, root=root),
    "verify of the only size": lambda: lagbench.verify(names[0], root=root),
    "plot": lambda: lagbench.plot(names[0], size=names[1], root=root),
}}
caught = {{}}
for name, call in calls.items():
    try:
        call()
    except DataError as error:
        caught[name] = error.where
    except Exception as error:
        caught[name] = repr(error)
print(json.dumps(caught))
"""


@pytest.fixture
def root(copied: Callable[[], Path]) -> Iterator[Path]:
    """A root folder with one data set, whose folder is closed."""
    root = copied()
    folder = root / SPLIT / SIZE
    folder.chmod(0)
    yield root
    folder.chmod(0o755)


def test_a_closed_folder_of_data_is_a_data_error_in_python(
    root: Path, tmp_path: Path
) -> None:
    done = run_without_permissions("-c", PYTHON_CALLS, root, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    closed = str(root / SPLIT / SIZE)
    caught = json.loads(done.stdout)
    assert len(caught) == 7
    for name, where in caught.items():
        assert where.startswith(closed), name


def test_commands_name_a_closed_folder_of_data(
    root: Path, bench: ScoreBench, tmp_path: Path
) -> None:
    """The exit code is that of a closed scenario file."""
    predictions = bench.submit(tmp_path / "p.nc", still)
    closed = str(root / SPLIT / SIZE)
    commands = {
        "verify": ("verify", SPLIT, "--size", SIZE),
        "info": ("info", SPLIT),
        "validate": ("validate", predictions),
        "score": ("score", predictions, "--workers", 1),
    }
    for name, words in commands.items():
        done = run_without_permissions("-m", "lagbench", *words, "--root", root)
        output = done.stdout + done.stderr
        assert done.returncode == 4, (name, output)
        assert f"{closed}\n" in output, (name, output)
        assert "may not be read" in output, (name, output)


def test_list_shows_all_other_data(root: Path) -> None:
    done = run_without_permissions("-m", "lagbench", "list", "--root", root, "--json")
    assert done.returncode == 0, done.stderr
    sizes = []
    for size in json.loads(done.stdout)["sizes"]:
        sizes.append((size["split"], size["size"]))
    assert (SPLIT, SIZE) not in sizes
    assert (SPLIT, "mini") in sizes
    assert ("cavity", SIZE) in sizes
    assert f"warning: {SPLIT} {SIZE} " in done.stderr
    assert str(root / SPLIT / SIZE) in done.stderr
