"""Recipes: layers, settings, schedules, and what is said about mistakes in them."""

from __future__ import annotations

import inspect
import itertools
import json
import math
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from pydantic import ValidationError
from simple_models import Drift, batch, info, install, rolled, swirl

from lagbench.baselines.baseline import Baseline, Settings
from lagbench.baselines.catalogue import CatalogueEntry, find, list_names, load_all
from lagbench.baselines.recipe import (
    Schedule,
    TrainingOptions,
    change_options,
    recipe_for,
    recipe_names,
)
from lagbench.baselines.recipe_changes import first_difference, list_settings
from lagbench.data.registry import load
from lagbench.errors import UnreadableFileError, UsageError

TEXT = """
format: 1
model: {start: 0.5}
training: {epochs: 3, batch: 4, schedule: {kind: exponential, factor: 0.5}}
recipes:
  cavity/tiny: {training: {steps: 7}}
  cavity/tiny-long: {model: {start: 2.0}, training: {steps: 70, schedule: {every: 10}}}
  "*/mini": {training: {learning_rate: 1.0e-2}}
  fluid/full:
    model: {start: 1.0}
    training: {steps: 8}
    baselines: {gns: {training: {steps: 9}}}
"""


@pytest.fixture
def entry(tmp_path: Path) -> CatalogueEntry:
    """A baseline with recipes of its own."""
    path = tmp_path / "drift.yaml"
    path.write_text(TEXT)
    return CatalogueEntry(name="drift", model=Drift, recipes=path)


@pytest.mark.parametrize("name", list_names())
def test_every_recipe_is_right(name: str) -> None:
    """Every recipe of every baseline names a split and size of ours, and its options
    are accepted.
    """
    entry = find(name)
    registry = load()
    names = recipe_names(entry)
    assert any("tiny" in recipe_name for recipe_name in names)
    for recipe_name in names:
        pattern, _, tail = recipe_name.partition("/")
        size, _, variant = tail.partition("-")
        splits = [pattern]
        if pattern == "*":
            splits = []
            for split, description in registry.splits.items():
                if size in description.sizes:
                    splits.append(split)
        for split in splits:
            registry.size(split, size)
            recipe = recipe_for(entry, split, size, variant=variant or None)
            has_length = recipe.training.steps or recipe.training.epochs
            assert has_length or entry.model.closed_form


@pytest.mark.slow
def test_operators_share_their_recipes() -> None:
    """The six operators have one recipe on every split; they differ in the steps alone,
    by their cost.
    """
    operators = ("gns", "supergat", "gat", "gatv2", "pointnet", "transformer")
    splits = ("cavity", "curl-noise", "fluid", "multimaterial")
    for split, size in itertools.product(splits, ("tiny", "mini", "full")):
        first = recipe_for(find("gns"), split, size)
        steps = {"steps": first.training.steps}
        for name in operators:
            recipe = recipe_for(find(name), split, size)
            assert recipe.model == first.model
            assert recipe.training.model_copy(update=steps) == first.training


OTHER = {
    "shift": True,
    **{
        "calls": 3,
        "pushforward": 2,
        "recovery": 4.0,
        "noise_std": 0.5,
        "noise_spread": True,
        "compression": 0.5,
        "forgetful": 0.7,
        "loss_norm": "l1",
    },
    **{
        "loss": {"vorticity": 3.0},
        "link_weight": 2.0,
        "rollout_loss_steps": 3,
        "symmetry": "square",
    },
    **{"dropout": [0.5, 0.5], "density_weight": 5.0, "ridge": 50.0},
}


