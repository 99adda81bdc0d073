"""Tables and figures of the thesis, and the page of results: from runs to Markdown, CSV
and PNG.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from numpy.testing import assert_array_equal
from PIL import Image
from reproduce_bench import NOISE, SIZE, SPLIT, markdown_rows, pretend
from score_bench import ScoreBench, bench_of
from turns import of_this_turn

from lagbench.baselines.checkpoint import load as load_checkpoint
from lagbench.data.grid import fields
from lagbench.data.registry import Registry, Size, load
from lagbench.make.generate import GenerationResult
from lagbench.scoring.score_file import read_statistics
from studies import results
from studies.thesis.__main__ import main
from studies.thesis.catalogue import ITEMS
from studies.thesis.drawing import open_rollouts
from studies.thesis.plan import Plan
from studies.thesis.roster import EXPECTED, ROSTER
from studies.thesis.runs import make_runs
from studies.thesis.split_results import (
    Method,
    ScoredTraining,
    Sources,
    SplitResults,
    format_budget,
)

BOARD = Path(__file__).parents[2] / "leaderboard"


@pytest.fixture(scope="session")
def cavity(
    tiny_split: Callable[..., GenerationResult], unmeasured: Registry
) -> ScoreBench:
    """The tiny cavity."""
    return bench_of(tiny_split(SPLIT), unmeasured)


@pytest.fixture(scope="session")
def runs(cavity: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of runs that pretend to be six operators: the truth with more and more
    noise.
    """
    return pretend(cavity, tmp_path_factory.mktemp("runs"))


@pytest.fixture
def plan(cavity: ScoreBench, runs: Path, tmp_path: Path) -> Plan:
    """What a user asks for who has these runs."""
    return Plan(
        size=SIZE,
        registry=cavity.registry,
        device="cpu",
        root=cavity.root,
        runs=runs,
        output=tmp_path / "out",
    )


def test_runs_are_read_with_their_costs(plan: Plan) -> None:
    """Scores, hours, parameters and seconds are those of the files."""
    cavity_results = plan.results(SPLIT)
    assert list(cavity_results.models) == sorted(NOISE)
    method = cavity_results.methods["gns"]
    training = method.trainings[0]
    scores = read_statistics(training.path).scores()
    at_frame = scores["vorticity_mse"].at(15)
    expected = float(np.mean(at_frame))
    assert method.at("vorticity_mse", 15) == pytest.approx(expected)
    assert method.parameters == 123
    assert training.cpu_hours == 2.0
    assert method.cost is not None
    assert method.cost.seconds_per_frame == 0.5
    assert method.cost.speed_up is None


def test_hours_per_seed_are_the_mean_of_those_that_are_recorded() -> None:
    """1 h, 3 h and none are 2 h; of none known there is no mean."""
    records: list[dict[str, float]] = [
        {"cpu_seconds": 3600.0},
        {"cpu_seconds": 10_800.0},
        {},
    ]
    seeds = []
    for seed, record in enumerate(records):
        training = ScoredTraining(seed=seed, scores={}, record=record, path=Path())
        seeds.append(training)
    all_three = Method(name="gns", trainings=tuple(seeds))
    assert all_three.hours_per_seed == 2.0
    without_record = Method(name="gns", trainings=(seeds[2],))
    assert without_record.hours_per_seed is None


def write_entry(board: Path, **changes: object) -> None:
    """Write the committed entry of GNS for another size, with one seed, changed."""
    committed = BOARD / "submissions" / SPLIT / "mini" / "gns-pushforward.yaml"
    entry = yaml.safe_load(committed.read_text())
    entry["method"] = "gns"
    entry["size"] = SIZE
    score = entry["score"]
    score["files"] = score["files"][:1]
    entry["predictions"] = entry["predictions"][:1]
    entry.update(changes)
    path = board / "submissions" / SPLIT / SIZE / "gns.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(yaml.safe_dump(entry))


