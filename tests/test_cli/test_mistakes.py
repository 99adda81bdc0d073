"""Mistakes that are typed often: each message has where, expected, got and fix."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from exchange_readers import straight_runs
from permissions import run_without_permissions
from score_bench import ScoreBench, still
from typer.testing import Result

PARTS = ("where:", "expected:", "got:", "fix:")

ADOPT = "adopt -o mine --radius 0.1 --frame-interval 0.25"
TRAIN = "train curl-noise --size tiny --baseline"


@pytest.fixture(scope="module")
def files(bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound file of predictions, and faulty ones."""
    folder = tmp_path_factory.mktemp("files")
    bench.submit(folder / "good.nc", still)
    for name, fault in FAULTS.items():
        path = Path(shutil.copy(folder / "good.nc", folder / f"{name}.nc"))
        with netCDF4.Dataset(path, "a") as file:
            fault(file)
    write_transposed(folder / "good.nc", folder / "axes.nc")
    (folder / "notes.txt").write_text("a note\n")
    (folder / "empty.nc").touch()
    netCDF4.Dataset(folder / "void.nc", "w").close()
    (folder / "bad.yaml").write_text("format: 1\nrecipes: [\n")
    (folder / "bad_key.yaml").write_text("authors: [A]\ncomand: python x.py\n")
    (folder / "model.onnx").write_bytes(b"onnx")
    (folder / "near" / "board" / "submissions").mkdir(parents=True)
    runs = np.stack(straight_runs(3))
    solid_runs = np.concatenate([runs, runs[..., :1]], axis=-1)
    np.save(folder / "solid.npy", solid_runs)
    np.save(folder / "runs.npy", runs)
    np.save(folder / "axes.npy", np.moveaxis(runs, 1, 3))
    np.save(folder / "metres.npy", 1000.0 * runs)
    runs[0, 5, 3, 1] = np.nan
    np.save(folder / "nan.npy", runs)
    return folder


def set_values(file: netCDF4.Dataset, values: np.ndarray) -> None:
    file["position"][:] = values


def add_nan(file: netCDF4.Dataset) -> None:
    values = file["position"][:].filled()
    values[0, 5, 3, 1] = np.nan
    set_values(file, values)


def write_transposed(source: Path, target: Path) -> None:
    """Write the predictions of a file with frames behind particles."""
    dimensions = ("scenario", "particle", "frame", "space")
    with netCDF4.Dataset(source) as good, netCDF4.Dataset(target, "w") as file:
        for name in good.ncattrs():
            file.setncattr(name, good.getncattr(name))
        for name, dimension in good.dimensions.items():
            file.createDimension(name, len(dimension))
        for name in ("scenario", "frame"):
            numbers = file.createVariable(name, good[name].dtype, (name,))
            numbers[:] = good[name][:]
        values = good["position"][:].filled()
        position = file.createVariable("position", "f4", dimensions)
        position[:] = np.moveaxis(values, 1, 2)


FAULTS: dict[str, Callable[[netCDF4.Dataset], None]] = {
    "nan": add_nan,
    "units": lambda file: set_values(file, 1000.0 * file["position"][:]),
    "old": lambda file: file.setncattr("dataset_version", "0.9.0"),
    "another": lambda file: file.setncattr("split", "cavitty"),
}

