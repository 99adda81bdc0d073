"""The command line: what it prints, its exit codes, and that it starts at once."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from conftest import SIZE, SPLIT
from typer.main import get_command
from typer.testing import Result

from lagbench.cli.app import app
from lagbench.cli.output import progress_bar
from lagbench.data.registry import default_path, load
from lagbench.make.generate import GenerationResult
from lagbench.work.progress import Progress

COMMANDS = ["list", "info", "generate", "verify", "plot", "animate", "cite", "doctor", "clean"]


Run = Callable[..., Result]


def command(*words: str) -> list[str]:
    """Return the command line of a lagbench process."""
    return [sys.executable, "-c", "from lagbench.cli import main; main()", *words]


def test_help_lists_the_commands_in_the_order_of_use(run: Run) -> None:
    """Every command stands in the help, from looking around to cleaning up."""
    text = run("--help").stdout
    places = [re.search(rf"^\W*{name} ", text, re.MULTILINE) for name in COMMANDS]
    assert all(places)
    starts = [place.start() for place in places if place]
    assert starts == sorted(starts)


def test_every_command_has_an_example_that_parses(run: Run) -> None:
    """The help of a command ends with an example whose words the command accepts."""
    commands = dict(get_command(app).commands)  # type: ignore[attr-defined]
    board = commands.pop("leaderboard").commands
    for name in (*commands, *(f"leaderboard {name}" for name in board)):
        text = " ".join(run(*name.split(), "--help").stdout.split())
        example = re.search(rf"Example: lagbench ({name}.*?)$", text)
        assert example is not None, name
        result = run(*example[1].split(), "--help")
        assert result.exit_code == 0, result.output


def test_list_shows_every_size(run: Run, generated: GenerationResult) -> None:
    """A row for each split and size; as JSON with counts, bytes, time and what is here."""
    text = run("list", "--root", generated.root).stdout
    assert len([line for line in text.splitlines() if re.search(r" (full|mini|tiny) ", line)]) == 12
    data = json.loads(run("list", "--root", generated.root, "--json").stdout)
    sizes = {(entry["split"], entry["size"]): entry for entry in data["sizes"]}
    here = sizes[SPLIT, SIZE]
    assert here["present"] == {"train": 2, "valid": 1, "test": 2}
    assert here["picture"].endswith("scenarios.png")
    full = sizes["cavity", "full"]
    assert full["frames"] == 45_600
    assert full["bytes"] == 45_600 * 8192 * 16 + 76 * 65536
    assert full["present"] == {"train": 0, "valid": 0, "test": 0}
    assert full["seconds"] > 60.0


def test_info_shows_parameters_with_units_and_state(run: Run, generated: GenerationResult) -> None:
    """By argument or by option; what is generated has a folder and a picture."""
    by_argument = run("info", SPLIT, "--size", SIZE, "--root", generated.root)
    by_option = run("info", "--split", SPLIT, "--size", SIZE, "--root", generated.root)
    assert by_argument.exit_code == 0
    assert by_argument.stdout == by_option.stdout
    text = by_argument.stdout
    assert re.search(r"velocity_scale +\S+ +\S+ +\S+ +\[length/s\]", text)
    assert str(generated.folder) in text
    assert "pictures/scenarios.png" in text
    assert "(there: yes)" in text
    data = json.loads(run("info", SPLIT, "--size", SIZE, "--json").stdout)
    assert data["sizes"][SIZE]["parameters"]["modulus"]["unit"] == "mass/s^2"
    assert data["sizes"][SIZE]["subsets"]["test"] == [3, 4]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["info"], "no split is named"),
        (["info", "cavity", "--split", "fluid"], "two splits are named"),
        (["info", "cavty"], "did you mean 'cavity'?"),
        (["verify", "--split", "cavity", "--size", "ful"], "did you mean 'full'?"),
        (["generate", "cavity", "--size", "tiny", "--scenarios", "7-3"], "runs backwards"),
        (["generate", "cavity", "--size", "tiny", "--scenarios", "70"], "no scenario 70"),
        (["generate", "cavity", "--size", "tiny", "--device", "tpu"], "no device 'tpu'"),
        (["generate", "cavity", "--workers", "0"], "--workers"),
        (["generate", "--sizes", "tiny"], "--sizes"),
        (["plot", "cavity", "--kind", "sped"], "did you mean 'speed'?"),
        (["animate", "cavity", "-o", "film.avi"], "avi"),
        (["genrate"], "genrate"),
    ],
)
def test_usage_errors_exit_2(words: list[str], message: str, run: Run, tmp_path: Path) -> None:
    """A wrong name, option or value: one message on stderr, no traceback, exit code 2."""
    result = run(*words, *(["--root", tmp_path] if words != ["genrate"] else []))
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


def test_generate_and_verify(run: Run, tmp_path: Path) -> None:
    """One scenario: a report for people, a JSON object for machines, and nothing but errors when quiet."""
    options = [SPLIT, "--size", SIZE, "--root", tmp_path, "--scenarios", "2"]
    dry = run("generate", *options, "--dry-run")
    assert "1 scenarios to simulate" in dry.stdout
    assert re.search(r"disk .*bytes.*free", dry.stdout)
    assert re.search(r"time +about \d+ s", dry.stdout)
    made = run("generate", *options)
    assert made.exit_code == 0, made.output
    assert "missing 0-1,3-4: the data set is incomplete" in made.stdout
    assert all("scenarios" in line for line in made.stderr.splitlines())  # progress, on a slow machine
    again = json.loads(run("generate", *options, "--json").stdout)
    assert (again["simulated"], again["kept"], again["complete"]) == ([], [2], False)
    assert run("generate", *options, "--quiet").output == ""
    checked = run("verify", SPLIT, "--size", SIZE, "--root", tmp_path)
    assert checked.exit_code == 0
    assert "warning: train lacks 0-1" in checked.stderr
    missing = run("verify", SPLIT, "--size", SIZE, "--root", tmp_path, "--complete")
    assert missing.exit_code == 4
    assert "the data set is incomplete" in missing.stderr


def test_verify_reports_as_json_too(run: Run, copied: Callable[[], Path]) -> None:
    """A damaged data set is described on stdout, named on stderr, exit code 4."""
    root = copied()
    path = root / SPLIT / SIZE / "v2" / "valid" / "0002.nc"
    path.write_bytes(path.read_bytes()[:-500])
    result = run("verify", SPLIT, "--size", SIZE, "--root", root, "--json")
    assert result.exit_code == 4
    assert json.loads(result.stdout)["subsets"][1]["wrong"] == [2]
    assert "0002.nc" in result.stderr


def test_errors_of_files_exit_3(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A registry that cannot be read is told with the key that is wrong."""
    own = tmp_path / "own.yaml"
    own.write_text(default_path().read_text().replace("licence: CC-BY-4.0", "license: CC-BY-4.0", 1))
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(own))
    result = run("list")
    assert result.exit_code == 3
    assert "unknown key 'license': did you mean 'licence'?" in result.stderr


