"""Blind seasons: seeds, blind scenarios, scores that come back, and what is refused."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_board import NAME, PATH, ModelBoard
from typer.testing import CliRunner, Result

from lagbench.board.entry import Level
from lagbench.board.entry_file import yaml_bytes
from lagbench.board.folder import Folder
from lagbench.board.reproduce import reproduce
from lagbench.board.season import (
    MOST_SEASON_BYTES,
    FrozenModel,
    Season,
    close,
    draw_seed,
    read_season,
    reveal,
    season_registry,
    season_root,
)
from lagbench.board.season_run import SeasonResult, run_season
from lagbench.board.season_scores import frozen_models, read_scores
from lagbench.board.season_table import record_blind, season_rows
from lagbench.board.verified import read_verified
from lagbench.cli.program import app
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.errors import ChecksFailedError, DataError, UsageError
from lagbench.generators.draws import generator, seed_text
from lagbench.make.generate import generate

SEASON = "trial"


@pytest.fixture(scope="module")
def master(
    tmp_path_factory: pytest.TempPathFactory, model_board: ModelBoard
) -> ModelBoard:
    """A board with a closed season, its blind scenarios, and its scores."""
    folder = tmp_path_factory.mktemp("season")
    root = folder / "data"
    shutil.copytree(model_board.root, root)
    shutil.copytree(model_board.folder, folder / "board")
    bench = replace(model_board, folder=folder / "board", root=root)
    simulate(bench, close_season(bench))
    run_season(bench.folder, SEASON, root=root)
    return bench


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory, master: ModelBoard) -> ModelBoard:
    """A board with two entries of one model, a closed season and its scenarios."""
    folder = tmp_path_factory.mktemp("twins")
    shutil.copytree(master.folder, folder / "board")
    root = folder / "data"
    shutil.copytree(master.root, root)
    bench = replace(master, folder=folder / "board", root=root)
    scores = bench.folder / f"scores/{NAME}.nc"
    entry = bench.folder / PATH
    twin = entry.with_stem("twin")
    shutil.copy(scores, scores.with_stem("twin"))
    shutil.copy(entry, twin)

    def rename(content: dict[str, Any]) -> None:
        content["method"] = "twin"

    bench.edit(twin, rename)
    simulate(bench, close_season(bench, "twins"))
    return bench


@pytest.fixture
def own(master: ModelBoard, tmp_path: Path) -> ModelBoard:
    """A copy of the leaderboard that the test may change; the data are shared."""
    shutil.copytree(master.folder, tmp_path / "board")
    return replace(master, folder=tmp_path / "board")


def close_season(bench: ModelBoard, name: str = SEASON, source: str = "") -> Season:
    """Close a season of four blind scenarios."""
    return close(
        bench.folder,
        name,
        scenarios=4,
        source=source,
        root=bench.root,
        lagbench="0.1.0",
    )


def simulate(bench: ModelBoard, season: Season) -> None:
    """Simulate the blind scenarios of a season."""
    generate(
        "curl-noise",
        "tiny",
        root=season_root(season.season, bench.root),
        registry=season_registry(season, load(), {}, board=bench.folder),
        workers=1,
    )


def run_again(bench: ModelBoard, *, again: bool = False) -> SeasonResult:
    """Run the season and compare its scores with those on the board."""
    return run_season(
        bench.folder,
        SEASON,
        root=bench.root,
        comparing=True,
        again=again,
    )


def test_the_seed_is_a_hash_that_anybody_can_form() -> None:
    """Of six kinds of lines; the order of the models means nothing."""
    models = ["b" * 64, "a" * 64]
    text = (
        "lagbench season 1\nseason may\nsplit cavity\nsize mini\nversion 2.1.0\n"
        f"model {'a' * 64}\nmodel {'b' * 64}\nvalue 17\n"
    )
    expected = hashlib.sha256(text.encode()).hexdigest()
    names = ("may", "cavity", "mini", "2.1.0")
    seed = draw_seed(*names, models=models, value="17")
    assert seed == expected
    in_another_order = draw_seed(*names, models=models[::-1], value="17")
    assert in_another_order == expected
    others = {
        draw_seed(*names, models=models),
        draw_seed(*names, models=models[:1], value="17"),
        draw_seed("june", *names[1:], models=models, value="17"),
    }
    assert len(others - {expected}) == 3


def test_options_of_frozen_models_enter_the_seed() -> None:
    """As a list of JSON behind the hash; a model without options has its hash alone."""
    sha256 = "a" * 64
    plain = FrozenModel(seed=0, sha256=sha256, options=())
    assert plain.identity == FrozenModel(seed=0, sha256=sha256).identity == sha256
    averaged = FrozenModel(
        seed=0, sha256=sha256, options=("model.b=[1, 2]", "model.average=true")
    )
    options = '["model.average=true", "model.b=[1, 2]"]'
    assert averaged.identity == f"{sha256} {options}"


def test_the_whole_seed_enters_the_draws() -> None:
    """A change of its last digit leads to other numbers, and the text to the same."""
    names = ("cavity", "mini", 2, 1000)
    seed = 64 * "0"

    def first_numbers(*words: str) -> list[float]:
        numbers: list[float] = generator(*words).random(4).tolist()
        return numbers

    other_seed = f"{seed[:-1]}1"
    numbers = first_numbers(*names, seed)
    assert numbers != first_numbers(*names, other_seed)
    assert numbers != first_numbers(*names)
    words = [int(word) for word in seed_text(*names, seed).split(", ")]
    sequence = np.random.SeedSequence(words)
    again = np.random.Generator(np.random.PCG64(sequence))
    assert again.random(4).tolist() == numbers


def test_blind_scenarios_are_new(master: ModelBoard) -> None:
    """They have ids and positions that no public scenario has, and state the seed."""
    season = read_season(Folder(master.folder), SEASON)
    (data_set,) = season.data_sets
    size = load().size("curl-noise", "tiny")
    assert set(data_set.ids).isdisjoint(size.scenarios)
    starts = set()
    public = size.folder(master.root)
    blind = season_root(SEASON, master.root)
    for folder in (public, blind):
        for path in folder.rglob("*.nc"):
            with read_scenario(path) as file:
                start = file.read("position", 0)
                starts.add(start.tobytes())
    scenario_count = len(size.scenarios) + len(data_set.ids)
    assert len(starts) == scenario_count


@pytest.mark.slow
def test_a_repeated_season_has_the_same_bytes(
    master: ModelBoard, tmp_path: Path
) -> None:
    """Drawn, simulated, predicted and scored anew, in another folder."""
    root = tmp_path / "data"
    shutil.copytree(
        master.root, root, ignore=shutil.ignore_patterns(f"season.{SEASON}")
    )
    folder = tmp_path / "board"
    ignored = shutil.ignore_patterns("scores.yaml")
    shutil.copytree(master.folder, folder, ignore=ignored)
    again = replace(master, folder=folder, root=root)
    simulate(again, read_season(Folder(folder), SEASON))
    result = run_season(folder, SEASON, root=root)
    assert result.predicted == [f"{NAME}, seed 0"]
    scores = "seasons/trial/scores.yaml"
    expected = (master.folder / scores).read_bytes()
    assert (folder / scores).read_bytes() == expected


@pytest.mark.parametrize(
    ("budget", "count"),
    [(1e308, 9), (6.5, 6), (1e-9, 4)],
    ids=["beyond what there is", "six and a half scenarios", "none"],
)
def test_a_model_predicts_as_many_scenarios_as_its_budget_allows(
    budget: float, count: int, own: ModelBoard
) -> None:
    """Its entry states what a frame costs: here, a scenario costs a second; four
    scenarios are the fewest.
    """
    horizon = load().size("curl-noise", "tiny").task.horizon

    def state_cost(content: dict[str, Any]) -> None:
        seconds_per_frame = 1e-7 if budget == 1e308 else 1.0 / horizon
        content["cost"] = {"seconds_per_frame": seconds_per_frame, "device": "cpu"}

    own.edit(own.folder / PATH, state_cost)
    season = close(
        own.folder,
        "next",
        scenarios=9,
        budget=budget,
        root=own.root,
        lagbench="0.1.0",
    )
    (data_set,) = season.data_sets
    (entry,) = data_set.entries
    assert data_set.scenarios == 9
    assert entry.scenarios == count


def test_what_is_scored_is_not_predicted_again(master: ModelBoard) -> None:
    """Only an option predicts them again; the scores are the same."""
    saved = run_again(master)
    assert saved.predicted == []
    assert saved.exit_code == 0
    anew = run_again(master, again=True)
    assert anew.predicted == [f"{NAME}, seed 0"]
    assert anew.comparison is not None
    assert anew.comparison.has_same_bytes


@pytest.mark.parametrize(
    "value",
    ["NaN", '"many"', "-1.0", "null", pytest.param("[" * 100_000, id="nested")],
)
def test_a_damaged_file_of_saved_scores_counts_as_none(
    master: ModelBoard, tmp_path: Path, value: str
) -> None:
    """What it held is predicted again."""
    root = tmp_path / "data"
    shutil.copytree(master.root, root)
    path = season_root(SEASON, root) / "scores.json"
    text = re.sub(r'("1003 \w+": )[\d.e-]+', rf"\g<1>{value}", path.read_text())
    assert text != path.read_text()
    path.write_text(text)
    result = run_again(replace(master, root=root))
    assert result.predicted == [f"{NAME}, seed 0"]
    assert result.exit_code == 0


def change_options(bench: ModelBoard) -> None:
    """Let the entry state an option of its prediction."""

    def change(content: dict[str, Any]) -> None:
        provenance = content["predictions"][0]["provenance"]
        provenance["prediction_overrides"] = ["model.neighbours=4"]

    bench.edit(bench.folder / PATH, change)


def test_the_options_of_a_prediction_are_frozen(own: ModelBoard) -> None:
    """An entry that predicts with other options is not the frozen one; a season of
    before, which froze none, is read as it is.
    """
    path = own.folder / "seasons" / SEASON / "season.yaml"
    (data_set,) = read_season(Folder(own.folder), SEASON).data_sets
    assert data_set.entries[0].models[0].options == ()
    change_options(own)
    with pytest.raises(ChecksFailedError, match="options"):
        run_again(own, again=True)
    assert own.find().findings == ()  # an entry may change after a season

    text = path.read_text()
    assert "options: []" in text
    path.write_text(re.sub(r"\n +options: \[\]", "", text))
    (data_set,) = read_season(Folder(own.folder), SEASON).data_sets
    assert data_set.entries[0].models[0].options is None
    assert run_again(own).exit_code == 0

    later = close_season(own, "later")
    (model,) = later.data_sets[0].entries[0].models
    assert model.options == ("model.neighbours=4",)
    assert read_season(Folder(own.folder), "later") == later
    season_file = path.parents[1] / "later" / "season.yaml"
    season_file.write_text(season_file.read_text().replace("neighbours=4", "average=1"))
    assert [issue.check for issue in own.find().findings] == ["season"]


@pytest.mark.slow
def test_each_of_two_entries_with_one_model_is_predicted(twins: ModelBoard) -> None:
    """Entries may run the same model in different ways, as means over mirror images."""
    result = run_season(twins.folder, "twins", root=twins.root)
    assert sorted(result.predicted) == [
        "curl-noise/tiny/gns, seed 0",
        "curl-noise/tiny/twin, seed 0",
    ]


def test_the_line_of_a_reproduced_entry_becomes_blind(own: ModelBoard) -> None:
    """With both skills, and an interval around their gap."""
    result = run_again(own)
    (row,) = season_rows(result.season, result.scores)
    # two public scenarios are too few for an interval, and nothing is recorded
    assert np.isnan(row.low)
    recorded = record_blind(own.folder, result.season, [row])
    assert recorded == ()
    assert read_verified(Folder(own.folder)) == {}

    rows = [replace(row, low=row.gap - 0.1, high=row.gap + 0.1)]
    recorded = record_blind(own.folder, result.season, rows)
    assert recorded == ()
    reproduce(own.folder, [NAME], root=own.root, costs=False)
    recorded = record_blind(own.folder, result.season, rows)
    assert recorded == (NAME,)
    line = read_verified(Folder(own.folder))[PATH]
    assert line.level is Level.BLIND
    assert line.blind is not None
    assert line.blind.low < line.blind.gap < line.blind.high
    assert own.find().findings == ()
    # a mistake in the entry is no mistake in the line
    own.edit(own.folder / PATH, lambda content: content.update(authors=[]))
    (finding,) = own.find().findings
    assert finding.check == "schema"


def test_the_run_says_which_gaps_are_not_recorded(
    own: ModelBoard, run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two public scenarios give no interval; nothing was scored before this run."""
    monkeypatch.delenv("LAGBENCH_REGISTRY", raising=False)
    result = run(
        *("season", "run", SEASON, "--again", "--threads", 1),
        *("--board", own.folder, "--root", own.root),
    )
    assert result.exit_code == 0, result.output
    assert result.stderr.count(f"results go to {own.folder}") == 1
    assert f"not in verified.yaml: {NAME};" in result.stdout
    assert "scored before" not in result.stdout


