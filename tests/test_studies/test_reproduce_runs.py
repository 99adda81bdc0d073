"""Runs that are reproduced: those of another recipe or other data, and models without
the recipe.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import netCDF4
import pytest

from lagbench.baselines import catalogue
from lagbench.data.registry import Registry
from lagbench.errors import UsageError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.scoring.score_file import read_statistics
from studies.thesis import __main__ as command
from studies.thesis import runs, tables
from studies.thesis.plan import TABLES, Plan, read_study_results
from studies.thesis.published import MLP_STUDIES
from studies.thesis.roster import ROSTER

pytest.importorskip("torch", reason="the extra 'baselines' is not installed")

Reproduce = Callable[..., int]

SPLIT = "curl-noise"
REPOSITORY = Path(__file__).parents[2]

ONLY = ("--only", "fig_5_22")
"""A figure that needs one run, of SuperGAT."""

FILES = ("weights.safetensors", "training.json", "predictions.nc", "scores.nc")


@pytest.fixture
def reproduce(
    generated: GenerationResult, unmeasured: Registry, tmp_path: Path
) -> Reproduce:
    """Call the command on tiny curl-noise data."""

    def call(*words: str) -> int:
        options = [
            *("--size", "tiny"),
            *("--root", str(generated.root)),
            *("--runs", str(tmp_path / "runs")),
            *("--device", "cpu"),
            *("--threads", "1"),
            *("--set", "model.layers=1"),
        ]
        return command.main([*options, *words], registry=unmeasured)

    return call


def stamps(folder: Path) -> dict[str, int]:
    """Return when the files of a run were written."""
    times = {}
    for name in FILES:
        times[name] = (folder / name).stat().st_mtime_ns
    return times


Times = dict[str, int]


def changed_files(before: Times, after: Times) -> list[str]:
    """Return the names of the files that were written between two looks."""
    return [name for name in FILES if after[name] != before[name]]


def label(file: Path, **labels: str) -> None:
    """Change attributes of a netCDF file."""
    with netCDF4.Dataset(file, "a") as data:
        data.setncatts(labels)


@pytest.mark.slow
def test_runs_of_another_recipe_or_other_data_are_not_reused(
    reproduce: Reproduce, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run with another recipe or on other data ends the command; scores of other data
    are made again.
    """
    folder = tmp_path / "runs" / SPLIT / "tiny" / "supergat-0"
    steps = "--set", "training.steps=1"
    assert reproduce(*ONLY, *steps) == 0
    first = stamps(folder)
    capsys.readouterr()

    assert reproduce(*ONLY, "--set", "training.steps=2") == 2
    output = capsys.readouterr()
    assert str(folder) in output.err
    assert "supergat: no run" in output.out.lower(), (
        "nothing of a run that was refused is drawn"
    )

    label(folder / "scores.nc", dataset_sha256="f" * 64)
    assert reproduce(*ONLY, *steps) == 0
    assert str(folder / "scores.nc") in capsys.readouterr().err
    again = stamps(folder)
    assert changed_files(first, again) == ["scores.nc"]

    label(folder / "predictions.nc", dataset_sha256="f" * 64)
    assert reproduce(*ONLY, *steps, "--dry-run") == 0
    assert "supergat-0: to predict and score" in capsys.readouterr().out
    assert reproduce(*ONLY, *steps) == 0
    again = stamps(folder)
    assert changed_files(first, again) == ["predictions.nc", "scores.nc"]

    record = folder / "training.json"
    content = json.loads(record.read_text())
    content["dataset_sha256"] = "e" * 64
    record.write_text(json.dumps(content))
    assert reproduce(*ONLY, *steps) == 4


