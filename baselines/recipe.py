"""Recipes: the options of a model and of its training for one split and size.

The options of a training are its budget, its optimiser, and its validations. A YAML
file of recipes holds defaults and the differences of each recipe::

    format: 1
    model: {latent: 128}
    training: {learning_rate: 1.0e-4}
    recipes:
      cavity/full: {training: {steps: 20000}}
      cavity/full-short: {training: {steps: 2000}}    # --recipe short
      "*/tiny": {model: {latent: 16}, training: {steps: 50}}
      fluid/mini: {training: {steps: 900}, baselines: {gat: {training: {steps: 500}}}}

Later layers win: defaults, the recipe, its part for the baseline, the options of the
model that a training starts from, ``--set``, the seed. ``*/tiny`` serves splits that
have no recipe of their own at this size. ``steps`` and ``epochs`` replace each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import yaml
from pydantic import (
    BaseModel,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from lagbench.data.layout import expand_home
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UnreadableFileError, UsageError, suggest_name

from .baseline import Settings
from .catalogue import CatalogueEntry

DECAY_STEPS = 5_000_000
"""Steps in which the exponential rate falls to a tenth, as in the thesis."""

COSINE_FLOOR = 0.01
"""Share of the rate that the cosine ends at."""


# share of a training's processor time that validations may take
VALIDATION_SHARE = 0.15

STEP_COST = 1.5
"""Processor time to train on a frame over that to roll one out.