def test_a_season_waits_for_its_random_value(own: ModelBoard) -> None:
    """There are no seeds before, and no second value after."""
    season = close_season(own, "later", source="lottery of 1 May")
    assert season.data_sets[0].draw_seed is None
    with pytest.raises(UsageError) as without_value:
        season_registry(season, load(), {}, board=own.folder)
    assert f"--board {own.folder}" in str(without_value.value.fix)
    revealed = reveal(own.folder, "later", "17 4 33")
    assert revealed.data_sets[0].draw_seed == draw_seed(
        "later",
        "curl-noise",
        "tiny",
        load().size("curl-noise", "tiny").version,
        models=season.models,
        value="17 4 33",
    )
    with pytest.raises(UsageError) as second_value:
        reveal(own.folder, "later", "1 2 3")
    assert "17 4 33" in str(second_value.value.got)


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("season.yaml", "draw_seed: ", "draw_seed: 0"),
        ("season.yaml", "season: trial", "season: other"),
        ("season.yaml", "metric: vorticity_nrmse", "metric: nonsense"),
        ("season.yaml", "metric: vorticity_nrmse", "metric: cloud_distance"),
        ("season.yaml", "reference: ", "reference: x"),
        ("scores.yaml", "1003:", "1004:"),
        ("scores.yaml", "1003: 0.0", "1003: -0.0"),
        ("scores.yaml", "seed: 0", "seed: 1"),
    ],
)
def test_an_edited_season_is_found(
    own: ModelBoard,
    file: str,
    old: str,
    new: str,
) -> None:
    """Seeds, names, scenarios and models follow from the frozen models; metric and
    reference from the data set.
    """
    path = own.folder / "seasons" / SEASON / file
    text = path.read_text().replace(old, new)
    if new == "draw_seed: 0":
        start = text.index(new) + len(new)
        before = text[: start + 63]
        after = text[start + 64 :]
        text = before + after
    path.write_text(text)
    checks = [issue.check for issue in own.find().findings]
    assert checks == ["season"]