@pytest.mark.parametrize("name", ["neuralmpm", "supergat", "mlp", "lstm", "var-stable"])
def test_options_of_the_training(name: str) -> None:
    """A trained model refuses options of the training; rollouts are the same to the bit
    whatever they are.

    But the noise of a graph network, which its scales know.
    """
    baseline = find(name)
    torch.manual_seed(0)
    plain = baseline.model.build({}, info())
    for part in plain.parameters():  # an untrained NeuralMPM changes nothing
        torch.nn.init.normal_(part, std=0.05)
    changes = {option: OTHER[option] for option in baseline.model.Options.in_training}
    unseen = {
        key: value
        for key, value in changes.items()
        if (name, key) != ("supergat", "noise_std")
    }
    other = baseline.model.build(unseen, info())
    other.load_state_dict(plain.state_dict())
    given = batch(swirl(0, plain.history))
    given = replace(given, material=torch.zeros_like(given.material))
    assert torch.equal(rolled(plain, given, 6), rolled(other, given, 6))
    stored = plain.options.model_dump(mode="json")
    for option in changes:
        setting = f"model.{option}={json.dumps(OTHER[option])}"
        with pytest.raises(UsageError):
            change_options(baseline, stored, [setting])
    assert change_options(baseline, stored, []) == stored


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [
        *(
            ("mlp", "target", "change"),
            ("mlp", "activation", "tanh"),
            ("lstm", "target", "change"),
        ),
        *(("gns", "target", "velocity"), ("gns", "sum_messages", "false")),
    ],
)
def test_weights_keep_their_meaning(name: str, option: str, value: str) -> None:
    """A trained model refuses options that its weights were made for, though they would
    fit.
    """
    baseline = find(name)
    setting = f"model.{option}={value}"
    stored = baseline.model.Options().model_dump(mode="json")
    with pytest.raises(UsageError):
        change_options(baseline, stored, [setting])
    assert change_options(baseline, {**stored, option: value}, [setting])


def test_settings_win_over_the_recipe_and_it_over_defaults(
    entry: CatalogueEntry, tmp_path: Path
) -> None:
    """The file of recipes may be the user's own. A star stands for every split. Where
    baselines share a recipe, options under the name of one baseline are for that one
    only.
    """
    plain = recipe_for(entry, "cavity", "tiny")
    assert plain.training.steps == 7
    assert plain.training.epochs is None
    assert plain.training.batch == 4
    long = recipe_for(
        entry,
        "cavity",
        "tiny",
        variant="long",
        settings=["training.batch=9"],
        seed=5,
    )
    assert plain.model["start"] == 0.5
    assert long.model["start"] == 2.0
    assert long.training.batch == 9
    assert long.training.seed == 5
    assert long.training.schedule.factor == 0.5
    assert long.training.schedule.every == 10
    starred = recipe_for(entry, "fluid", "mini")
    assert starred.name == "fluid/mini"
    assert starred.training.learning_rate == 0.01
    for name, steps in (("drift", 8), ("gns", 9)):
        recipe = recipe_for(replace(entry, name=name), "fluid", "full")
        assert recipe.model["start"] == 1.0
        assert recipe.training.steps == steps
        assert recipe.training.batch == 4
    own = tmp_path / "own.yaml"
    own.write_text("{format: 1, recipes: {fluid/tiny: {training: {steps: 3}}}}")
    assert recipe_for(entry, "fluid", "tiny", variant=str(own)).training.steps == 3


def test_records_name_a_new_option_only_where_it_is_set() -> None:
    """So the record of a training from before the option equals the record of today."""
    entry = find("neuralmpm")
    before = recipe_for(entry, "fluid", "tiny").as_json()
    assert not {"strain", "mixture", "pushforward", "recovery", "average"} & set(
        before["model"]
    )
    assert not {"ema", "compile"} & set(before["training"])
    changes = ["model.strain=true", "training.ema=0.9", "training.compile=true"]
    after = recipe_for(entry, "fluid", "tiny", settings=changes).as_json()
    before["model"] |= {"strain": True}
    before["training"] |= {"ema": 0.9, "compile": True}
    assert after == before