MISTAKES = {
    "a misspelt split": "generate cavitty --size tiny",
    "a misspelt size": "generate cavity --size tny",
    "a misspelt split in a file": "score another.nc",
    "no data": "plot cavity --size tiny --root nothing",
    "no data to score by": "score good.nc --root nothing",
    "a picture with another suffix": "plot SCENARIO -o x.jpg",
    "a film with another suffix": "animate SCENARIO -o x.avi",
    "a folder for a picture": "plot SCENARIO -o .",
    "a folder for a film": "animate SCENARIO -o ..",
    "a file that is no predictions": "score notes.txt",
    "a file that is not there": "score goood.nc",
    "an empty file": "score empty.nc",
    "no folder to write to": "score good.nc -o notes.txt/scores",
    "values that are no numbers": "score nan.nc",
    "other units": "score units.nc",
    "exchanged axes": "score axes.nc",
    "an old version": "score old.nc",
    "an unknown option": "score good.nc --spilt cavity",
    "an unknown command": "scroe good.nc",
    "a word for a number": "generate cavity --workers two",
    "nothing to score": "score",
    "no such scenario": "plot curl-noise --size tiny --scenario 99",
    "no such frame": "plot SCENARIO --frame 999",
    "no such picture": "plot SCENARIO --kind vortcity",
    "no such film": "animate SCENARIO --kind streamlines -o x.gif",
    "no such metric": "compare good.nc persistence --metric mse",
    "no such reference": "compare good.nc persistance",
    "another split to compare": "compare good.nc still --split cavity",
    "a text as trajectories": f"{ADOPT} notes.txt",
    "a folder without trajectories": f"{ADOPT} .",
    "exchanged axes of trajectories": f"{ADOPT} axes.npy",
    "trajectories with NaN": f"{ADOPT} nan.npy",
    "trajectories in millimetres": f"{ADOPT} metres.npy",
    "a period without bounds": f"{ADOPT} runs.npy --periodic x",
    "an axis that is none": f"{ADOPT} runs.npy --periodic q --bounds 0,1,0,1",
    "bounds in another form": f"{ADOPT} runs.npy --bounds 0..1",
    "bounds from high to low": f"{ADOPT} runs.npy --bounds 1,0,0,1",
    "YAML that is none": f"{TRAIN} gns --recipe bad.yaml",
    "a misspelt model": f"{TRAIN} gnss",
    "a misspelt setting": f"{TRAIN} gns --set training.step=3",
    "weights that are none": "predict notes.txt -o x.nc",
    "a description that is not there": "submit good.nc --from meta.yaml",
    "a misspelt split to list": "list cavitty",
    "a misspelt split to describe": "info cavitty",
    "a misspelt size to describe": "info curl-noise --size tinny",
    "a misspelt split to cite": "cite cavitty --bibtex",
    "two splits": "info cavity --split curl-noise",
    "no split": "generate",
    "a misspelt subset": "generate curl-noise --size tiny --subset tests",
    "an id of no scenario": "generate curl-noise --size tiny --scenarios 99",
    "ids in words": "generate curl-noise --size tiny --scenarios first",
    "ids that run backwards": "generate curl-noise --size tiny --scenarios 4-1",
    "an unknown device": "generate curl-noise --size tiny --device gpu",
    "no worker": "generate curl-noise --size tiny --workers 0",
    "nothing to verify": "verify cavity --size tiny",
    "less than none to simulate": "verify curl-noise --size tiny --regenerate -1",
    "an unknown format to export": "export curl-noise --size tiny --format h5 -o x",
    "walls for another format": (
        "export curl-noise --size tiny --format gns-npz --from-walls -o x"
    ),
    "an unknown format to import": "import . --format gns -o own",
    "a folder that is no set": "import . --format gns-npz -o own",
    "kinds in another form": "import . --format gns-npz --kinds jelly=3 -o own",
    "a template of a misspelt split": "template cavitty -o x.nc",
    "a template in a folder": "template curl-noise --size tiny -o .",
    "a mirror that is none": (
        "download curl-noise --size tiny --from nowhere --root new"
    ),
    "no connection": (
        "download curl-noise --size tiny --from file:///x --connections 0"
    ),
    "another thing to bench": "bench train",
    "an adopted split to bench": "bench solver --split own --size tiny",
    "a recipe that is not there": f"{TRAIN} gns --recipe tall",
    "an unknown device to train on": f"{TRAIN} gns --device gpu",
    "a setting without its group": f"{TRAIN} gns --set steps=3",
    "a setting without a value": f"{TRAIN} gns --set training.steps",
    "a setting of a wrong type": f"{TRAIN} gns --set training.steps=many",
    "weights to start from that are none": f"{TRAIN} gns --start notes.txt",
    "an unknown size to train on": ("train curl-noise --size tinny --baseline gns"),
    "an ONNX file without its split": "predict model.onnx -o x.nc",
    "weights that are not there": "predict weights.safetensors -o x.nc",
    "no leaderboard": "leaderboard check --board nothing",
    "no leaderboard to compare with": "compare good.nc still --board notes.txt",
    "a folder without scores": "compare . persistence",
    "the reference first": "compare persistence good.nc",
    "nothing to record": "leaderboard check --board nothing --record",
    "data without their folder": "leaderboard check --size tiny",
    "a picture that is no SVG": "leaderboard picture cavity --size mini -o x.png",
    "nothing to run again": "leaderboard reproduce",
    "both kinds of costs": "leaderboard reproduce --all --costs --no-costs",
    "a seed that is none": "generate curl-noise --size tiny --draw-seed 12",
    "a description with an unknown key": "submit good.nc --from bad_key.yaml",
    "a description that is no YAML": "submit good.nc --from bad.yaml",
    "neither added nor replaced": "submit good.nc --add --replace --board .",
    "an unknown extra": "score good.nc --extras transprot",
    "an empty root": "list --root ''",
    "one file twice": "score good.nc good.nc",
    "an animation without pace": "animate SCENARIO --fps 0 -o x.gif",
    "pixels that are none": "plot SCENARIO --dpi 0 -o x.png",
    "files to clean that are none": "clean cavity --size tinny",
    "a misspelt kind of film": "animate SCENARIO --kind vortcity -o x.mp4",
    "an entry that is none": "compare curl-noise/mini/gnss persistence",
    "an entry to run that is none": "leaderboard reproduce cavity/mini/gnss",
    "a data set without entries": "leaderboard reproduce --all --split cavty",
    "a picture without entries": "leaderboard picture poiseuille --size tiny",
    "a text for an id": "animate SCENARIO --scenario test -o film.mp4",
    "a folder of scores to import": "import nothere --format gns-npz -o own",
    "an address without its colon": (
        "download curl-noise --size tiny --from ftp//host/data"
    ),
    "an option for weights only": "predict notes.txt --split curl-noise -o x.nc",
}


