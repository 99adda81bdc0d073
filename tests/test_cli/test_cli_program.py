"""How commands end: exit codes, messages on stderr, closed pipes, full disks."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from score_bench import ScoreBench, still
from typer.testing import CliRunner, Result

import lagbench
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.cli.output import format_bytes, print_table
from lagbench.cli.program import app
from lagbench.data.registry import default_path

Run = Callable[..., Result]

PROGRAM = [sys.executable, "-m", "lagbench"]


@pytest.mark.parametrize(
    ("line", "culprit"),
    [
        ("info", "--split"),
        ("info cavity --split fluid", "cavity and fluid"),
        ("info cavty", "'cavity'"),
        ("verify --split cavity --size ful", "full or mini or tiny"),
        ("generate cavity --size tiny --scenarios 7-3", "7-3"),
        ("generate cavity --size tiny --scenarios 70", "70"),
        ("generate cavity --size tiny --device tpu", "tpu"),
        ("plot cavity --kind sped", "'speed'"),
        ("animate cavity -o film.avi", "avi"),
    ],
)
def test_usage_errors_exit_2(line: str, culprit: str, run: Run, tmp_path: Path) -> None:
    """A wrong name, option or value gives one message on stderr and no traceback."""
    result = run(*line.split(), "--root", tmp_path)
    assert result.exit_code == 2, result.output
    assert culprit in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


@pytest.mark.filterwarnings("always::lagbench.data.registry.PluginWarning")
def test_a_broken_package_is_warned_of_once(
    package: Callable[..., Path], bench: ScoreBench, run: Run, tmp_path: Path
) -> None:
    """Several parts of a command ask for the metrics; the warning names the line of the
    fault.
    """
    module_file = package("metrics", "broken_metric:METRICS", "1 / 0\n")
    predictions = bench.submit(tmp_path / "still.nc", still)
    result = run("score", predictions, "--root", bench.root)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("adds no metric") == 1
    assert f"({module_file}, line 1)" in result.stderr


@pytest.mark.filterwarnings("always")
def test_other_warnings_are_printed_as_often_as_they_come(
    package: Callable[..., Path], bench: ScoreBench, run: Run, tmp_path: Path
) -> None:
    """Two trainings in a command may have the same text; one of them was silent."""
    lines = (
        "import warnings",
        "Own = type('Own', (UserWarning,), {'__module__': 'lagbench.own'})",
        "for _ in range(2):",
        "    warnings.warn('the same text', Own)",
        "METRICS = ()",
    )
    package("metrics", "warning_metric:METRICS", "\n".join(lines))
    predictions = bench.submit(tmp_path / "still.nc", still)
    result = run("score", predictions, "--root", bench.root)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("the same text") == 2


def test_an_unknown_command_exits_2(run: Run) -> None:
    result = run("genrate")
    assert result.exit_code == 2
    assert "'generate'" in result.stderr
    assert result.stdout == ""


def test_one_split_may_be_named_twice(run: Run) -> None:
    """SPLIT and --split mean the same."""
    by_argument = run("cite", "cavity")
    by_both = run("cite", "cavity", "--split", "cavity")
    assert by_argument.exit_code == by_both.exit_code == 0
    assert by_argument.stdout == by_both.stdout


def test_an_unreadable_registry_exits_3(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message names the wrong key."""
    text = default_path().read_text()
    registry = tmp_path / "own.yaml"
    registry.write_text(text.replace("licence: CC-BY-4.0", "license: CC-BY-4.0", 1))
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(registry))
    result = run("list")
    assert result.exit_code == 3
    assert "'license'" in result.stderr
    assert "'licence'" in result.stderr