def test_committed_trainings_lack_no_option() -> None:
    """What the records of committed weights do not say is what is done without it, so
    that they can go on.
    """
    paths = Path(__file__).parents[2].glob("leaderboard/weights/*/*/*.json")
    last_of_baseline = {}
    for path in sorted(paths):
        recipe = json.loads(path.read_text(encoding="utf-8")).get("recipe")
        if recipe:
            last_of_baseline[recipe["baseline"]] = (path, recipe)
    for baseline, (path, recipe) in last_of_baseline.items():
        split, size = path.parts[-3:-1]
        settings = list_settings(recipe)
        rebuilt = recipe_for(find(baseline), split, size, settings=settings).as_json()
        for part in ("model", "training"):
            assert rebuilt[part].keys() <= recipe[part].keys(), path


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        (
            "gns",
            ("model.loss_norm=l1", "model.loss.vorticity=0.5", "training.steps=70"),
        ),
        ("supergat", ("model.sum_messages=false", "training.epochs=2")),
        (
            "neuralmpm",
            (
                "model.pushforward=2",
                "training.ema=0.9",
                "training.windows=[train, extra]",
            ),
        ),
        ("neuralmpm", ("training.schedule.floor=0.1", "training.validate_every=0")),
        ("neuralmpm", ()),
    ],
)
def test_settings_lead_back_to_the_recipe(name: str, settings: tuple[str, ...]) -> None:
    """What a training changed, read off its record, makes its recipe again; seeds and
    looks are no change.
    """
    entry = find(name)
    looks = "training.log_every=3"
    recipe = recipe_for(entry, "cavity", "mini", settings=[*settings, looks], seed=5)
    record = json.loads(json.dumps(recipe.as_json()))
    recorded = list_settings(record)
    assert keys_of(settings) <= keys_of(recorded)
    again = recipe_for(entry, "cavity", "mini", settings=[*recorded, looks], seed=5)
    assert again == recipe
    unchanged = recipe_for(entry, "cavity", "mini", settings=[looks])
    assert list_settings(unchanged.as_json()) == ()


def keys_of(settings: Iterable[str]) -> set[str]:
    """Return the options that settings change."""
    return {setting.partition("=")[0] for setting in settings}


def test_a_recipe_that_is_not_ours_has_no_settings(tmp_path: Path) -> None:
    """Records of other people: no such recipe or baseline, options that do not fit, a
    path for a name.
    """
    own = tmp_path / "own.yaml"
    own.write_text("format: 1\nrecipes: {cavity/mini: {training: {steps: 1}}}\n")
    seven_steps = ("training.steps=7",)
    recipe = recipe_for(find("gns"), "cavity", "mini", settings=seven_steps)
    good = recipe.as_json()
    assert list_settings(good) == seven_steps
    absent = tmp_path / "absent.yaml"
    for change in (
        {"name": f"cavity/mini-{own}"},
        {"name": f"cavity/mini-{absent}"},
        {"name": "cavity/none"},
        {"name": 3},
        {"baseline": "other"},
        {"baseline": ["gns"]},
        {"training": [1]},
    ):
        assert list_settings(good | change) == (), change
    assert list_settings(good | {"model": None}) == seven_steps
    for odd in (
        "x" * 1000,
        "a\n\x1b[31m\ud800",
        "2026-99-99",
        "\u00e4",
        [[0] * 1000],
        {"steps": {"a": "b"}},
    ):
        training = good["training"] | {"steps": odd, "unknown": 1}
        settings = list_settings(good | {"training": training})
        assert len(settings) <= 1
        for setting in settings:
            assert len(setting) < 250
            assert setting.isprintable()
            assert setting.isascii()
    assert list_settings(None) == ()
    assert list_settings([good]) == ()


def test_steps_and_epochs_replace_each_other(entry: CatalogueEntry) -> None:
    """A later layer that counts epochs drops the steps below it; in one layer both are
    refused.
    """
    for settings in (["training.epochs=2"], ["training.steps=5", "training.epochs=2"]):
        changed = recipe_for(entry, "cavity", "tiny", settings=settings).training
        assert changed.steps is None
        assert changed.epochs == 2
    # 2 epochs x 41 windows / (4 windows x 2 processes) = 10.25
    assert changed.total_steps(41, processes=2) == 11
    with pytest.raises(ValueError, match="steps or epochs"):
        TrainingOptions(steps=1, epochs=1)