@pytest.mark.parametrize("place", ["public_reference", "public"])
def test_public_values_are_those_of_the_score_files(
    own: ModelBoard, place: str
) -> None:
    """An edited one would change the gap to the blind values in silence."""
    path = own.folder / "seasons" / SEASON / "scores.yaml"
    assert own.find().findings == ()
    old = re.search(rf" {place}: {{(\d+): ([\d.]+)", path.read_text())
    assert old is not None
    new = old[0][: -len(old[2])] + "0.25"
    path.write_text(path.read_text().replace(old[0], new))
    (issue,) = own.find().findings
    assert issue.check == "season"
    assert f"scenario {old[1]}: 0.25" in str(issue.got)
    assert f"scenario {old[1]}: {old[2]}" in str(issue.expected)
    run_season(own.folder, SEASON, root=own.root)
    assert own.find().findings == ()


def test_a_missing_public_value_is_found(own: ModelBoard) -> None:
    path = own.folder / "seasons" / SEASON / "scores.yaml"
    public = re.compile(r" public: {\d+: [\d.]+, ")
    path.write_text(public.sub(" public: {", path.read_text()))
    (issue,) = own.find().findings
    assert issue.check == "season"


def test_values_beyond_the_range_of_scores_are_found(own: ModelBoard) -> None:
    """Their squares would be infinite in the table of the season."""
    path = own.folder / "seasons" / SEASON / "scores.yaml"
    huge = re.sub(r"1003: [\d.]+", "1003: 1.0e+200", path.read_text())
    path.write_text(huge)
    (issue,) = own.find().findings
    assert issue.check == "season"