def test_the_unexpected_asks_for_a_report(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault of ours: a short message and exit code 5; the traceback only when LAGBENCH_DEBUG=1."""

    def broken() -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr("lagbench.data.registry.load", broken)
    result = run("list")
    assert result.exit_code == 5
    assert "unexpected RuntimeError: out of luck" in result.stderr
    assert "please report it" in result.stderr
    assert "Traceback" not in result.stderr
    monkeypatch.setenv("LAGBENCH_DEBUG", "1")
    assert isinstance(run("list").exception, RuntimeError)


def test_an_interruption_exits_130(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C anywhere in a command is no error to trace."""

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lagbench.data.registry.load", interrupted)
    result = run("list")
    assert result.exit_code == 130
    assert "interrupted" in result.stderr


def test_cite_names_version_hash_and_works(run: Run) -> None:
    """What a paper needs: the split's version and what it builds on."""
    text = run("cite", "cavity").stdout
    assert "version 2.0.0" in text
    assert "Ghia" in text
    assert json.loads(run("cite", "cavity", "--json").stdout)["licence"] == "CC-BY-4.0"


def test_a_tag_names_the_version() -> None:
    """A release's tag is v and the version of pyproject.toml, which CITATION.cff and README have too."""
    root = Path(__file__).parents[1]
    version = tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"]
    assert yaml.safe_load((root / "CITATION.cff").read_text())["version"] == version
    assert f"version = {{{version}}}" in (root / "README.md").read_text()
    # Outside of git, and in an archive that was unpacked in another repository, there are no tags of ours.
    if not (root / ".git").exists() or shutil.which("git") is None:
        pytest.skip("no clone")
    asked = ["git", "-C", str(root), "tag", "--points-at", "HEAD", "--list", "v[0-9]*"]
    tags = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.split()
    if not tags:
        pytest.skip("no tag at HEAD")
    assert tags == [f"v{version}"]
    heads = re.findall(r"^## (.*)$", (root / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert version in heads[0]


def test_bibtex_is_what_citation_cff_says(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of lagbench: title, version and year of CITATION.cff; of a split: its version and every hash."""
    monkeypatch.delenv("LAGBENCH_REGISTRY")
    cff = yaml.safe_load((Path(__file__).parent.parent / "CITATION.cff").read_text())
    own = bibtex_fields(run("cite", "--bibtex").stdout)
    assert own == {
        "author": "{The lagbench authors}",
        "title": cff["title"],
        "version": cff["version"],
        "year": str(cff["date-released"].year),
    }
    split = bibtex_fields(run("cite", "cavity", "--bibtex").stdout)
    hashes = [held.dataset_sha256 for held in load().measured["cavity"].values()]
    assert split["version"] == load().split("cavity").version
    assert len(hashes) == sum(value in split["note"] for value in hashes) == 3


def bibtex_fields(text: str) -> dict[str, str]:
    """Return the fields of the one entry of a BibTeX text, whose braces must match."""
    assert text.count("{") == text.count("}")
    kind, _, body = text.strip().partition("{")
    assert kind in {"@software", "@misc"}
    return dict(re.findall(r"^  (\w+) = \{(.*)\},$", body, re.MULTILINE))


def test_doctor_finds_this_machine_fit(run: Run, tmp_path: Path) -> None:
    """All that is needed is here; a root that nobody can write is broken, exit code 1."""
    data = json.loads(run("doctor", "--root", tmp_path, "--json").stdout)
    states = {check["name"]: check["state"] for check in data["checks"]}
    assert states["numpy"] == states["registry"] == states["data folder"] == "ok"
    (tmp_path / "file").write_text("")
    result = run("doctor", "--root", tmp_path / "file" / "data")
    assert result.exit_code == 1
    assert "broken: data folder" in result.stderr


def test_clean_removes_ours_only(run: Run, copied: Callable[[], Path]) -> None:
    """A dry run says what would go; then all of it is gone but a stranger's file."""
    root = copied()
    folder = root / SPLIT / SIZE / "v2"
    (folder / "notes.txt").write_text("mine")
    (folder / "test" / ".0003.nc.1.partial").write_text("")
    options = [SPLIT, "--size", SIZE, "--root", root]
    assert json.loads(run("clean", *options, "--leftovers", "--json").stdout)["removed"] == [
        str(folder / "test" / ".0003.nc.1.partial")
    ]
    dry = run("clean", *options, "--dry-run").stdout
    assert "10 files" in dry
    assert (folder / "test" / "0003.nc").exists()
    assert run("clean", *options).exit_code == 0
    assert [path.name for path in root.rglob("*") if path.is_file()] == ["notes.txt"]
    (folder / "notes.txt").unlink()
    assert run("clean", *options).exit_code == 0
    assert list(root.iterdir()) == []
    assert run("clean", *options).exit_code == 0


def test_plot_and_animate_name_their_files(
    run: Run, generated: GenerationResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By split and id or by file; without a name the picture is named after the data."""
    monkeypatch.chdir(tmp_path)
    options = ["--size", SIZE, "--root", generated.root]
    drawn = run("plot", SPLIT, *options, "--frame", 5, "--kind", "speed")
    assert drawn.exit_code == 0, drawn.output
    assert (tmp_path / "curl-noise-tiny-0003-frame5.png").read_bytes()[:4] == b"\x89PNG"
    source = generated.folder / "test" / "0003.nc"
    film = run(
        "animate", source, generated.folder / "test" / "0004.nc", "--every", 13, "-o", "two.gif", "--json"
    )
    assert film.exit_code == 0, film.output
    assert json.loads(film.stdout) == {"output": "two.gif"}
    assert (tmp_path / "two.gif").read_bytes()[:3] == b"GIF"
    lost = run("plot", SPLIT, "--size", SIZE, "--root", tmp_path)
    assert lost.exit_code == 4


@pytest.mark.parametrize(("pause", "told"), [(0.0, [("60", "3 min"), ("200", "40 s")]), (3600.0, [])])
def test_progress_goes_to_a_file_in_lines(
    pause: float,
    told: list[tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A line after every pause says the count and what is left; quick work and --quiet leave none."""
    monkeypatch.setattr("lagbench.cli.output.SECONDS_PER_LINE", pause)
    with progress_bar(quiet=False, counted="steps") as tell:
        assert tell is not None
        for done in (60, 200):
            tell(
                Progress(
                    stage="loss 1", done=done, total=240, scenarios_done=done, scenarios=240, seconds=done
                )
            )
    said = capsys.readouterr()
    assert said.out == ""
    counts = [re.search(r"(\d+)/240 steps, 1.00/s, (.+) left", line) for line in said.err.splitlines()]
    assert [found and found.groups() for found in counts] == told
    with progress_bar(quiet=True) as silent:
        assert silent is None


def test_progress_without_a_known_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trajectories of a file that is read one by one are counted, without a total, share or time left."""
    monkeypatch.setattr("lagbench.cli.output.SECONDS_PER_LINE", 0.0)
    with progress_bar(quiet=False) as tell:
        assert tell is not None
        tell(Progress(stage="writing train", done=2, total=0, scenarios_done=2, scenarios=0, seconds=1.0))
    assert capsys.readouterr().err == "writing train: 2 scenarios, 2.00/s\n"