@pytest.mark.parametrize("epochs", ["1e308", "1e30"])
def test_more_epochs_than_any_machine_could_train_are_refused(
    entry: CatalogueEntry, epochs: str
) -> None:
    """As more steps are: the number of steps would be infinite."""
    setting = f"training.epochs={epochs}"
    with pytest.raises(UsageError) as caught:
        recipe_for(entry, "cavity", "tiny", settings=[setting])
    assert "training.epochs" in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("training.learning_rat=1", "did you mean 'training.learning_rate'"),
        ("training.schedule.evry=1", "did you mean 'training.schedule.every'"),
        ("training.schedule=cosin", "schedule"),
        ("model.strat=1", "did you mean 'model.start'"),
        ("modle.start=1", "model.KEY=VALUE"),
        ("model.start", "model.KEY=VALUE"),
        ("training.batch=[1", "no YAML"),
        ("training.batch=0", "greater than 0"),
        ("training.windows=[test]", "never test"),
        ("training.windows=[train, valid]", "not valid"),
        ("training.windows=[train, shift]", "shift"),
        ("training.windows=[train, train]", "each subset once"),
        ("training.learning_rate=.inf", "finite"),
        ("training.precision=off", "'bf16'"),
        ("training.opening_share=true", "opening_share"),
        ("training.schedule.factor=yes", "schedule.factor"),
        ("training.steps=on", "training.steps"),
        ("training.clip=no", "training.clip"),
        ("model.start=true", "model.start"),
    ],
)
def test_mistakes_in_settings(
    entry: CatalogueEntry,
    setting: str,
    message: str,
) -> None:
    """A wrong setting is a usage error that names key and remedy."""
    with pytest.raises(UsageError, match=message):
        recipe_for(entry, "cavity", "tiny", settings=[setting])


@pytest.mark.parametrize("name", ["var", "hybrid-projection", "hybrid-coarse"])
def test_a_fit_refuses_options_of_steps(name: str) -> None:
    """A fitted model takes no steps; what it uses of a training can be set."""
    entry = find(name)
    split = "fluid"
    if name == "hybrid-projection":
        split = "cavity"
    unused = [
        "training.steps=3",
        "training.epochs=2",
        "training.batch=4",
        "training.learning_rate=1",
        "training.schedule.floor=0.5",
        "training.patience=1",
    ]
    for setting in unused:
        with pytest.raises(UsageError) as caught:
            recipe_for(entry, split, "mini", settings=[setting])
        error = caught.value
        assert error.exit_code == 2
        assert error.where == "--set"
        assert error.got == setting
        assert error.expected
        assert error.fix
    used = ["training.validate_every=0", "training.windows=[train, extra]"]
    recipe = recipe_for(entry, split, "mini", settings=used, seed=3)
    assert recipe.training.validate_every == 0
    assert recipe.training.windows == ("train", "extra")
    with pytest.raises(UsageError, match="did you mean"):
        recipe_for(entry, split, "mini", settings=["training.stps=3"])


def test_a_fit_is_not_told_to_take_steps() -> None:
    """The example of a recipe for a user's own split has no steps then."""
    with pytest.raises(UsageError) as caught:
        recipe_for(find("hybrid-coarse"), "own", "full")
    assert "recipes: {own/full: {}}" in str(caught.value.fix)
    assert "steps" not in str(caught.value.fix)


def test_no_such_recipe(entry: CatalogueEntry) -> None:
    """A split or variant without a recipe is a usage error that names the nearest."""
    bare = replace(entry, recipes=None)
    assert recipe_for(bare, "cavity", "tiny").name == "cavity/tiny"
    for asked, split, size, variant, words in (
        (entry, "cavity", "tiny", "lon", "did you mean 'long'"),
        (entry, "curl-noise", "full", None, "with a recipe of curl-noise/full"),
        (
            entry,
            "curl-noise",
            "mini",
            "long",
            "leave --recipe out",
        ),  # of any split one has no variant
        (entry, "cavity", "huge", "long", "cavity/tiny"),
        (
            find("neuralmpm"),
            "multimaterial",
            "tiny",
            "conserving",
            "--size mini or full has it",
        ),
        (bare, "cavity", "tiny", "long", "leave --recipe out"),
    ):
        with pytest.raises(UsageError, match=words):
            recipe_for(asked, split, size, variant=variant)