@pytest.mark.parametrize("change", ["another scenario", "one scenario less"])
def test_a_run_with_values_of_other_scenarios_differs(
    own: ModelBoard, change: str
) -> None:
    path = own.folder / "seasons" / SEASON / "scores.yaml"
    first_value = r" public: {\d+: ([\d.]+), "
    new_value = r" public: {999: \1, "
    if change == "one scenario less":
        new_value = " public: {"
    path.write_text(re.sub(first_value, new_value, path.read_text()))
    result = run_again(own)
    assert result.predicted == []
    assert result.exit_code == 1
    assert result.comparison is not None
    assert json.dumps(result.comparison.greatest, allow_nan=False)


def test_a_file_of_many_scores_is_read(own: ModelBoard) -> None:
    """A season of many models and scenarios has more than a megabyte of scores."""
    season = read_season(Folder(own.folder), SEASON)
    (data_set,) = season.data_sets
    (entry,) = data_set.entries
    (model,) = entry.models
    models = []
    for seed in range(20):
        models.append(model.model_copy(update={"seed": seed}))
    entries = []
    for number in range(20):
        entries.append(
            entry.model_copy(
                update={
                    "method": f"method-{number}",
                    "scenarios": 200,
                    "models": tuple(models),
                }
            )
        )
    large_set = data_set.model_copy(
        update={"scenarios": 200, "entries": tuple(entries)}
    )
    large = season.model_copy(update={"data_sets": (large_set,)})

    stored = read_scores(Folder(own.folder), season)
    assert stored is not None
    (scored,) = stored.data_sets
    blind = dict.fromkeys(large_set.ids, 0.123456789)
    rows = []
    for one, frozen in frozen_models(large_set):
        count = one.scenarios
        rows.append(
            scored.models[0].model_copy(
                update={
                    "method": one.method,
                    "seed": frozen.seed,
                    "public": dict.fromkeys(range(100), 0.123456789),
                    "blind": dict(list(blind.items())[:count]),
                }
            )
        )
    large_scored = scored.model_copy(
        update={
            "scenarios": dict.fromkeys(large_set.ids, "0" * 64),
            "blind_reference": blind,
            "models": tuple(rows),
        }
    )
    scores = stored.model_copy(update={"data_sets": (large_scored,)})
    data = yaml_bytes(scores.model_dump(mode="python", exclude_none=True))
    assert len(data) > MOST_SEASON_BYTES
    path = own.folder / "seasons" / SEASON / "scores.yaml"
    path.write_bytes(data)
    assert read_scores(Folder(own.folder), large) == scores