HINTS = {
    f"{TRAIN} gns --set training.steps 10": "--set training.steps=10",
    f"{TRAIN} gns --set training.steps=1 training.batch=2": (
        "--set training.steps=1 --set training.batch=2"
    ),
    f"{TRAIN} gns --set=training.steps 10": "blanks: --set training.steps=10",
    f"{TRAIN} gns --set training.steps:10": "colon: --set training.steps=10",
    f"{TRAIN} gns --set training.{'k' * 60} 10": "blanks: --set KEY=VALUE",
    f"{TRAIN} gns --set training.steps = 10": "blanks: --set training.steps=10",
    f"{TRAIN} gns --set training.steps= 10": "blanks: --set training.steps=10",
    f"{TRAIN} gns --set training.steps =10": "blanks: --set training.steps=10",
    f"{TRAIN} gns --set training.rate -1": "blanks: --set training.rate=-1",
    f"{TRAIN} gns --set training.rate = -1e-3": "blanks: --set training.rate=-1e-3",
    f"{TRAIN} gns --set training.steps = 1 training.batch = 2": (
        "--set training.steps=1 --set training.batch=2"
    ),
    f"{TRAIN} gns --set training.steps=1 training.batch =2": (
        "--set training.steps=1 --set training.batch=2"
    ),
    f"{TRAIN} gns --set training.steps 10 --set training.batch = 2 model.a=1": (
        "--set training.steps=10 --set training.batch=2 --set model.a=1"
    ),
    "train --baseline gns --set training.steps 10 --split curl-noise": (
        "fix: write settings with = and without blanks: --set training.steps=10"
    ),
    "train --baseline gns --set training.steps 10 --size tiny": (
        "fix: write settings with = and without blanks: --set training.steps=10"
    ),
    "train --baseline gns --set training.steps= 10 --split curl-noise": (
        "fix: write settings with = and without blanks: --set training.steps=10"
    ),
    f"{TRAIN} gns --set training.steps=1 more": "leave them out",
    f"{TRAIN} gns --set training.steps=many": "expected: a whole number",
    f"{TRAIN} gns --steps 100": "follow --set, as in --set training.steps=100",
    f"{TRAIN} gns --set model.latant=4": "fix: did you mean 'model.latent'? known",
    f"{TRAIN} gns --set training.schedule.evry=4": "'training.schedule.every'?",
    "lagbench score good.nc": "fix: write it once: lagbench score good.nc",
    "lagbench": "fix: write it once: lagbench --help",
    "help generate": "`lagbench generate --help`",
    "--size tiny generate cavity": "behind the command: lagbench generate ... --size",
    "generate -split cavity": "fix: write two hyphens: --split",
    "generate -split=cavity": "fix: write two hyphens: --split",
    "generate --split cavity,fluid": "fix: name one split in each command",
    "train gns --split curl-noise": "by an option: --baseline gns",
    "train curl-noise gns": "by an option: --baseline gns",
    "train gns": "by an option: --baseline gns",
    f"{TRAIN} gns --ouput x": "fix: did you mean --output",
    "generate cavity tiny": "fix: name the size by an option: --size tiny",
    "generate cavity --subset train valid": "with commas: --subset train,valid",
    "verify cavity --scenarios 1, 2": "with commas: --scenarios 1,2",
    "generate --subset train cavity tiny": "fix: name the size by an option: --size t",
    "verify --scenarios 0-3 cavity mini": "fix: name the size by an option: --size m",
    "download --subset test cavity extra": "fix: leave them out",
    "list cavity mini": "fix: leave them out",
    "leaderboard build mini": "fix: leave them out",
    "validate good.nc tiny": "fix: leave them out",
    f"{ADOPT} runs.npy --bounds 0,1, 0,1": "with commas and without blanks",
    "score goood.nc": "good.nc?",
    "score good.nc nan.nc": "lagbench compare",
    f"{TRAIN} gns --set model.latent": "--set model.latent=VALUE",
    f"{TRAIN} gns --set training.rate=0": "did you mean 'training.learning_rate'?",
    "generate curl-noise --size tiny --scenarios 0..3": "a range has a hyphen: 0-3",
    "generate curl-noise --size tiny --scenarios 4,0:3": "a range has a hyphen: 0-3",
    "bench solver cavity": "fix: name the split by an option: --split cavity",
    "bench solver --size tiny cavity": "by an option: --split cavity",
    "bench solver 'my split'": "by an option: --split 'my split'",
    "bench solver cavity --split cavity": "fix: leave them out",
    f"{TRAIN} gns --set training.steps={'9' * 5000}": "the value is no YAML",
    f"{TRAIN} gns --set training.windows=[test]": "where: gns.yaml",
    "predict near -o x.nc": "fix: name a file",
    "plot good.nc -o x.png": "--report",
    "score good.nc --workers 0": "expected: a number not less than 1",
    "generate cavity --workers two": "expected: a whole number",
    "generate cavity --workers 1,2": "fix: give another value",
    f"{ADOPT} runs.npy --radius big": "expected: a number",
    f"{ADOPT} runs.npy --radius 0,1": "fix: write a decimal point: --radius 0.1",
    "generate cavity --size": "where: lagbench generate",
    "leaderboard show --size": "where: lagbench leaderboard show",
    "score good.nc --all=3": "--all takes no value",
    "compare good.nc": "A predictions.nc",
    "validate void.nc": "lagbench template",
    "validate good.nc nan.nc": "expected: lagbench validate [OPTIONS] ",
    "submit good.nc --author A --command x --board near/bord": "near/board",
    f"{ADOPT} runs.npy --periodic w --bounds 0,1,0,1": "each at most once: x, y",
    f"{ADOPT} runs.npy solid.npy": "apart",
    f"{ADOPT} solid.npy --bounds 0,1,0,1": "a pair for each component",
}
"""What the message about a mistake contains, by command."""