def test_sizes_with_a_variant_are_named_once_and_exist(tmp_path: Path) -> None:
    """A variant may have hyphens. A recipe of all splits may repeat one of a split."""
    with pytest.raises(UsageError) as caught:
        recipe_for(find("mlp"), "fluid", "mini", variant="100")
    assert "full-table" not in str(caught.value.fix)
    with pytest.raises(UsageError) as caught:
        recipe_for(find("mlp"), "fluid", "mini", variant="table-4.3-100")
    assert "--size full " in str(caught.value.fix)

    path = tmp_path / "own.yaml"
    path.write_text(
        "format: 1\nrecipes: {cavity/full: {}, cavity/mini-a: {}, '*/mini-a': {}, "
        "cavity/own-size: {}, cavity/own-size-a: {}}\n"
    )
    own = CatalogueEntry(name="drift", model=Drift, recipes=path)
    with pytest.raises(UsageError) as caught:
        recipe_for(own, "cavity", "full", variant="a")
    assert "--size mini or own-size " in str(caught.value.fix)


def test_a_split_without_a_recipe_gets_an_example_that_works(tmp_path: Path) -> None:
    """No recipe of another split is suggested; the example is one that works."""
    with pytest.raises(UsageError) as caught:
        recipe_for(find("gns"), "own", "full", variant="short")
    fix = str(caught.value.fix)
    assert "did you mean" not in fix
    path = tmp_path / "recipe.yaml"
    path.write_text(re.search(r"\{.*\}", fix)[0])  # type: ignore[index]
    recipe = recipe_for(find("gns"), "own", "full", variant=str(path))
    assert recipe.name == "own/full"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{format: 2, recipes: {}}", "format"),
        ("{format: 1, receipts: {}}", "did you mean 'recipes'"),
        (
            "{format: 1, recipes: {a/b: {modell: {}}}}",
            "did you mean 'recipes.a/b.model'",
        ),
        (
            "{format: 1, recipes: {a/b: {baselines: {gns: {trainin: {}}}}}}",
            "did you mean 'recipes.a/b.baselines.gns.training'",
        ),
        (
            "{format: 1, recipes: {cavity/tiny: {baselines: {gnss: {}}}}}",
            "did you mean 'gns'",
        ),
        ("[1, 2]", "the file does not fit"),
        ("{recipes: {cavity/tiny: {}}}", "format is missing"),
        ("{format: 1, a: &x 1, b: *x}", "aliases"),
    ],
)
def test_mistakes_in_files(
    entry: CatalogueEntry,
    tmp_path: Path,
    text: str,
    message: str,
) -> None:
    """A file that is none of recipes is unreadable, and the message says where."""
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(UnreadableFileError, match=message):
        recipe_for(entry, "cavity", "tiny", variant=str(path))


def test_schedules_equal_torch() -> None:
    """Cosine and exponential rates are those of torch's own schedulers."""
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer,
        T_max=50,
        eta_min=0.01,
    )
    ours = Schedule(kind="cosine", floor=0.01)
    decay = Schedule(kind="exponential", factor=0.1, every=20)
    for step in range(50):
        assert math.isclose(
            ours.factor_at(step, steps=50),
            optimizer.param_groups[0]["lr"],
            rel_tol=1e-9,
        )
        assert math.isclose(
            decay.factor_at(step, steps=50),
            0.1 ** (step / 20),
            rel_tol=1e-12,
        )
        optimizer.step()
        cosine.step()
    # it rises in equal parts: with 3 warm-up steps 1/4, 2/4, 3/4, then 1
    assert [Schedule().factor_at(step, steps=10, warmup=3) for step in range(5)] == [
        0.25,
        0.5,
        0.75,
        1.0,
        1.0,
    ]


class Kinds(Settings):
    """Options of many kinds, as packages may have them."""

    number: float = 0.0
    either: bool | int | None = None
    word: Literal["auto", True] = "auto"
    several: tuple[int, ...] = ()
    flags: tuple[bool, ...] = ()
    named: dict[str, float] | None = None
    anything: Any = None


