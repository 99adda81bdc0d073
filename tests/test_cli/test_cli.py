"""The command line: what it prints and writes, its exit codes, what it leaves alone."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import requires
from pathlib import Path

import pytest
import yaml
from conftest import SIZE, SPLIT
from typer.main import get_command
from typer.testing import CliRunner, Result

from lagbench.__main__ import app
from lagbench.cli.machine import NEEDED
from lagbench.cli.output import progress_bar
from lagbench.data.registry import default_path, load
from lagbench.make.generate import GenerationResult
from lagbench.work.progress import Progress, watched

Run = Callable[..., Result]


def test_help_lists_commands_in_the_order_of_use_with_examples_that_parse(
    run: Run,
) -> None:
    """All commands stand there; the help of each ends with an example whose words the
    command accepts.
    """
    text = run("--help").stdout
    names = [
        "list",
        "info",
        "generate",
        "verify",
        "plot",
        "animate",
        "cite",
        "doctor",
        "clean",
    ]
    places = [re.search(rf"^\W*{name} ", text, re.MULTILINE) for name in names]
    starts = [place.start() for place in places if place]
    assert len(starts) == len(names)
    assert starts == sorted(starts)
    commands = dict(get_command(app).commands)  # type: ignore[attr-defined]
    board = commands.pop("leaderboard").commands
    for name in (*commands, *(f"leaderboard {name}" for name in board)):
        text = " ".join(run(*name.split(), "--help").stdout.split())
        example = re.search(rf"Example: lagbench ({name}.*?)$", text)
        assert example is not None, name
        result = run(*example[1].split(), "--help")
        assert result.exit_code == 0, result.output


def test_list_shows_every_size(run: Run, generated: GenerationResult) -> None:
    """A row for each split and size; as JSON with counts, bytes, time and what is
    here.
    """
    text = run("list", "--root", generated.root).stdout
    assert (
        len(
            [
                line
                for line in text.splitlines()
                if re.search(r" (full|mini|tiny) ", line)
            ]
        )
        == 12
    )
    data = json.loads(run("list", "--root", generated.root, "--json").stdout)
    sizes = {(entry["split"], entry["size"]): entry for entry in data["sizes"]}
    here = sizes[SPLIT, SIZE]
    assert here["present"] == {"train": 2, "valid": 1, "test": 2}
    assert here["picture"].endswith("scenarios.png")
    full = sizes["cavity", "full"]
    assert full["frames"] == 45_600
    assert full["present"] == {"train": 0, "valid": 0, "test": 0}
    assert full["bytes"] == 45_600 * 8192 * 16 + 76 * 65536
    assert full["seconds"] > 60.0


def test_info_shows_parameters_with_units_and_state(
    run: Run, generated: GenerationResult
) -> None:
    """By argument or by option; what is generated has a folder and a picture."""
    options = ["--size", SIZE, "--root", generated.root]
    by_argument = run("info", SPLIT, *options)
    by_option = run("info", "--split", SPLIT, *options)
    assert by_argument.exit_code == 0
    assert by_argument.stdout == by_option.stdout
    assert re.search(r"velocity_scale +\S+ +\S+ +\S+ +\[length/s\]", by_argument.stdout)
    assert all(
        part in by_argument.stdout
        for part in (str(generated.folder), "pictures/scenarios.png")
    )
    data = json.loads(run("info", SPLIT, "--size", SIZE, "--json").stdout)
    assert data["sizes"][SIZE]["parameters"]["modulus"]["unit"] == "mass/s^2"
    assert data["sizes"][SIZE]["subsets"]["test"] == [3, 4]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("info", "no split is named"),
        ("info cavity --split fluid", "two splits are named"),
        ("info cavty", "did you mean 'cavity'?"),
        ("verify --split cavity --size ful", "did you mean 'full'?"),
        ("generate cavity --size tiny --scenarios 7-3", "runs backwards"),
        ("generate cavity --size tiny --scenarios 70", "no scenario 70"),
        ("generate cavity --size tiny --device tpu", "no device 'tpu'"),
        ("plot cavity --kind sped", "did you mean 'speed'?"),
        ("animate cavity -o film.avi", "avi"),
        ("genrate", "genrate"),
    ],
)
def test_usage_errors_exit_2(line: str, message: str, run: Run, tmp_path: Path) -> None:
    """A wrong name, option or value: one message on stderr, no traceback, exit code
    2.
    """
    result = run(*line.split(), *(["--root", tmp_path] if line != "genrate" else []))
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


def test_generate_and_verify(run: Run, tmp_path: Path) -> None:
    """One scenario: a report for people, a JSON object for machines, and nothing but
    errors when quiet.
    """
    options = [SPLIT, "--size", SIZE, "--root", tmp_path, "--scenarios", "2"]
    dry = run("generate", *options, "--dry-run").stdout
    assert re.search(
        r"(?s)1 scenarios to simulate.*disk .*bytes.*free.*time +about \d+ s", dry
    )
    made = run("generate", *options)
    assert made.exit_code == 0, made.output
    assert "missing 0-1,3-4" in made.stdout
    assert all(
        "scenarios" in line for line in made.stderr.splitlines()
    )  # progress, on a slow machine
    again = json.loads(run("generate", *options, "--json").stdout)
    assert again["simulated"] == []
    assert again["kept"] == [2]
    assert not again["complete"]
    assert run("generate", *options, "--quiet").output == ""
    checked = run("verify", SPLIT, "--size", SIZE, "--root", tmp_path)
    assert checked.exit_code == 0
    assert "warning: train lacks 0-1" in checked.stderr
    assert (
        run("verify", SPLIT, "--size", SIZE, "--root", tmp_path, "--complete").exit_code
        == 4
    )


def test_damage_of_a_data_set_exits_4(
    run: Run, copied: Callable[[], Path], tmp_path: Path
) -> None:
    """It is described on stdout, named on stderr; a picture of a damaged scenario names
    the remedy.
    """
    root = copied()
    options = [SPLIT, "--size", SIZE, "--root", root]
    path = root / SPLIT / SIZE / "v2" / "valid" / "0002.nc"
    path.write_bytes(path.read_bytes()[:-500])
    result = run("verify", *options, "--json")
    assert result.exit_code == 4
    assert json.loads(result.stdout)["subsets"][1]["wrong"] == [2]
    assert "0002.nc" in result.stderr
    (path.parents[1] / "test" / "0003.nc").write_text("no netCDF")
    drawn = run("plot", *options, "-o", tmp_path / "x.png")
    assert drawn.exit_code == 4
    assert "lagbench generate" in drawn.stderr


def test_errors_of_files_exit_3(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A registry that cannot be read is told with the key that is wrong."""
    own = tmp_path / "own.yaml"
    own.write_text(
        default_path()
        .read_text()
        .replace("licence: CC-BY-4.0", "license: CC-BY-4.0", 1)
    )
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(own))
    result = run("list")
    assert result.exit_code == 3
    assert "unknown key 'license': did you mean 'licence'?" in result.stderr


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            RuntimeError("out of\x1b[2J luck"),
            5,
            r"unexpected RuntimeError: out of\x1b[2J luck",
        ),
        (KeyboardInterrupt(), 130, "interrupted"),  # Ctrl-C is no error to trace
    ],
)
def test_the_unexpected_is_short(
    error: BaseException,
    code: int,
    said: str,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fault of ours: a message and an exit code; the traceback only when
    LAGBENCH_DEBUG=1.
    """

    def broken() -> None:
        raise error

    monkeypatch.setattr("lagbench.data.registry.load", broken)
    result = run("list")
    assert result.exit_code == code
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    if code == 5:
        monkeypatch.setenv("LAGBENCH_DEBUG", "1")
        assert run("list").exception is error


def test_a_tag_names_the_version() -> None:
    """A release's tag is v and the version of pyproject.toml, which CITATION.cff and
    README have too.
    """
    root = Path(__file__).parents[2]
    version = tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"]
    assert yaml.safe_load((root / "CITATION.cff").read_text())["version"] == version
    assert f"version = {{{version}}}" in (root / "README.md").read_text()
    # Outside of git, and in an archive that was unpacked in another repository, there
    # are no tags of ours.
    if not (root / ".git").exists() or shutil.which("git") is None:
        pytest.skip("no clone")
    asked = ["git", "-C", str(root), "tag", "--points-at", "HEAD", "--list", "v[0-9]*"]
    tags = subprocess.run(
        asked, capture_output=True, text=True, check=False
    ).stdout.split()
    if not tags:
        pytest.skip("no tag at HEAD")
    assert tags == [f"v{version}"]
    heads = re.findall(r"^## (.*)$", (root / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert version in heads[0]


def test_bibtex_is_what_citation_cff_says(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of lagbench: title, version and year of CITATION.cff; of a split: its version and
    every hash.
    """

    def fields(*words: str) -> dict[str, str]:
        text = run("cite", *words).stdout
        assert text.count("{") == text.count("}")
        assert text.strip().partition("{")[0] in {"@software", "@misc"}
        return dict(re.findall(r"^  (\w+) = \{(.*)\},$", text, re.MULTILINE))

    monkeypatch.delenv("LAGBENCH_REGISTRY")
    cff = yaml.safe_load((Path(__file__).parents[2] / "CITATION.cff").read_text())
    expected = {
        "author": "{The lagbench authors}",
        "title": cff["title"],
        "version": cff["version"],
    }
    assert fields("--bibtex") == {**expected, "year": str(cff["date-released"].year)}
    split = fields("cavity", "--bibtex")
    hashes = [held.dataset_sha256 for held in load().measured["cavity"].values()]
    assert split["version"] == load().split("cavity").version
    assert len(hashes) == sum(value in split["note"] for value in hashes) == 3
    assert "Ghia" in run("cite", "cavity").stdout
    assert json.loads(run("cite", "cavity", "--json").stdout)["licence"] == "CC-BY-4.0"
    for words in (("--bibtex",), ("cavity", "--bibtex")):
        assert json.loads(run("cite", *words, "--json").stdout) == {
            "bibtex": run("cite", *words).stdout[:-1]
        }


def test_doctor_finds_this_machine_fit(run: Run, tmp_path: Path) -> None:
    """All that the package declares is looked at and here; a root that nobody can write
    is broken.
    """
    declared = [line for line in requires("lagbench") or [] if "extra ==" not in line]
    assert {name.lower() for name in NEEDED} == {
        re.split(r"[^\w.-]", line)[0].lower() for line in declared
    }
    data = json.loads(run("doctor", "--root", tmp_path, "--json").stdout)
    states = {check["name"]: check["state"] for check in data["checks"]}
    assert states["numpy"] == states["registry"] == states["data folder"] == "ok"
    (tmp_path / "file").write_text("")
    result = run("doctor", "--root", tmp_path / "file" / "data")
    assert result.exit_code == 1
    assert "broken: data folder" in result.stderr


def test_clean_removes_ours_only(
    run: Run, copied: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dry run says what would go and takes no lock; then all is gone but a stranger's
    files, PNG too.
    """
    root = copied()
    folder = root / SPLIT / SIZE / "v2"
    mine = {
        f"{SPLIT}/{SIZE}/v2/{name}"
        for name in ("notes.txt", "mine.png", "pictures/mine.png")
    }
    for name in mine:
        (root / name).write_bytes(b"mine")
    (folder / "test" / ".0003.nc.1.partial").write_text("")
    options = [SPLIT, "--size", SIZE, "--root", root]
    left = json.loads(run("clean", *options, "--leftovers", "--json").stdout)["removed"]
    assert left == [str(folder / "test" / ".0003.nc.1.partial")]
    before = files_below(root)
    with monkeypatch.context() as patch:
        patch.setattr("lagbench.make.clean.dataset_lock", None)
        dry = run("clean", *options, "--dry-run")
    assert dry.exit_code == 0, dry.output
    assert "10 files" in dry.stdout
    assert files_below(root) == before
    assert run("clean", *options).exit_code == 0
    assert files_below(root) == mine
    for name in mine:
        (root / name).unlink()
    assert run("clean", *options).exit_code == 0
    assert list(root.iterdir()) == []
    assert run("clean", *options).exit_code == 0


def test_clean_leaves_links(
    run: Run, copied: Callable[[], Path], tmp_path: Path
) -> None:
    """A subset that lies on another disk loses its files, not its folder."""
    root = copied()
    folder = root / SPLIT / SIZE / "v2"
    (folder / "train").rename(tmp_path / "elsewhere")
    (folder / "train").symlink_to(tmp_path / "elsewhere")
    assert run("clean", SPLIT, "--size", SIZE, "--root", root).exit_code == 0
    assert list((tmp_path / "elsewhere").iterdir()) == []
    assert [path.name for path in folder.iterdir()] == ["train"]


def test_a_broken_local_split_hides_no_other(run: Run, tmp_path: Path) -> None:
    """One description that cannot be read is told; all other splits are listed."""
    for name in ("mine", "pipe"):
        (tmp_path / name).mkdir()
    (tmp_path / "mine" / "split.yaml").write_text("splits: [")
    os.mkfifo(tmp_path / "pipe" / "split.yaml")
    result = run("list", "--root", tmp_path)
    assert result.exit_code == 0
    assert {"mine", "pipe"} <= {
        line.split()[1] for line in result.stderr.splitlines() if "left out" in line
    }
    assert "cavity" in result.stdout


def test_plot_and_animate_name_their_files(
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By split and id or by file; without a name the picture is named after the
    data.
    """
    monkeypatch.chdir(tmp_path)
    options = ["--size", SIZE, "--root", generated.root]
    drawn = run("plot", SPLIT, *options, "--frame", 5, "--kind", "speed")
    assert drawn.exit_code == 0, drawn.output
    assert (tmp_path / "curl-noise-tiny-0003-frame5.png").read_bytes()[:4] == b"\x89PNG"
    assert (
        run("plot", SPLIT, *options, "--kind", "speed").exit_code == 0
    )  # the last of 26 frames
    assert (tmp_path / "curl-noise-tiny-0003-frame25.png").is_file()
    sources = [generated.folder / "test" / name for name in ("0003.nc", "0004.nc")]
    film = run("animate", *sources, "--every", 13, "-o", "two.gif", "--json")
    assert film.exit_code == 0, film.output
    assert json.loads(film.stdout) == {"output": "two.gif"}
    assert (tmp_path / "two.gif").read_bytes()[:3] == b"GIF"
    assert run("plot", SPLIT, "--size", SIZE, "--root", tmp_path).exit_code == 4


@pytest.mark.parametrize(
    ("pause", "told"), [(0.0, [("60", "3 min"), ("200", "40 s")]), (3600.0, [])]
)
def test_progress_goes_to_a_file_in_lines(
    pause: float,
    told: list[tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A line after every pause has the count, and what is left where it is known; quick
    work leaves none.
    """
    monkeypatch.setattr("lagbench.cli.output.SECONDS_PER_LINE", pause)
    with progress_bar(quiet=False, counted="steps") as tell:
        for n in (60, 200):
            tell(
                Progress(
                    stage="loss 1",
                    done=n,
                    total=240,
                    scenarios_done=n,
                    scenarios=240,
                    seconds=n,
                )
            )
    said = capsys.readouterr()
    assert said.out == ""
    counts = [
        re.search(r"(\d+)/240 steps, 1.00/s, (.+) left", line)
        for line in said.err.splitlines()
    ]
    assert [found and found.groups() for found in counts] == told
    with progress_bar(quiet=False) as tell:
        tell(
            Progress(
                stage="writing train",
                done=2,
                total=0,
                scenarios_done=2,
                scenarios=0,
                seconds=1.0,
            )
        )
    assert capsys.readouterr().err == (
        "" if pause else "writing train: 2 scenarios, 2.00/s\n"
    )
    with progress_bar(quiet=True) as silent:
        assert silent is None


def files_below(folder: Path) -> set[str]:
    """Return the names of all files, relative to the folder."""
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("command", ["plot", "animate"])
@pytest.mark.parametrize(
    ("name", "word"), [("none.nc", "missing"), ("text.nc", "not one of lagbench")]
)
def test_a_file_that_the_user_names_and_cannot_be_read_exits_3(
    command: str,
    name: str,
    word: str,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A missing file and a text file are unreadable files, not damaged data sets."""
    monkeypatch.chdir(tmp_path)
    Path("text.nc").write_text("no netCDF")
    for source in (name, tmp_path / name, f"./{name}"):
        result = run(command, source)
        assert result.exit_code == 3, result.output
        assert word in result.stderr
        assert name in result.stderr
        assert "fix: name another file" in result.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("plot", "-o", "{}/a.png"),
        ("plot", "--sheet", "-o", "{}/a.png"),
        ("animate", "-o", "{}/a.gif"),
    ],
)
def test_pictures_go_to_folders_that_are_there(
    words: tuple[str, ...], run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    """A folder that is misspelt is refused, not made."""
    lost = tmp_path / "lost"
    command, *options = (word.format(lost) for word in words)
    result = run(command, SPLIT, "--size", SIZE, "--root", generated.root, *options)
    assert result.exit_code == 2, result.output
    assert str(lost) in result.stderr
    assert not lost.exists()


COMMAND = [sys.executable, "-m", "lagbench"]


@pytest.mark.parametrize("words", [("--help",), ("list",), ("list", "--json")])
def test_a_reader_that_has_left(words: tuple[str, ...]) -> None:
    """Text, tables and help into a pipe that nobody reads end in silence, as the
    shell's commands do.
    """
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        done = subprocess.run(
            [*COMMAND, *words], stdout=pipe, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 141
    assert done.stderr == b""


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
def test_output_that_finds_no_space() -> None:
    """That is work that failed, and no fault of lagbench."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*COMMAND, "--version"], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 5
    assert b"free disk space" in done.stderr
    assert b"unexpected" not in done.stderr


def test_letters_that_a_stream_lacks() -> None:
    """They are escaped, as the sign for what cannot be told apart: what was computed is
    told all the same.
    """
    board = Path(__file__).parents[2] / "leaderboard"
    words = [
        "leaderboard",
        "show",
        "--board",
        str(board),
        "--split",
        "cavity",
        "--size",
        "mini",
    ]
    done = CliRunner(charset="ascii").invoke(app, words)
    assert done.exit_code == 0
    assert "\\u2248" in done.stdout


def test_work_goes_on_without_stderr(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is closed, Python has no such stream."""
    monkeypatch.setattr(sys, "stderr", None)
    assert not watched()
    with progress_bar(quiet=False) as tell:
        assert tell is not None