def test_the_board_comes_first(plan: Plan, tmp_path: Path) -> None:
    """A committed entry wins over a run of the same seed, with its costs.

    Each run has costs of its own.
    """
    board = tmp_path / "board"
    weights = tmp_path / "weights"
    scores = board / "scores" / SPLIT / SIZE / "gns.nc"
    record = weights / SPLIT / SIZE / "gns_0.json"
    scores.parent.mkdir(parents=True)
    record.parent.mkdir(parents=True)
    scores_of_run = plan.home(SPLIT) / "gat-0" / "scores.nc"
    shutil.copy(scores_of_run, scores)
    record.write_text(json.dumps({"cpu_seconds": 3600.0}))
    cost = {
        "seconds_per_frame": 0.1,
        "device": "here",
        "solver_seconds_per_frame": 0.05,
    }
    write_entry(board, parameters=7, cost=cost)

    sources = Sources(
        board=board,
        weights=weights,
        runs=plan.runs,
        registry=plan.described,
    )
    methods = SplitResults(sources, SPLIT, SIZE).methods
    committed = methods["gns"]
    assert committed.trainings[0].path == scores
    assert committed.trainings[0].cpu_hours == 1.0
    assert committed.parameters == 7
    assert committed.cost is not None
    assert committed.cost.speed_up == pytest.approx(0.5)
    # another entry's solver may have run on another machine
    run = methods["gat"]
    assert run.cost is not None
    assert run.cost.speed_up is None


@pytest.mark.parametrize(
    "change",
    [
        {"status": "withdrawn"},
        {"status": "superseded", "superseded_by": "gns-pushforward"},
    ],
)
def test_an_inactive_entry_takes_no_part(
    change: dict[str, str], tmp_path: Path
) -> None:
    write_entry(tmp_path, **change)
    methods = SplitResults(Sources(board=tmp_path), SPLIT, SIZE).methods
    assert "gns" not in methods


@pytest.mark.parametrize("split", ["fluid", "multimaterial"])
def test_an_entry_states_what_its_record_states(split: str, tmp_path: Path) -> None:
    """Of our committed entries: hours, steps, epochs, recipe and validations are the
    same without records.
    """
    with_records = Sources(board=BOARD, weights=BOARD / "weights")
    without_records = Sources(board=BOARD, weights=tmp_path)
    recorded = SplitResults(with_records, split, "mini").models
    from_entries = SplitResults(without_records, split, "mini").models
    compared_count = 0
    for name, method in recorded.items():
        recipe_names = set()
        for training in method.trainings:
            recipe = training.record.get("recipe", {})
            recipe_names.add(recipe.get("name"))
        method_from_entry = from_entries[name]
        pairs = zip(method.trainings, method_from_entry.trainings, strict=True)
        for training, entry in pairs:
            record = training.record
            if not record.get("validation") or not entry.record.get("validation"):
                continue  # an older training, or its entry, has no validations
            compared_count += 1
            assert entry.cpu_hours == pytest.approx(training.cpu_hours, rel=1e-5)
            assert format_budget(entry.record) == format_budget(record)
            for key in ("windows", "validation"):
                assert entry.record.get(key) == record.get(key)
            # an entry describes the training of one of its seeds
            assert entry.record["recipe"]["name"] in recipe_names
    assert compared_count > 0


def test_scores_of_other_data_are_left_out(runs: Path) -> None:
    """Where the registry records another hash than the score files hold, all of them
    are stale.
    """

    class Elsewhere(Sources):
        def size(self, split: str, size: str) -> Size:
            ours = load().size(split, size)
            assert ours.measured is not None
            other_hash = {"dataset_sha256": "0" * 64}
            measured = ours.measured.model_copy(update=other_hash)
            return ours.model_copy(update={"measured": measured})

    other_data = Elsewhere(board=None, runs=runs)
    elsewhere = SplitResults(other_data, SPLIT, SIZE)
    assert not elsewhere.methods
    assert len(elsewhere.stale) == len(NOISE)