def test_a_removed_entry_leaves_its_season_alone(own: ModelBoard) -> None:
    """Its score files are gone, and the frozen values stay."""
    for room in ("submissions", "scores", "weights"):
        shutil.rmtree(own.folder / room / "curl-noise")
    (own.folder / "submissions/curl-noise/tiny").mkdir(parents=True)
    assert own.find().findings == ()


def test_other_models_and_other_scenarios_are_refused(
    own: ModelBoard, twins: ModelBoard, tmp_path: Path
) -> None:
    """A model that was exchanged, also where its scores are saved, and blind scenarios
    of another seed.
    """
    weights = own.weights.read_bytes()
    own.weights.write_bytes(weights + b"1")
    for again in (False, True):
        with pytest.raises(ChecksFailedError, match="not the one that the entry"):
            run_again(own, again=again)
    own.weights.write_bytes(weights)

    root = tmp_path / "data"
    shutil.copytree(own.root, root)
    shutil.rmtree(root / f"season.{SEASON}")
    with pytest.raises(DataError):
        run_again(replace(own, root=root))
    season_of_twins = season_root("twins", twins.root)
    shutil.copytree(season_of_twins, root / f"season.{SEASON}")
    with pytest.raises(DataError):
        run_again(replace(own, root=root))


def test_the_commands_say_what_is_wrong(
    own: ModelBoard, run: Callable[..., Result]
) -> None:
    """A closed season, an unknown one, a value without a source."""
    board = ("--board", own.folder, "--root", own.root)
    for words in (
        ("season", "close", SEASON),
        ("season", "close", "../../x"),
        ("season", "close", "Spring 2027"),
        ("season", "close", "next", "--source", "two\nlines"),
        ("season", "close", "next", "--budget", "nan"),
        ("season", "close", SEASON, "--value", "1"),
        ("season", "run", "nobody"),
        ("generate", "--season", "nobody"),
    ):
        result = run(*words, *board)
        assert result.exit_code == 2, words
        assert "results go to" not in result.stderr
    both = run("season", "show", SEASON, "--json", "--markdown", *board[:2])
    assert both.exit_code == 2
    shown = run("season", "show", SEASON, "--markdown", "--board", own.folder)
    assert shown.exit_code == 0
    assert "gns" in shown.stdout
    table = run("season", "show", SEASON, "--board", own.folder)
    assert table.stdout.count("entry") == 1
    (own.folder / "seasons" / SEASON / "scores.yaml").unlink()
    early = run("season", "show", SEASON, "--board", own.folder)
    assert early.exit_code == 1
    assert f"generate --season {SEASON} --board {own.folder}" in early.stderr