@pytest.fixture
def type_command(
    run: Callable[..., Result],
    bench: ScoreBench,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str], Result]:
    """Return what runs a command as if it were typed beside the files."""
    monkeypatch.chdir(files)
    monkeypatch.setenv("LAGBENCH_ROOT", str(bench.root))

    def run_typed(command: str) -> Result:
        words = shlex.split(command)
        monkeypatch.setattr("sys.argv", ["lagbench", *words])
        return run(*words)

    return run_typed


@pytest.mark.parametrize("command", HINTS)
def test_the_message_of_a_mistake_holds_its_fix(
    command: str, type_command: Callable[[str], Result]
) -> None:
    result = type_command(command)
    assert result.exit_code in {1, 2, 3, 4}
    assert has_all_parts(result.output), result.output
    assert HINTS[command] in result.output
    assert "Input should" not in result.output


def test_a_long_setting_is_cut_in_the_message(
    type_command: Callable[[str], Result],
) -> None:
    key = "k" * 5000
    for settings in (f"--set {key}", f"--set {key} 1", f"--set {key}= 1"):
        result = type_command(f"{TRAIN} gns {settings}")
        assert result.exit_code == 2
        assert has_all_parts(result.stderr), result.stderr
        assert len(result.stderr) < 600


def test_a_missing_file_is_not_taken_for_another_one(
    type_command: Callable[[str], Result], tmp_path: Path
) -> None:
    """Numbers name contents, and folders and broken links are no files."""
    (tmp_path / "0004.nc").touch()
    (tmp_path / "predictions").mkdir()
    (tmp_path / "broken.nc").symlink_to("nothing")
    for name in ("0003.nc", "prediction", "broken.nc", "brokn.nc"):
        result = type_command(f"validate {tmp_path / name}")
        assert result.exit_code == 3
        assert has_all_parts(result.output), result.output
        assert "did you mean" not in result.output