def test_runs_of_another_recipe_are_a_variant(
    runs: Path, cavity: ScoreBench, tmp_path: Path
) -> None:
    """A run in tiny-short/ is gns-short beside the others, and gns with the option for
    that recipe.
    """
    short = tmp_path / SPLIT / f"{SIZE}-short"
    gns = runs / SPLIT / SIZE / "gns-0"
    shutil.copytree(gns, short / "gns-0")
    sources = Sources(board=None, runs=tmp_path, registry=cavity.registry)
    for recipe, names in (
        (None, ["gns-short"]),
        ("short", ["gns"]),
        ("long", []),
    ):
        of_recipe = replace(sources, recipe=recipe)
        variant = SplitResults(of_recipe, SPLIT, SIZE)
        assert list(variant.methods) == names


@pytest.fixture
def sources(plan: Plan, tmp_path: Path) -> Sources:
    """Runs alone, nothing committed."""
    none = tmp_path / "none"
    return Sources(
        board=none,
        weights=none,
        runs=plan.runs,
        registry=plan.described,
    )


def page_of(sources: Sources) -> str:
    """Return the page of results."""
    return results.render(sources, (SIZE,))


def test_the_page_shows_models_skill_and_training(sources: Sources) -> None:
    """Models stand best first with their skill, the thesis's numbers and their training
    beside them.
    """
    page = page_of(sources)
    _, section = page.split(f"## {SPLIT} {SIZE}\n")
    rows = markdown_rows(section, "seeds")
    first_models = [row["model"] for row in rows[:3]]
    assert first_models == ["SuperGAT", "GAT", "GNS"]
    assert rows[0]["skill"] == "-"  # no naive baseline was scored
    assert "0.007715" in page  # SuperGAT's MAE in Table 5.4
    trainings = {}
    for row in markdown_rows(page, "decrease in the second half"):
        trainings[row["model"]] = row
    training = trainings["GNS"]
    assert training["epochs"] == "0.8"  # 40 steps of 2 of 100 windows
    assert training["validation at 1/4"] == "4"
    assert training["validation at 1/2"] == "2"
    assert training["validation at the end"] == "0.5"
    assert training["decrease in the second half"] == "75 %"
    for row in markdown_rows(page, "the first is"):
        assert row["the first is"] == "too few scenarios"
    assert page == page_of(sources)


def test_studies_stand_beside_the_thesis(sources: Sources, tmp_path: Path) -> None:
    """A table of which a row was committed is shown with what the thesis prints, and no
    other.
    """
    assert "Table 4.3 on" not in page_of(sources)
    training = {
        "parameters": 1234,
        "step": 7,
        "windows": 100,
        "cpu_seconds": 36.0,
        "dataset_sha256": "f" * 64,
        "recipe": {"training": {"batch": 32}},
    }
    study = {
        "training": training,
        "train": 0.25,
        "valid": 0.5,
        "seed": 0,
    }
    studies = tmp_path / "studies"
    home = studies / "fluid" / SIZE
    home.mkdir(parents=True)
    content = json.dumps({"mlp-4-3-2": study})
    (home / "mlp_studies.json").write_text(content)
    page = page_of(replace(sources, studies=studies))
    rows = markdown_rows(page, "train, thesis")
    (row,) = [row for row in rows if row["train, ours"] != "-"]
    expected = {
        "hidden layers": "200 x 200 x 200",
        "parameters, ours": "1,234",
        "steps x batch, ours": "7 x 32",
        "train, thesis": "0.1147",
        "train, ours": "0.25",
        "valid, thesis": "0.1194",
        "valid, ours": "0.5",
    }
    for heading, cell in expected.items():
        assert row[heading] == cell
    assert len(rows) == 6  # the widths of Table 4.3