def test_studies_of_another_recipe_are_not_reused(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Errors of an MLP with another recipe are measured again. One file holds the
    results of a row and suffices for its table, unless it is of other data.
    """
    monkeypatch.setitem(TABLES, "table_4_2", ("4.2", SPLIT))
    for module in (runs, tables):
        monkeypatch.setattr(module, "study_rows", lambda _: MLP_STUDIES[:1])
    one_step = ("training.steps=1", "model.widths=[4]")
    plan = Plan(
        size="tiny",
        settings=one_step,
        device="cpu",
        threads=1,
        registry=unmeasured,
        root=generated.root,
        runs=tmp_path / "runs",
        output=tmp_path / "out",
    )
    runs.make_studies(plan, "table_4_2")
    home = plan.home(SPLIT)

    def written_at() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in home.rglob("*.*")}

    first = written_at()
    runs.make_studies(plan, "table_4_2")
    assert written_at() == first
    studies = read_study_results([home], plan.hash(SPLIT))
    study = studies["mlp-4-2-1"]
    assert study["train"] > 0.0
    assert study["training"]["step"] == 1
    item = tables.studies_beside_thesis("table_4_2", "tiny", studies)
    (row,) = item.tables[0].rows
    assert f"{study['valid']:.3g}" in row
    other_hash = "f" * 64
    assert read_study_results([home], other_hash) == {}
    stale = {**study, "training": {"dataset_sha256": other_hash}}
    later = {**study, "train": 9.0}
    for other, expected in ((stale, study), (later, later)):
        content = json.dumps({"mlp-4-2-1": other})
        (tmp_path / "mlp_studies.json").write_text(content)
        studies = read_study_results([home, tmp_path], plan.hash(SPLIT))
        assert studies == {"mlp-4-2-1": expected}
    more_steps = replace(plan, settings=("training.steps=2", "model.widths=[4]"))
    with pytest.raises(UsageError):
        runs.make_studies(more_steps, "table_4_2")


def test_options_of_steps_are_left_out_for_a_model_that_is_fitted() -> None:
    """VAR takes no steps; other models get the option."""
    plan = Plan(
        size="tiny",
        root=Path("data"),
        runs=Path("runs"),
        output=Path("out"),
        settings=("training.steps=3", "training.windows=9"),
    )
    assert runs._settings_for(plan, ROSTER["var"]) == ("training.windows=9",)
    assert runs._settings_for(plan, ROSTER["supergat"]) == plan.settings


@pytest.fixture
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Graph networks have a short recipe for tiny, MLPs have none; both are meant for
    curl-noise.
    """
    folder = tmp_path / "recipes"
    folder.mkdir()
    one_step = {"training": {"steps": 1}}
    for name, recipe in (("gns", "tiny-short"), ("mlp", "tiny")):
        recipes = {"format": 1, "recipes": {f"*/{recipe}": one_step}}
        content = json.dumps(recipes)  # JSON is YAML
        (folder / f"{name}.yaml").write_text(content)
    monkeypatch.setattr(catalogue, "RECIPES", folder)
    monkeypatch.setattr(command, "EXPECTED", {SPLIT: ("supergat", "mlp")})


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_models_without_the_recipe_are_left_out(
    reproduce: Reproduce, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With ``--recipe short`` a model that has none is named on stderr, and all others
    are made.
    """
    words = (
        *ONLY,
        *("--split", SPLIT),
        *("--recipe", "short"),
        *("--set", "model.latent=8"),
    )
    home = tmp_path / "runs" / SPLIT / "tiny-short"
    assert reproduce(*words, "--dry-run") == 0
    output = capsys.readouterr()
    plan = "curl-noise tiny supergat-0: to train, curl-noise/tiny-short: 1 steps\n"
    assert output.out == plan
    assert "'short'" in line_of("curl-noise tiny mlp", output.err)
    assert not home.exists()

    assert reproduce(*words) == 0
    output = capsys.readouterr()
    assert "curl-noise tiny mlp: left out" in output.err
    names = [folder.name for folder in home.iterdir()]
    assert names == ["supergat-0"]
    assert reproduce(*words, "--dry-run") == 0
    assert capsys.readouterr().out == "curl-noise tiny supergat-0: there\n"


def line_of(run: str, output: str) -> str:
    """Return the one line of a plan that begins with the name of a run."""
    (line,) = [line for line in output.splitlines() if f"{run}:" in line]
    return line


def test_a_recipe_that_no_model_has_is_a_mistake(
    reproduce: Reproduce, capsys: pytest.CaptureFixture[str]
) -> None:
    """A misspelt recipe ends with exit code 2 and leaves nothing out."""
    assert reproduce(*ONLY, "--recipe", "shrt", "--dry-run") == 2
    output = capsys.readouterr().err
    assert "no recipe 'curl-noise/tiny-shrt'" in output
    assert "left out" not in output


def test_plans_for_full_are_listed_without_data(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """For full, list and dry run name each run, with the short recipes and with those
    of the thesis.
    """
    places = (
        *("--size", "full"),
        *("--root", str(tmp_path)),
        *("--runs", str(tmp_path / "runs")),
    )
    assert command.main([*places, "--recipe", "short", "--list"]) == 0
    assert "table_5_4" in capsys.readouterr().out
    assert command.main([*places, "--recipe", "short", "--dry-run"]) == 0
    output = capsys.readouterr()
    assert "cavity/full-short: 14,000 " in line_of("cavity full gns-0", output.out)
    assert "fluid/full-short: 1,500 " in line_of("fluid full mlp-0", output.out)
    assert "studies of table_4_2: left out" in output.err
    short_cavity = ["--recipe", "short", "--dry-run", "--split", "cavity"]
    assert command.main([*places, *short_cavity]) == 0
    output = capsys.readouterr()
    assert "cavity/full-short: 1,000 " in line_of("cavity full mlp-0", output.out)
    assert line_of("cavity full var", output.err)
    assert command.main([*places, "--dry-run", "--split", "fluid"]) == 0
    output = capsys.readouterr()
    assert "fluid/full: 600 epochs" in line_of("fluid full mlp-0", output.out)
    assert "a fit" in line_of("fluid full var-0", output.out)
    assert "studies of table_4_2\n" in output.out
    assert "lagbench generate --split fluid --size full" in output.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("recipe", [(), ("--recipe", "short")])
def test_models_without_a_recipe_for_the_size_are_left_out(
    recipe: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At full curl noise has recipes for neither the plain VAR nor the unrolled GNS."""
    words = [
        *("--size", "full"),
        *("--split", SPLIT),
        *("--root", str(tmp_path)),
        *("--runs", str(tmp_path / "runs")),
        "--dry-run",
    ]
    assert command.main([*words, *recipe]) == 0
    output = capsys.readouterr()
    assert line_of("curl-noise full gns-0", output.out)
    for name in ("var", "gns-unrolled"):
        assert "left out" in line_of(f"curl-noise full {name}", output.err)
        assert f"{name}-0" not in output.out


def test_a_variant_is_not_trained_in_the_place_of_another_one(tmp_path: Path) -> None:
    """The unrolled GNS has a recipe of its own, and no other one."""
    plan = Plan(size="mini", root=tmp_path, runs=tmp_path, output=tmp_path)
    unrolled = ROSTER["gns-unrolled"]
    assert plan.has_recipe(SPLIT, unrolled)
    assert replace(plan, recipe="unrolled").has_recipe(SPLIT, unrolled)
    assert not replace(plan, recipe="pushforward").has_recipe(SPLIT, unrolled)
    assert replace(plan, recipe="pushforward").has_recipe(SPLIT, ROSTER["gns"])


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="the system has no full device"
)
def test_a_full_disk_is_an_error_with_a_message() -> None:
    """It has the exit code of work that failed."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "studies.thesis", "--list"],
            cwd=REPOSITORY,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == WorkFailedError.exit_code
    assert done.stderr.startswith("error: ")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_committed_weights_are_shown_without_training(
    reproduce: Reproduce, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their predictions are made on the spot, once, and are those of the run that the
    weights come from.
    """
    run_folder = tmp_path / "runs" / SPLIT / "tiny" / "supergat-0"
    weights = tmp_path / "weights" / SPLIT / "tiny"
    assert reproduce(*ONLY, "--set", "training.steps=1") == 0
    weights.mkdir(parents=True)
    for source, target in (
        ("weights.safetensors", "supergat_3.safetensors"),
        ("training.json", "supergat_3.json"),
    ):
        (run_folder / source).rename(weights / target)
    expected = read_statistics(run_folder / "scores.nc").predictions_sha256
    shutil.rmtree(tmp_path / "runs")
    capsys.readouterr()

    words = (*ONLY, "--no-training", "--weights", str(tmp_path / "weights"))
    assert reproduce(*words) == 0
    assert "seeds 3; 1 x 2 steps" in capsys.readouterr().out
    folder = run_folder.with_name("supergat-3")
    scores = read_statistics(folder / "scores.nc")
    assert scores.predictions_sha256 == expected
    first = stamps(folder)
    assert reproduce(*words) == 0
    assert stamps(folder) == first
    figures = tmp_path / "runs" / "reproduce" / "tiny"
    assert list(figures.glob("fig_5_22*.png"))


def test_unusable_committed_weights_leave_nothing(
    reproduce: Reproduce, tmp_path: Path
) -> None:
    """No weights leave a figure that says so; damaged ones end with exit code 3, and no
    run appears.
    """
    runs_folder = tmp_path / "runs"
    without_training = (*ONLY, "--no-training", "--weights")
    assert reproduce(*without_training, str(tmp_path / "none")) == 0
    names = [path.name for path in runs_folder.iterdir()]
    assert names == ["reproduce"]
    weights = tmp_path / "weights" / SPLIT / "tiny" / "supergat_0.safetensors"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(b"no weights")
    assert reproduce(*without_training, str(tmp_path / "weights")) == 3
    assert not list((runs_folder / SPLIT).rglob("*.*"))