def test_a_file_is_suggested_where_a_folder_has_a_nearer_name(
    type_command: Callable[[str], Result], tmp_path: Path
) -> None:
    (tmp_path / "scores.n").mkdir()
    (tmp_path / "scores_.nc").touch()
    result = type_command(f"validate {tmp_path / 'scores.nc'}")
    assert "scores_.nc?" in result.output


def has_all_parts(message: str) -> bool:
    """Say whether a message has where, expected, got and fix."""
    return all(part in message for part in PARTS)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_message_of_a_mistake_has_all_parts(
    mistake: str, type_command: Callable[[str], Result], bench: ScoreBench
) -> None:
    scenario = bench.size.path(bench.root, 3)
    result = type_command(MISTAKES[mistake].replace("SCENARIO", str(scenario)))
    assert result.exit_code in {1, 2, 3, 4, 5}
    assert has_all_parts(result.stderr), result.stderr


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("score good.nc -o --overwrite", "--output"),
        ("template curl-noise --size tiny -qo --overwrite", "--output"),
        ("score good.nc -o -q", "--output"),
        ("score good.nc --report --help", "--report"),
        ("score good.nc --report --root=x", "--report"),
        ("list --root --json", "--root"),
        ("leaderboard show --metric --wide", "--metric"),
        ("leaderboard reproduce --all --board --no-record", "--board"),
    ],
)
def test_an_option_is_no_value_of_another_one(
    command: str, option: str, type_command: Callable[[str], Result]
) -> None:
    """A file or folder of the option's name would surprise whoever forgot a value."""
    files_before = set(os.listdir())
    result = type_command(command)
    assert result.exit_code == 2
    assert has_all_parts(result.stderr), result.stderr
    assert f"{option} has no value" in result.stderr
    assert set(os.listdir()) == files_before


@pytest.mark.parametrize(
    "words", [("cite", ""), ("cite", "--split="), ("compare", "", "other")]
)
def test_an_empty_word_is_not_taken_for_no_word(
    words: tuple[str, ...], run: Callable[..., Result]
) -> None:
    """It comes from a variable of the shell that is not set."""
    result = run(*words)
    assert result.exit_code == 2, result.output
    assert has_all_parts(result.stderr), result.stderr


@pytest.mark.parametrize(
    ("command", "missing"),
    [
        ("predict none.pt --method checkpoint", "none.pt"),
        ("submit none.nc --method predictions", "none.nc"),
        ("score none.nc --split predictions", "'predictions'"),
        ("plot --split source", "'source'"),
    ],
)
def test_a_value_may_be_a_word_of_the_command_s_own(
    command: str, missing: str, type_command: Callable[[str], Result]
) -> None:
    """Nobody types the names that arguments have in the code.

    So the error is about the missing file or split.
    """
    result = type_command(command)
    assert result.exit_code in (2, 3), result.output
    assert missing in result.stderr
    assert "has no value" not in result.stderr


@pytest.mark.parametrize(
    "words", [["-o", ""], ["-qo", ""], ["--output", ""], ["--output="]]
)
@pytest.mark.parametrize("command", ["score good.nc", "template curl-noise"])
def test_an_empty_path_is_refused(
    command: str, words: list[str], run: Callable[..., Result]
) -> None:
    """It would mean the working folder, to whoever has left a variable unset."""
    files_before = set(os.listdir())
    result = run(*command.split(), *words)
    assert result.exit_code == 2
    assert has_all_parts(result.stderr), result.stderr
    assert set(os.listdir()) == files_before