def test_a_season_without_its_random_value_is_shown_as_one_to_reveal(
    own: ModelBoard,
) -> None:
    """No command can draw its scenarios yet, so none of these is the remedy."""
    close_season(own, "later", source="lottery of 1 May")
    words = ["season", "show", "later", "--board", str(own.folder)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 1
    assert f"season close later --board {own.folder} --value" in result.stderr
    assert "generate --season" not in result.stderr


@pytest.mark.parametrize("budget", [-5.0, 0.0])
def test_a_budget_without_time_is_refused(own: ModelBoard, budget: float) -> None:
    with pytest.raises(UsageError) as caught:
        close(
            own.folder,
            "next",
            scenarios=4,
            budget=budget,
            root=own.root,
            lagbench="0.1.0",
        )
    assert caught.value.where == "--budget"


def test_a_season_under_another_name_is_refused_by_its_name(own: ModelBoard) -> None:
    folder = own.folder / "seasons"
    shutil.copytree(folder / SEASON, folder / "copied")
    with pytest.raises(ChecksFailedError) as caught:
        read_season(Folder(own.folder), "copied")
    assert caught.value.expected == "copied"
    assert caught.value.got == SEASON


def test_a_seed_that_differs_in_its_last_digit_is_shown_whole(own: ModelBoard) -> None:
    season = read_season(Folder(own.folder), SEASON)
    seed = season.data_sets[0].draw_seed
    assert seed is not None
    last_digit = "1" if seed[-1] == "0" else "0"
    path = own.folder / "seasons" / SEASON / "season.yaml"
    text = path.read_text()
    path.write_text(text.replace(seed, seed[:-1] + last_digit))
    with pytest.raises(ChecksFailedError) as caught:
        read_season(Folder(own.folder), SEASON)
    assert seed in str(caught.value.expected)
    assert seed[:-1] + last_digit in str(caught.value.got)