def test_what_is_missing_is_listed_with_its_command(
    sources: Sources, tmp_path: Path
) -> None:
    """Where entries are missing stands the command; a training whose predictions were
    refused is no gap.
    """
    folder = tmp_path / SPLIT / SIZE
    folder.mkdir(parents=True)
    (folder / "mlp_0.json").write_text("{}")
    page = page_of(replace(sources, weights=tmp_path))
    _, section = page.split("## Missing")
    missing = section.splitlines()
    gaps = []
    for line in missing:
        if line.startswith(f"- {SPLIT} {SIZE}: ") and "floors" not in line:
            gaps.append(line)
    refused, absent = gaps
    assert ROSTER["mlp"].label in refused
    assert ROSTER["supergat-unlinked"].label in absent
    for split in EXPECTED:
        command = f"python -m studies.thesis --size {SIZE} --split {split}"
        commands = [line for line in missing if command in line]
        assert len(commands) == 1


@pytest.mark.parametrize("has_reference", [False, True])
def test_the_page_works_without_entries(
    plan: Plan,
    sources: Sources,
    tmp_path: Path,
    has_reference: bool,
) -> None:
    """Without entries, or with reference predictors alone: a page without claims that
    names the command for every size.
    """
    if has_reference:
        run = plan.folder(SPLIT, "gns", 0)
        shutil.copytree(run, tmp_path / SPLIT / SIZE / "persistence-0")
    page = page_of(replace(sources, runs=tmp_path))
    for split in EXPECTED:
        assert f"--size {SIZE} --split {split}" in page
    assert "the first is" not in page
    has_section = f"## {SPLIT} {SIZE}" in page
    assert has_section is has_reference


@pytest.mark.slow
def test_a_stale_page_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--check fails on a missing page and on one that differs by a byte, and writes
    nothing.
    """
    output = tmp_path / "results.md"
    options = [
        *("-o", str(output)),
        *("--board", str(tmp_path / "board")),
        *("--weights", str(tmp_path)),
    ]
    check = [*options, "--check"]
    assert results.main(check) == 1
    assert not output.exists()
    assert results.main(options) == 0
    assert results.main(check) == 0
    page = output.read_text()
    output.write_text(page + "an old line")
    assert results.main(check) == 1
    assert "-an old line" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "name: gns",
        "[1]",
        "words",
        "predictions: 3",
    ],
)
def test_an_entry_that_is_none_is_named(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file that is no entry ends the command, which names it."""
    board = tmp_path / "board"
    output = tmp_path / "r.md"
    entry = board / "submissions" / "cavity" / "mini" / "gns.yaml"
    entry.parent.mkdir(parents=True)
    entry.write_text(text)
    options = ["-o", str(output), "--board", str(board)]
    assert results.main(options) != 0
    assert not output.exists()
    assert "gns.yaml" in capsys.readouterr().err


def test_rollouts_show_truth_and_prediction(plan: Plan, cavity: ScoreBench) -> None:
    """Positions are those of the files, velocities their differences, fields the
    scorer's own.
    """
    scenario = cavity.size.subsets["test"][0]
    truth = cavity.truth(scenario).astype(float)
    with open_rollouts(
        plan,
        SPLIT,
        scenario=scenario,
        names=("supergat", "gns", "mlp"),
    ) as rollouts:
        assert tuple(rollouts.predictions) == ("supergat", "gns")  # mlp has no run
        given = rollouts.position("gns", 5)
        assert_array_equal(given, truth[5])
        predicted = rollouts.position("gns", 6)
        assert not np.array_equal(predicted, truth[6])
        predicted = rollouts.position("supergat", 9)
        assert_array_equal(predicted, truth[9])
        pair = rollouts.pair("supergat", 15)
        residual = np.abs(pair.vorticity_residual)
        assert float(residual.max()) == 0.0
        scene = rollouts.scene("supergat", 6)
        assert_array_equal(scene.displacement, truth[6] - truth[5])
        of_truth = pair.truth.scenario
        expected = fields(
            truth[15],
            truth[15] - truth[14],
            of_truth.config.grid,
            full=of_truth.full_weight,
        )
        vorticity = pair.truth.fields.vorticity
        assert_array_equal(vorticity, expected.vorticity)