@pytest.mark.parametrize("command", ["score", "validate", "compare", "submit"])
def test_the_option_size_is_refused_where_the_file_states_it(
    command: str, run: Callable[..., Result]
) -> None:
    """These commands have no --size: no other option is suggested for it."""
    result = run(command, "good.nc", "persistence", "--size", "mini")
    assert result.exit_code == 2
    assert has_all_parts(result.stderr), result.stderr
    assert "leave --size out" in result.stderr
    assert "did you mean" not in result.stderr


@pytest.mark.parametrize("command", ["score", "validate", "adopt"])
def test_a_file_without_permission_is_unreadable(
    command: str,
    run: Callable[..., Result],
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The exit code is that of other files that cannot be read."""
    monkeypatch.chdir(files)
    may_access = os.access

    def refuse(path: str | Path, mode: int, **options: bool) -> bool:
        return Path(path).name != "nan.nc" and may_access(path, mode, **options)

    monkeypatch.setattr("os.access", refuse)
    result = run(command, "nan.nc")
    assert result.exit_code == 3
    assert has_all_parts(result.output), result.output


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="capabilities are those of Linux")
@pytest.mark.parametrize(
    "words",
    [
        "validate {}.nc",
        "score {}.nc",
        "compare {}.nc constant-velocity",
        "compare {}.json constant-velocity",
        "compare good.nc {}.nc",
    ],
)
@pytest.mark.parametrize("name", ["closed", "it's closed"])
def test_the_message_names_a_file_without_permission(
    name: str, words: str, files: Path, bench: ScoreBench, tmp_path: Path
) -> None:
    folder = shutil.copytree(files, tmp_path / "files")
    for ending in (".nc", ".json"):
        path = Path(shutil.copy(folder / "good.nc", folder / f"{name}{ending}"))
        path.chmod(0)
    command = [word.format(name) for word in words.split(" ")]
    closed_file = next(word for word in command if word.startswith(name))
    done = run_without_permissions(
        "-m", "lagbench", *command, "--root", bench.root, folder=folder
    )
    assert done.returncode == 3, done.stderr
    assert has_all_parts(done.stderr), done.stderr
    assert f"where: {closed_file}\n" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="capabilities are those of Linux")
def test_a_scenario_without_permission_is_named_in_the_message(
    files: Path, bench: ScoreBench, tmp_path: Path
) -> None:
    """It is data that cannot be read, and nothing says that it is to be made again."""
    root = shutil.copytree(bench.root, tmp_path / "root")
    truth = bench.size.path(root, 3)
    truth.chmod(0)
    words = ["score", files / "good.nc", "--root", root, "--workers", 1]
    output = tmp_path / "scores"
    done = run_without_permissions("-m", "lagbench", *words, "-o", output)
    assert done.returncode == 4, done.stderr
    assert has_all_parts(done.stderr), done.stderr
    assert truth.name in done.stderr
    assert "ermission" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
@pytest.mark.parametrize("form", ["--workers=1", "--json"])
def test_a_full_standard_output_exits_5_and_leaves_the_scores(
    form: str, files: Path, bench: ScoreBench, tmp_path: Path
) -> None:
    """The exit code says that the output is not whole; the files of scores are."""
    words = ["score", str(files / "good.nc"), "--root", str(bench.root), form]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "lagbench", *words, "-o", str(tmp_path)],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 5, done.stderr
    assert has_all_parts(done.stderr), done.stderr
    assert (tmp_path / "scores.json").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="/proc refuses all, the root too")
def test_a_folder_that_cannot_be_written_exits_5(
    run: Callable[..., Result], files: Path, bench: ScoreBench
) -> None:
    predictions = files / "good.nc"
    result = run("score", predictions, "--root", bench.root, "-o", "/proc/x")
    assert result.exit_code == 5
    assert has_all_parts(result.stderr), result.stderr


def test_a_missing_library_is_named_with_its_command(
    run: Callable[..., Result], bench: ScoreBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fix is the command that installs it."""
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: None)
    command = f"{TRAIN} gns"
    result = run(*command.split(), "--root", bench.root)
    assert result.exit_code == 2
    assert has_all_parts(result.stderr), result.stderr
    assert "pip install" in result.stderr