def test_yes_and_no_where_they_are_meant() -> None:
    """Options that may be yes or no, or anything, keep it; pydantic would make numbers
    of it elsewhere.

    Inside of lists and mappings too.
    """
    for values in (
        {
            "number": 1.0,
            "either": True,
            "word": True,
            "flags": [True, False],
            "anything": [True],
        },
        {
            "either": 1,
            "several": [1, 2],
            "named": {"a": 1.0},
            "anything": False,
        },
    ):
        kinds = Kinds.model_validate(values)
        dumped = kinds.model_dump(mode="json", include=set(values))
        expected = json.dumps(values, sort_keys=True)
        assert json.dumps(dumped, sort_keys=True) == expected
    for value in (True, False):
        for name, wrong in (
            ("number", value),
            ("several", [3, value]),
            ("named", {"a": value}),
        ):
            with pytest.raises(ValidationError) as caught:
                Kinds.model_validate({name: wrong})
            assert [error["loc"] for error in caught.value.errors()] == [(name,)]


def test_other_packages_add_baselines(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A class of another package is found by its name, its recipes beside its module;
    ours stay.
    """
    install(monkeypatch, drift=Drift, gns=Drift)
    monkeypatch.setattr(Drift, "recipes", "drift.yaml", raising=False)
    monkeypatch.chdir(tmp_path)  # from whatever folder the command is given
    with pytest.warns(UserWarning, match="its name is taken"):
        drift = find("drift")
    module = Path(inspect.getfile(Drift))
    assert drift.model is Drift
    assert drift.recipes == module.with_name("drift.yaml")
    with pytest.warns(UserWarning, match="its name is taken"):
        assert find("gns").model.method == "GNS"


def test_a_baseline_is_whole_and_has_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """What lacks methods or is no baseline cannot be loaded and only warns beside
    others, as odd names do.
    """
    install(monkeypatch, half=Baseline, broken=Settings, **{"Bad Name/x": Drift})
    with pytest.warns(UserWarning, match="adds no baseline") as warnings:
        baselines = load_all()
    words = " ".join(str(warning.message) for warning in warnings)
    for name in ("half", "broken", "Bad Name/x"):
        assert f"'{name}'" in words
        assert name not in baselines
    assert "mlp" in baselines
    for name, reason in (
        ("half", "history, forward, start, advance"),
        ("broken", "cannot be loaded"),
    ):
        with (
            pytest.warns(UserWarning, match="Bad Name/x"),
            pytest.raises(UsageError, match=reason),
        ):
            find(name)


class Misspelt(Drift):
    """A baseline whose options of the training have no such name."""

    class Options(Drift.Options):
        """An option, and another name for it."""

        in_training = frozenset({"strat"})


def test_options_of_the_training_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the check, predictions would fail after a whole training."""
    install(monkeypatch, misspelt=Misspelt)
    with pytest.raises(UsageError) as caught:
        find("misspelt")
    assert "strat" in str(caught.value.got)


def test_the_page_of_the_baselines_is_complete() -> None:
    """docs/baselines.md names every baseline and every option of a training."""
    page = (Path(__file__).parents[2] / "docs/baselines.md").read_text()
    for word in (*list_names(), *TrainingOptions.model_fields):
        assert f"`{word}`" in page, word


def test_a_difference_of_recipes_names_values_that_logs_leave_out() -> None:
    """Logs leave out later options with the values of that time; other options may be
    missing on one side.
    """

    def recipe(*settings: str) -> dict[str, Any]:
        settings = ("training.steps=100", *settings)
        return recipe_for(find("gns"), "cavity", "mini", settings=settings).as_json()

    plain = recipe()
    averaged = recipe("training.ema=0.99")
    assert "training.ema = 0.0, " in first_difference(plain, averaged)
    assert "training.ema = 0.99, " in first_difference(averaged, plain)
    assert first_difference(averaged, plain).endswith(" 0.0")
    older = {**plain, "training": dict(plain["training"])}
    del older["training"]["batch"]
    assert first_difference(plain, older).endswith("not set")
    assert first_difference(plain, plain) == first_difference(older, older)
