"""Recipes: layers, settings, schedules, and what is said about mistakes in them."""

from __future__ import annotations

import inspect
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from simple_models import Drift, batch, info, install, rolled, swirl

from lagbench.baselines.baseline import Settings
from lagbench.baselines.catalogue import CatalogueEntry, find, list_names
from lagbench.baselines.recipe import (
    TrainingOptions,
    change_options,
    recipe_for,
)
from lagbench.data.registry import load
from lagbench.errors import UsageError

TEXT = """
format: 1
model: {start: 0.5}
training: {epochs: 3, batch: 4, schedule: cosine}
recipes:
  cavity/tiny: {training: {steps: 7}}
  cavity/tiny-long: {model: {start: 2.0}, training: {steps: 70}}
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


@pytest.mark.parametrize(
    "name", ["gns", "egnn", "neuralmpm", "mlp", "lstm", "lstm-mlp", "var", "var-stable"]
)
def test_every_recipe_is_right(name: str) -> None:
    """Every recipe of every file names a split and size of ours, and its options are
    accepted.
    """
    entry = find(name)
    registry = load()
    assert entry.recipes is not None
    names = list(yaml.safe_load(entry.recipes.read_text())["recipes"])
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


OTHER = {
    "shift": True,
    **{
        "calls": 3,
        "pushforward": 2,
        "recovery": 4.0,
        "noise_std": 0.5,
        "noise_spread": True,
    },
    **{
        "loss": {"vorticity": 3.0},
        "symmetry": "square",
    },
    **{"dropout": [0.5, 0.5], "density_weight": 5.0, "ridge": 50.0},
}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("neuralmpm", {"width": 8}),
        ("supergat", {"latent": 8, "layers": 2}),
        ("mlp", {"widths": [16]}),
        ("lstm", {"latent": 8, "decoder": [8]}),
        ("var-stable", {}),
    ],
)
def test_options_of_the_training(name: str, options: dict[str, Any]) -> None:
    """A trained model refuses options of the training; rollouts are the same to the bit
    whatever they are.

    But the noise of a graph network, which its scales know.
    """
    baseline = find(name)
    torch.manual_seed(0)
    plain = baseline.model.build(options, info())
    for part in plain.parameters():  # an untrained NeuralMPM changes nothing
        torch.nn.init.normal_(part, std=0.05)
    changes = {option: OTHER[option] for option in baseline.model.Options.in_training}
    unseen = {
        key: value
        for key, value in changes.items()
        if (name, key) != ("supergat", "noise_std")
    }
    other = baseline.model.build(options | unseen, info())
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
    assert long.training.schedule == "cosine"
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


@pytest.mark.parametrize(
    "setting",
    [
        "training.learning_rat=1",
        "training.schedule=cosin",
        "model.strat=1",
        "modle.start=1",
        "model.start",
        "training.batch=[1",
        "training.batch=0",
        "training.windows=[test]",
        "training.windows=[train, valid]",
        "training.windows=[train, train]",
        "training.learning_rate=.inf",
    ],
)
def test_mistakes_in_settings(entry: CatalogueEntry, setting: str) -> None:
    with pytest.raises(UsageError):
        recipe_for(entry, "cavity", "tiny", settings=[setting])


def test_an_unknown_key_is_found_where_it_stands(
    entry: CatalogueEntry, tmp_path: Path
) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("{format: 1, training: {learning_rat: 1}}")
    for variant, settings, place in (
        (str(own), [], str(own)),
        (None, ["training.learning_rat=1"], "--set"),
    ):
        with pytest.raises(UsageError) as caught:
            recipe_for(entry, "cavity", "tiny", variant=variant, settings=settings)
        assert str(caught.value).startswith(place)
        assert "'training.learning_rate'" in str(caught.value)


def test_no_such_recipe(entry: CatalogueEntry) -> None:
    """A baseline without a file of recipes has the defaults."""
    bare = replace(entry, recipes=None)
    assert recipe_for(bare, "cavity", "tiny").name == "cavity/tiny"
    for asked, size, variant in (
        (entry, "tiny", "lon"),
        (entry, "full", None),
        (bare, "tiny", "long"),
    ):
        with pytest.raises(UsageError):
            recipe_for(asked, "cavity", size, variant=variant)


def test_schedules_equal_torch() -> None:
    """Cosine and exponential rates are those of torch's own schedulers."""
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer,
        T_max=50,
        eta_min=0.01,
    )
    ours = TrainingOptions(schedule="cosine")
    for step in range(50):
        rate = optimizer.param_groups[0]["lr"]
        assert math.isclose(ours.rate_factor(step, steps=50), rate, rel_tol=1e-9)
        optimizer.step()
        cosine.step()
    decay = TrainingOptions(schedule="exponential")
    assert decay.rate_factor(5_000_000, steps=10**7) == pytest.approx(0.1)
    # it rises in equal parts: with 3 warm-up steps 1/4, 2/4, 3/4, then 1
    rising = TrainingOptions(warmup_steps=3)
    factors = [rising.rate_factor(step, steps=10) for step in range(5)]
    assert factors == [0.25, 0.5, 0.75, 1.0, 1.0]


def test_other_packages_add_baselines(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A class of another package is found by its name, its recipes beside its module;
    ours stay.
    """
    install(monkeypatch, drift=Drift, gns=Drift)
    monkeypatch.setattr(Drift, "recipes", "drift.yaml", raising=False)
    monkeypatch.chdir(tmp_path)  # from whatever folder the command is given
    drift = find("drift")
    module = Path(inspect.getfile(Drift))
    assert drift.model is Drift
    assert drift.recipes == module.with_name("drift.yaml")
    assert find("gns").model.method == "GNS"


def test_a_baseline_that_cannot_be_loaded_is_warned_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All others are there."""
    install(monkeypatch, broken=Settings)
    with pytest.raises(UsageError):
        find("broken")


def test_the_page_of_the_baselines_is_complete() -> None:
    """docs/baselines.md names every baseline and every option of a training."""
    page = (Path(__file__).parents[2] / "docs/baselines.md").read_text()
    for word in (*list_names(), *TrainingOptions.model_fields):
        assert f"`{word}`" in page, word