def test_every_reproduced_figure_has_an_item() -> None:
    """Every numbered result of the thesis's chapters 3 to 5 has an item.

    Each item needs models that the roster knows.
    """
    numbers_of_chapters = {
        "fig_4": (4, 5, 6, 8, 11, 12, 13),
        "fig_5": (5, *range(10, 20), *range(21, 29)),
        "table_3": (1,),
        "table_4": (2, 3, 4, 5, 7, 8),
        "table_5": (1, 3, 4, 5),
    }
    expected = {"section_3_2_2", "section_4_8_3"}
    for chapter, numbers in numbers_of_chapters.items():
        expected |= {f"{chapter}_{number}" for number in numbers}
    assert set(ITEMS) == expected
    for figure in ITEMS.values():
        for split, names in figure.needs.items():
            assert set(names) <= set(EXPECTED[split])
    for names in EXPECTED.values():
        assert set(names) <= set(ROSTER)


def options(plan: Plan, *more: str) -> list[str]:
    """Return the command line of a plan."""
    return [
        *("--size", SIZE),
        *("--root", str(plan.root)),
        *("--runs", str(plan.runs)),
        *("-o", str(plan.output)),
        *("--device", "cpu"),
        *more,
    ]


def run_plan(plan: Plan, *more: str) -> int:
    """Return the exit code of the command line of a plan."""
    return main(options(plan, *more), registry=plan.registry)


DRAWN = (
    "table_5_3",
    "table_5_4",
    "fig_5_5",
    "fig_5_10",
    "fig_5_11",
    "fig_5_12",
    "fig_5_13",
    "fig_5_14",
    "fig_5_15",
    "fig_5_16",
    "fig_5_17",
    "fig_5_19",
)


@pytest.mark.slow
def test_tables_and_figures_are_written(plan: Plan) -> None:
    """Markdown, CSV and pictures are there, with the scorer's numbers, budget and hours
    in them.
    """
    names = ",".join(DRAWN)
    assert run_plan(plan, "--no-training", "--only", names) == 0
    drawn = plan.output
    for name in DRAWN:
        text = (drawn / f"{name}.md").read_text()
        assert "Size tiny." in text
        for picture in drawn.glob(f"{name}*.png"):
            assert f"]({picture.name})" in text
            with Image.open(picture) as image:
                assert min(image.size) > 150
                pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
            brightness = np.unique(pixels.sum(axis=1))
            assert len(brightness) > 10
    text = (drawn / "table_5_4.md").read_text()
    assert re.search("cavity, GNS: .*40 x 2 .* 2 CPU hours", text)
    with (drawn / "table_5_4-1.csv").open() as file:
        rows = {row["model"]: row for row in csv.DictReader(file)}
    gns = plan.results(SPLIT).methods["gns"]
    expected = gns.at("vorticity_mae", 15)
    ours = float(rows["GNS"]["MAE ours mean"])
    assert ours == pytest.approx(expected, rel=5e-3)
    assert rows["GNS"]["MAE thesis"] == "0.009757"
    assert float(rows["SuperGAT"]["MAE ours mean"]) == 0.0