Measured on mini: graph networks 1.5 to 2.4 (with bfloat16 in training alone), NeuralMPM
1.6, MLP 0.9 to 1.4, LSTM 4.
"""


class TrainingOptions(Settings):
    """Options of a training; recipes fill them."""

    steps: int | None = Field(default=None, gt=0)  # optimiser steps; or give 'epochs'
    # passes over all windows
    epochs: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    batch: int = Field(default=2, gt=0)  # windows of a step, in every process
    # of Adam, times the number of processes (thesis section 5.7.3)
    learning_rate: float = Field(default=1e-4, gt=0, allow_inf_nan=False)
    # decoupled (AdamW) where it is above 0
    weight_decay: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    # the rate over the steps, see `rate_factor`
    schedule: Literal["constant", "cosine", "exponential"] = "constant"
    warmup_steps: int = Field(default=0, ge=0)  # steps over which the rate rises from 0
    # share of itself that the running mean of the weights keeps in a step, less at
    # first: n / (n + 9) after n steps. The mean is validated and published; with 0
    # there is no mean, and the weights themselves are
    ema: float = Field(default=0.0, ge=0.0, lt=1.0)
    # largest norm of the gradient; None clips nothing
    clip: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    # fuse the operations of a graph network's processor layers by torch.compile; needs
    # a C++ compiler on CPUs
    compile: bool = False
    windows: tuple[str, ...] = ("train",)  # subsets to train on
    # share of the windows that are drawn from those that begin in the first
    # `opening_frames` frames: bodies meet once, and rest for hundreds of frames
    opening_share: float = Field(default=0.0, ge=0.0, le=1.0, allow_inf_nan=False)
    opening_frames: int = Field(default=40, gt=0)
    # steps between validations, 0 never; by default up to eight, as many as take 15 %
    # of the processor time
    validate_every: int | None = Field(default=None, ge=0)
    # for tests: frames and scenarios of 'valid' that are rolled out; all by default
    validation_frames: int | None = Field(default=None, gt=0)
    validation_scenarios: int | None = Field(default=None, gt=0)
    # validations without a new best before training stops; None never
    patience: int | None = Field(default=None, gt=0)
    # steps between checkpoints; a twentieth of all by default
    checkpoint_every: int | None = Field(default=None, gt=0)
    log_every: int = Field(default=10, gt=0)  # steps between rows of losses.csv
    # seed of weights, order of windows, and noise
    seed: int = Field(default=0, ge=0, lt=2**63)

    @model_validator(mode="before")
    @classmethod
    def _check_length(cls, data: object) -> object:
        if isinstance(data, Mapping) and data.get("steps") and data.get("epochs"):
            raise ValueError("give steps or epochs, not both")
        return data

    @field_validator("windows")
    @classmethod
    def _check_subsets(cls, windows: tuple[str, ...]) -> tuple[str, ...]:
        if {"test", "shift", "valid"} & set(windows) or not windows:
            raise ValueError(
                "[train] or [train, extra]: never test or shift, which are scored, and "
                "not valid, by which the weights are chosen"
            )
        if len(set(windows)) < len(windows):
            raise ValueError("each subset once, as in [train, extra]")
        return windows

    def total_steps(self, windows: int, *, processes: int = 1) -> int:
        """Return the optimiser steps of the training; one epoch if it states neither.

        Args:
            windows: windows of the data that it trains on.
            processes: processes that share each step.
        """
        if self.steps is not None:
            return self.steps
        windows_per_step = self.batch * processes
        epochs = self.epochs or 1.0
        return max(1, math.ceil(epochs * windows / windows_per_step))

    def rate_factor(self, step: int, *, steps: int) -> float:
        """Return the factor on the learning rate at a step, counted from 0.

        ``constant`` 1; ``cosine`` (1 + cos(pi t)) / 2 falling to 0.01, t from 0 to 1
        after the warm-up; ``exponential`` 0.1^(step / 5,000,000). A warm-up rises
        linearly before.

        Args:
            step: steps that were made.
            steps: steps of the whole training.
        """
        warmup_share = (step + 1) / (self.warmup_steps + 1)
        rise = min(1.0, warmup_share)
        if self.schedule == "exponential":
            decay = 0.1 ** (step / DECAY_STEPS)
            return float(rise * decay)
        if self.schedule == "constant":
            return rise
        steps_since_warmup = max(0, step - self.warmup_steps)
        cosine_steps = max(1, steps - self.warmup_steps)
        progress = min(1.0, steps_since_warmup / cosine_steps)
        cosine = (1 + math.cos(math.pi * progress)) / 2
        return rise * (COSINE_FLOOR + (1 - COSINE_FLOOR) * cosine)

    def count_validations(self, steps: int, *, trained: int, rolled: int) -> int:
        """Return how many validations take at most 15 % of a training.

        These are 8, 4 or 2, and 1 in any case. The count is a function of numbers
        alone, so that a training ends with the same bits on every machine.

        Args:
            steps: steps of the training.
            trained: frames that a step predicts, of all windows of a process.
            rolled: frames that a validation predicts.
        """
        affordable = VALIDATION_SHARE * STEP_COST * trained * steps / rolled
        for count in (8, 4, 2):
            if count <= affordable:
                return count
        return 1

    def is_validated(self, step: int, *, steps: int, validations: int) -> bool:
        """Return whether a validation follows a step.

        One follows the last step, unless the options ask for none.
        """
        if self.validate_every is None:
            done = step * validations // steps
            done_before = (step - 1) * validations // steps
            return done > done_before
        if self.validate_every == 0:
            return False
        return step >= steps or step % self.validate_every == 0


Layer = dict[str, Any]
ANY = "*"
OptionsT = TypeVar("OptionsT", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A model and its training; checked, with every default filled in."""

    baseline: str  # name of the baseline
    name: str  # name of the recipe, as in cavity/mini
    model: Mapping[str, Any]  # options of the model, plain values
    training: TrainingOptions  # options of the training
    settings: tuple[str, ...] = ()  # changes of the named recipe, as in --set
    # log of the weights that the training starts from, their SHA-256 among it; None for
    # random ones
    start: Mapping[str, Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        values: dict[str, Any] = {
            "baseline": self.baseline,
            "name": self.name,
            "model": dict(self.model),
            "training": self.training.model_dump(mode="json"),
            "settings": list(self.settings),
        }
        if self.start:
            values["start"] = dict(self.start)
        return values


class _Part(Settings):
    """One recipe: its differences from the defaults of its file."""

    model: Layer = Field(default_factory=dict)
    training: Layer = Field(default_factory=dict)


class _SharedRecipe(_Part):
    """A recipe of several baselines, with the differences of some of them by name."""

    baselines: dict[str, _Part] = Field(default_factory=dict)


class _RecipeFile(_Part):
    """A whole file of recipes."""

    format: Literal[1]
    family: str = ""
    recipes: dict[str, _SharedRecipe] = Field(default_factory=dict)


def recipe_for(
    entry: CatalogueEntry,
    split: str,
    size: str,
    *,
    variant: str | None = None,
    settings: Iterable[str] = (),
    seed: int | None = None,
    learned: Mapping[str, Any] | None = None,
) -> Recipe:
    """Return the recipe of a baseline for a split and size.

    Args:
        entry: the baseline.
        split: name of the split.
        size: name of the size.
        variant: variant of the recipe, such as ``short`` of ``cavity/full-short``; or
            the path of a YAML file that replaces the baseline's own recipes.
        settings: changes, as in ``training.steps=100``.
        seed: seed of the training; it wins over ``settings``.
        learned: options of the model that the training starts from. They win over the
            recipe, and ``settings`` over them.

    Raises:
        UsageError: there is no such recipe, or an option does not fit.
        UnreadableFileError: the file of recipes does not fit.
    """
    path = entry.recipes
    if variant is not None and variant.endswith((".yaml", ".yml")):
        path = expand_home(variant, "--recipe")
        variant = None
    file = _RecipeFile(format=1)
    if path:
        try:
            file = _RecipeFile.model_validate(read_yaml(path))
        except ValidationError as error:
            raise UnreadableFileError(
                _describe(error, _RecipeFile), where=str(path)
            ) from None

    size_name = size
    if variant:
        size_name = f"{size}-{variant}"
    name = f"{split}/{size_name}"
    part = file.recipes.get(name) or file.recipes.get(f"{ANY}/{size_name}")
    if part is None and (file.recipes or variant):
        of_split = [known for known in file.recipes if known.startswith(f"{split}/")]
        raise UsageError(
            f"{entry.name} has no recipe {name!r} (of {split}: "
            f"{', '.join(of_split) or 'none'}); write your own, --recipe FILE.yaml: "
            "docs/baselines.md"
        )
    if part is None:
        part = _SharedRecipe()

    layers: Layer = {"model": file.model, "training": file.training}
    baseline_part = part.baselines.get(entry.name, _Part())
    for above in (part, baseline_part):
        layers = _merge(layers, {"model": above.model, "training": above.training})
    layers = _merge(layers, {"model": dict(learned or {})})
    settings = tuple(settings)
    for setting in settings:
        layers = _merge(layers, _parse_setting(setting))
    if seed is not None:
        layers["training"]["seed"] = seed

    where = f"{path or entry.name}, {name}"
    model = check_options(
        entry.model.Options, layers["model"], where, group="model", settings=settings
    )
    training = check_options(
        TrainingOptions, layers["training"], where, group="training", settings=settings
    )
    return Recipe(
        baseline=entry.name,
        name=name,
        model=model.model_dump(mode="json"),
        training=training,
        settings=settings,
    )


def change_options(
    entry: CatalogueEntry, options: Mapping[str, Any], settings: Iterable[str]
) -> Layer:
    """Return the options of a trained model with settings.

    A setting is a text as in ``model.average=true``.

    Raises:
        UsageError: an option is unknown, or only a training can change it.
    """
    layers: Layer = {"model": dict(options), "training": {}}
    for setting in settings:
        layers = _merge(layers, _parse_setting(setting))
    model_options = entry.model.Options
    old = check_options(model_options, dict(options), "--set", group="model")
    new = check_options(model_options, layers["model"], "--set", group="model")
    before = old.model_dump(mode="json")
    after = new.model_dump(mode="json")
    fixed = model_options.in_training | model_options.of_weights
    changed = [f"model.{name}" for name in sorted(fixed) if before[name] != after[name]]
    changed += [f"training.{name}" for name in layers["training"]]
    if changed:
        raise UsageError(
            f"{', '.join(changed)} cannot change after the training", where="--set"
        )
    return after


def _merge(below: Layer, above: Layer) -> Layer:
    """Return two layers joined; mappings are joined key by key."""
    joined = dict(below)
    for key, value in above.items():
        lower_value = joined.get(key)
        if isinstance(value, Mapping) and isinstance(lower_value, Mapping):
            joined[key] = _merge(dict(lower_value), dict(value))
        else:
            joined[key] = value
    if above.get("steps") is not None and above.get("epochs") is None:
        joined.pop("epochs", None)
    if above.get("epochs") is not None and above.get("steps") is None:
        joined.pop("steps", None)
    return joined


def _parse_setting(text: str) -> Layer:
    """Return the change by a text such as ``model.loss.vorticity=1``.

    >>> _parse_setting("model.loss.vorticity=1")
    {'model': {'loss': {'vorticity': 1}}}
    """
    key, equals, value_text = text.partition("=")
    group, *path = key.strip().split(".")
    if not equals or not path or group not in ("model", "training"):
        raise UsageError(
            f"{text!r} is no setting; write model.KEY=VALUE or training.KEY=VALUE",
            where="--set",
        )
    try:
        layer: Any = yaml.safe_load(value_text)
    except yaml.YAMLError:
        raise UsageError(f"the value of {text!r} is no YAML", where="--set") from None
    for name in reversed((group, *path)):
        layer = {name: layer}
    return dict(layer)


def check_options(
    options: type[OptionsT],
    values: Layer,
    where: str,
    *,
    group: str,
    settings: Iterable[str] = (),
) -> OptionsT:
    """Return checked options.

    Args:
        options: class of the options.
        values: their values by name.
        where: the recipe that they come from, for messages.
        group: ``model`` or ``training``.
        settings: changes of the recipe; a mistake in one of them is one of ``--set``.

    Raises:
        UsageError: an option is unknown, or its value does not fit.
    """
    try:
        return options.model_validate(values)
    except ValidationError as error:
        key = ".".join(map(str, (group, *error.errors()[0]["loc"])))
        if any(setting.strip().startswith(key) for setting in settings):
            where = "--set"
        raise UsageError(_describe(error, options, f"{group}."), where=where) from None


def _describe(
    error: ValidationError, options: type[BaseModel], prefix: str = ""
) -> str:
    """Return the first thing that pydantic finds wrong."""
    detail = error.errors()[0]
    name = ".".join(map(str, detail["loc"]))
    key = (prefix + name).rstrip(".")
    if detail["type"] != "extra_forbidden":
        return f"{key} = {detail['input']!r}: {detail['msg']}"
    if len(detail["loc"]) > 1:
        return f"no such key {key!r}; docs/baselines.md describes recipes"
    hint = suggest_name(name, options.model_fields, prefix=prefix)
    return f"no such key {key!r}; {hint}"
