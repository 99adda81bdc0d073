"""Recipes of the models of whole frames: one for every data set they are meant for, and none too large."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from frame_cases import facts_of, rotations

from lagbench.baselines.baseline import Baseline
from lagbench.baselines.catalogue import find
from lagbench.baselines.recipe import Recipe, recipe_for, recipe_names
from lagbench.data.registry import load
from lagbench.errors import UsageError

NETWORKS = ("mlp", "lstm", "lstm-mlp")
VARS = ("var", "var-stable")
SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
SIZES = ("tiny", "mini", "full")
TOO_LARGE = {("cavity", "full"), ("curl-noise", "full")}
FACTS = facts_of(rotations(2))


def built(recipe: Recipe, split: str, size: str) -> Baseline:
    """Build a recipe's model without memory for its weights."""
    facts = replace(FACTS, particles=load().size(split, size).particles)
    with torch.device("meta"):
        return find(recipe.baseline).model.build(recipe.model, facts)


def numbers(model: Baseline) -> int:
    """Return how many numbers a checkpoint holds."""
    return sum(value.numel() for value in model.state_dict().values())


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", NETWORKS)
def test_networks_have_recipes_everywhere(name: str, split: str, size: str) -> None:
    """Models build; material is an input where there are several; mini has at most 4 M parameters."""
    recipe = recipe_for(find(name), split, size)
    model = built(recipe, split, size)
    assert recipe.model["material"] is (split == "multimaterial")
    assert recipe.model["target"] == "state"  # the thesis's form
    assert numbers(model) <= {"tiny": 1e6, "mini": 4e6, "full": 2e8}[size]


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", NETWORKS)
def test_variants_with_changes_differ_in_that_only(name: str, split: str) -> None:
    """``mini-change`` has the layers and training of ``mini``; its target, and its noise, are others."""
    plain, change = (recipe_for(find(name), split, "mini", variant=variant) for variant in (None, "change"))
    assert change.training == plain.training
    differing = {key for key in plain.model if plain.model[key] != change.model[key]}
    assert {"target"} <= differing <= {"target", "noise_std"}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", VARS)
def test_vars_have_recipes_where_they_fit(name: str, split: str, size: str) -> None:
    """Everywhere but in the full closed boxes; a stable one's mini checkpoint stays within 8 MB."""
    if (split, size) in TOO_LARGE:
        with pytest.raises(UsageError, match="no recipe"):
            recipe_for(find(name), split, size)
        return
    model = built(recipe_for(find(name), split, size), split, size)
    if name == "var-stable":
        assert 4 * numbers(model) <= 8.5e6


@pytest.mark.parametrize("name", [*NETWORKS, *VARS])
def test_every_recipe_is_valid(name: str) -> None:
    """Every entry of the files, studies included, passes the check of its keys and values."""
    for entry in recipe_names(find(name)):
        split, _, tier = entry.replace("*", "fluid").partition("/")
        size, _, variant = tier.partition("-")
        assert recipe_for(find(name), split, size, variant=variant or None).name == f"{split}/{tier}"