def test_unknown_names_are_answered_with_the_nearest(
    plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    """A misspelt item, split, size or seed, a seed that is named twice, or no worker,
    ends with exit code 2.
    """
    for option, wrong, right in (
        ("--only", "table_54", "table_5_4"),
        ("--split", "cavty", "cavity"),
        ("--size", "midi", "mini"),
        ("--seeds", "a", "0,1"),
        ("--seeds", "0,0", "0,1"),
    ):
        assert main([option, wrong]) == 2
        assert right in capsys.readouterr().err
    for more in ((), ("--dry-run",), ("--no-training",)):
        code = run_plan(plan, "--workers", "0", *more)
        assert code == 2
    capsys.readouterr()
    assert main(["--list", "--split", "fluid"]) == 0
    assert "table_4_8" in capsys.readouterr().out


def test_a_reader_that_leaves_stops_nothing() -> None:
    """``--list | head -1``: exit code 0 and no traceback."""
    words = [sys.executable, "-m", "studies.thesis", "--list"]
    with subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        child.stdout.close()
        assert child.stderr.read() == ""
    assert child.returncode == 0


def test_a_table_that_fails_is_named_and_others_are_written(
    plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the data of another split its tables fail with exit code 4; others are
    written. The remedy makes the data of the size that was asked for.
    """
    code = run_plan(plan, "--no-training", "--only", "table_5_1,table_5_3")
    assert code == 4
    errors = capsys.readouterr().err
    assert "table_5_1" in errors
    assert f"lagbench generate --split curl-noise --size {SIZE}" in errors
    assert (plan.output / "table_5_3.md").is_file()


@pytest.mark.slow
def test_side_by_side_as_one_after_the_other(
    plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two workers leave the weights that one leaves; an error names the run that
    failed, and the others are made.
    """
    short = {
        "settings": ("training.steps=2", "training.validate_every=0"),
        "threads": 1,
    }
    first_run = ("fluid", ROSTER["mlp"], 0)  # there are no data of fluid
    other_runs = [
        (SPLIT, ROSTER["mlp"], 0),
        (SPLIT, ROSTER["mlp"], 1),
    ]
    weights = {}
    for workers in (1, 2):
        asked = replace(plan, runs=tmp_path / str(workers), **short)
        code = make_runs(asked, [first_run, *other_runs], workers=workers)
        assert code == 4
        # what other processes say does not pass through this one
        is_told_here = "cavity tiny mlp-1" in capsys.readouterr().err
        assert is_told_here == (workers == 1)
        weights[workers] = []
        for split, model, seed in other_runs:
            folder = asked.folder(split, model.name, seed)
            assert (folder / "scores.nc").is_file()
            checkpoint = load_checkpoint(folder / "weights.safetensors")
            weights[workers].append(checkpoint.weights)
    for alone, beside in zip(weights[1], weights[2], strict=True):
        for name, value in alone.items():
            assert torch.equal(value, beside[name])


def test_an_interrupt_says_how_to_go_on(
    plan: Plan,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit code 130, as of every command, and no traceback."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("studies.thesis.__main__.make_runs", stop)
    assert run_plan(plan, "--only", "table_5_4") == 130
    assert "goes on" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(not of_this_turn([0], turns=3, shift=1), reason="not in this turn")
def test_all_tables_and_figures_are_written_at_tiny(
    tmp_path: Path,
    unmeasured: Registry,
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """From nothing but data, every table and figure of a size; two steps of training
    are enough for that.
    """
    root = tmp_path / "data"
    folder = tmp_path / "runs" / "reproduce" / SIZE
    for split in EXPECTED:
        shutil.copytree(tiny_split(split).root, root, dirs_exist_ok=True)
    short = [
        *("--size", SIZE),
        *("--root", str(root)),
        *("--runs", str(tmp_path / "runs")),
        *("--device", "cpu"),
        *("--threads", "1"),
        *("--set", "training.steps=2"),
    ]
    frames = set()
    for name, figure in ITEMS.items():
        if {"fluid", "multimaterial"} & figure.needs.keys():
            frames.add(name)
    # untrained networks of states start so far off that the validation refuses them
    near = ["--set", "model.target=change"]
    items_of_frames = ",".join(sorted(frames))
    code = main([*short, *near, "--only", items_of_frames], registry=unmeasured)
    assert code == 0
    other_items = ",".join(sorted(ITEMS.keys() - frames))
    code = main([*short, "--only", other_items], registry=unmeasured)
    assert code == 0
    for name in ITEMS:
        text = (folder / f"{name}.md").read_text()
        assert "no run" not in text
    text = (folder / "table_5_4.md").read_text()
    after_scipy = text.split("SciPy")[1]
    assert "| - |" not in after_scipy.split("link")[0]