def raise_in_list(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command list raise an error."""

    def fail() -> None:
        raise error

    monkeypatch.setattr("lagbench.cli.inventory.load", fail)


def test_an_unexpected_error_is_short(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault of ours gives a message; LAGBENCH_DEBUG=1 gives the traceback."""
    error = RuntimeError("out of\x1b[2J luck")
    raise_in_list(error, monkeypatch)
    result = run("list")
    assert result.exit_code == 5
    assert r"RuntimeError: out of\x1b[2J luck" in result.stderr
    assert "Traceback" not in result.stderr
    monkeypatch.setenv("LAGBENCH_DEBUG", "1")
    assert run("list").exception is error


class MuteError(RuntimeError):
    """An exception whose author forgot an attribute."""

    def __str__(self) -> str:
        """Fail to return a text."""
        return str(self.missing)  # type: ignore[attr-defined]


def test_an_exception_without_a_text_is_named_by_its_class(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    raise_in_list(MuteError(), monkeypatch)
    result = run("list")
    assert result.exit_code == 5
    assert "MuteError" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_interruption_is_no_error_to_trace(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    raise_in_list(KeyboardInterrupt(), monkeypatch)
    result = run("list")
    assert result.exit_code == 130
    assert "interrupted" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("command", "option"),
    [("train", "--fresh"), ("generate", "--force")],
)
def test_an_interruption_says_to_leave_out_what_deletes_the_work(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: str, option: str
) -> None:
    """The same command with the option would delete what was done so far."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("typer.core.TyperCommand.invoke", interrupt)
    monkeypatch.setattr("sys.argv", ["lagbench", command, option])
    result = run(command, option)
    assert result.exit_code == 130
    assert f"without {option}" in result.stderr


@pytest.mark.parametrize(
    ("line", "advice"),
    [
        ("leaderboard reproduce --all", "goes on where it stopped"),
        ("leaderboard reproduce --all --no-record", "begins anew"),
        ("leaderboard check", "begins anew"),
        ("score predictions.nc", "begins anew"),
        ("predict weights.safetensors", "begins anew"),
    ],
)
def test_an_interruption_says_what_the_same_command_does(
    line: str, advice: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some commands keep what they have done, the others begin anew."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    words = line.split()
    monkeypatch.setattr("typer.core.TyperCommand.invoke", interrupt)
    monkeypatch.setattr("sys.argv", ["lagbench", *words])
    result = run(*words)
    assert result.exit_code == 130
    assert f"the same command {advice}" in result.stderr


@pytest.mark.parametrize("words", [("--help",), ("list",), ("list", "--json")])
def test_a_closed_pipe_ends_in_silence(words: tuple[str, ...]) -> None:
    """Text, tables and help end as the shell's commands do when nobody reads them."""
    reading_end, writing_end = os.pipe()
    os.close(reading_end)
    with os.fdopen(writing_end, "w") as pipe:
        done = subprocess.run(
            [*PROGRAM, *words], stdout=pipe, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 141
    assert done.stderr == b""


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
def test_a_full_disk_exits_5() -> None:
    """It is work that failed, and no fault of lagbench."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PROGRAM, "--version"], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 5
    assert b"fix:" in done.stderr
    assert b"unexpected" not in done.stderr


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
@pytest.mark.parametrize("is_full", [True, False], ids=["full disk", "no reader"])
def test_a_warning_that_cannot_be_printed_stops_nothing(
    is_full: bool, tmp_path: Path
) -> None:
    """The command says what it was asked for, as with an stderr that takes it."""
    package = tmp_path / "absent-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Name: absent\nVersion: 1.0\n")
    entry_points = "[lagbench.generators]\nabsent = no_such_module\n"
    (package / "entry_points.txt").write_text(entry_points)
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    read_end, write_end = os.pipe()
    os.close(read_end)
    with (
        open("/dev/full", "w") as full,
        open(write_end, "w") as without_reader,
    ):
        outputs = []
        for stderr in (subprocess.PIPE, full if is_full else without_reader):
            done = subprocess.run(
                [*PROGRAM, "list"],
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=environment,
                check=False,
            )
            assert done.returncode == 0
            outputs.append(done)
    assert b"absent" in outputs[0].stderr
    assert outputs[1].stdout == outputs[0].stdout


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
@pytest.mark.parametrize(
    ("words", "code"), [(("info", "none"), 2), (("info", "-x"), 2)]
)
def test_a_full_stderr_leaves_the_exit_code(words: tuple[str, ...], code: int) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([*PROGRAM, *words], stderr=full, check=False)
    assert done.returncode == code


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("score", ("FILE", "lagbench score --help")),
        ("score a.nc --root", ("--root",)),
        ("score a.nc --worker 2", ("--worker", "--workers")),
        ("score a.nc --workers x", ("--workers", "'x'")),
        ("plot cavity --dpi 5", ("--dpi", "5")),
        ("leaderboard chek", ("chek",)),
        ("cite cavity fluid", ("fluid",)),
    ],
)
def test_mistakes_on_the_command_line_have_the_parts_of_all_messages(
    line: str, words: tuple[str, ...], run: Run
) -> None:
    """Where, got and fix; no box and no usage line."""
    result = run(*line.split())
    assert result.exit_code == 2
    for word in ("where: lagbench", "fix: ", *words):
        assert word in result.stderr
    assert "Usage:" not in result.stderr


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (OSError(errno.EIO, "Input/output error", "/mnt/disk/file"), "/mnt/disk/file"),
        (OSError(errno.ESTALE, "Stale file handle", "/mnt/disk"), "/mnt/disk"),
        (FileNotFoundError(errno.ENOENT, "No such file"), "the working folder"),
        (MemoryError(), "memory"),
        (ImportError("x.so: failed to map segment from shared object"), "memory"),
    ],
)
def test_a_vanished_disk_and_full_memory_are_no_faults_of_lagbench(
    error: Exception, word: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    raise_in_list(error, monkeypatch)
    result = run("list")
    assert result.exit_code == 5
    assert word in result.stderr
    assert "unexpected" not in result.stderr


@pytest.mark.parametrize("command", ["list", "doctor"])
def test_a_processor_too_old_for_numpy_is_no_fault_of_lagbench(
    command: str, tmp_path: Path
) -> None:
    """The words are those of NumPy 2.4.6 on an emulated Penryn (`qemu-x86_64`)."""
    package = tmp_path / "numpy"
    package.mkdir()
    refusal = (
        "NumPy was built with baseline optimizations: \n(X86_V2) but your machine "
        "doesn't support:\n(X86_V2)."
    )
    text = f"raise RuntimeError({refusal!r})\n"
    (package / "__init__.py").write_text(text, encoding="utf-8")
    search_path = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [*PROGRAM, command],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(search_path)},
    )
    assert done.returncode == 5, done.stderr
    assert "X86_V2" in done.stderr
    assert "fix: install an older NumPy" in done.stderr
    assert "unexpected" not in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("list", "{long}"),
        ("info", "{long}"),
        ("plot", "{long}.nc"),
        ("score", "{long}.nc"),
        ("adopt", "{long}", "--radius", "0.1", "--frame-interval", "1", "-o", "own"),
        ("compare", "p.nc", "persistence", "--board", "{long}"),
        ("leaderboard", "show", "--board", "{long}"),
    ],
    ids=lambda words: words[0],
)
def test_a_name_that_is_too_long_is_no_fault_of_lagbench(
    words: tuple[str, ...], run: Run
) -> None:
    """No disk has such a file, and the message does not repeat all of the name."""
    result = run(*(word.format(long="x" * 400) for word in words))
    assert result.exit_code in (2, 3), result.output
    assert "fix:" in result.stderr
    assert "unexpected" not in result.stderr
    assert len(result.stderr) < 1500


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "generate cavity --size tiny --scenarios 0 --workers 1",
        "train cavity --baseline gns --size tiny",
    ],
)
def test_a_limit_of_memory_is_named_in_the_message(line: str, tmp_path: Path) -> None:
    """Taichi asks for a gigabyte of addresses; with less OpenBLAS tries for ever."""
    script = (
        "import resource, runpy, sys\n"
        f"resource.setrlimit(resource.RLIMIT_AS, ({700_000 * 1024},) * 2)\n"
        "runpy.run_module('lagbench', run_name='__main__')\n"
    )
    words = [*line.split(), "--root", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", script, *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 5, done.stderr
    assert "memory" in done.stderr
    assert "fix: " in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_letters_that_a_stream_lacks_are_escaped() -> None:
    """The sign ÷ of a heading is no ASCII; the table is printed all the same."""
    board = Path(lagbench.__file__).parents[1] / "leaderboard"
    line = f"leaderboard show --board {board} --split cavity --size mini"
    done = CliRunner(charset="ascii").invoke(app, line.split())
    assert done.exit_code == 0
    assert "\\xf7" in done.stdout


@pytest.mark.slow
def test_the_leaderboard_is_shown_in_one_table_for_each_data_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No line is wider than a narrow terminal, and stated costs have a mark."""
    monkeypatch.setenv("COLUMNS", "80")
    board = Path(lagbench.__file__).parents[1] / "leaderboard"
    data_sets = Folder(board).data_sets()
    done = CliRunner().invoke(app, ["leaderboard", "show", "--board", str(board)])
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    headings = [line for line in lines if line.split()[:2] == ["rank", "method"]]
    assert len(headings) == len(data_sets) > 1
    assert all(line.split()[-1] == "remarks" for line in headings)

    stated = read_entry(board / "submissions/cavity/mini/var-stable.yaml")
    assert stated.cost is not None
    titles = [line for line in lines if line.startswith("cavity mini ")]
    start = lines.index(titles[0])
    (line,) = [line for line in lines[start : start + 30] if " var-stable " in line]
    assert f"{stated.cost.seconds_per_frame:.2g}*" in line.split()
    assert "*: time self-reported" in lines[start + 1]


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (999.6, "1.0 kB"),
        (1000, "1.0 kB"),
        (99_940, "99.9 kB"),
        (99_960, "100 kB"),
        (100_000, "100 kB"),
        (999_499, "999 kB"),
        (999_500, "1.0 MB"),
        (999_960_000, "1.0 GB"),
        (12_345_000_000_000, "12345 GB"),
    ],
)
def test_bytes_are_rounded_before_their_unit_is_chosen(count: float, text: str) -> None:
    assert format_bytes(count) == text


def test_a_title_is_not_wrapped_to_the_width_of_its_table(
    capsys: pytest.CaptureFixture[str],
) -> None:
    title = "a title of many more characters than the table below it has"
    print_table(title, ("a", "b"), [("1", "2")])
    assert capsys.readouterr().out.splitlines()[0] == title
