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
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from lagbench.data.field_errors import describe_expectation
from lagbench.data.layout import expand_home
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import LagbenchError, UnreadableFileError, UsageError, suggest_name

from .baseline import LARGEST_OPTION, Settings
from .catalogue import CatalogueEntry, list_names


class Schedule(Settings):
    """Learning rate over the steps, as a factor on the recipe's rate.

    ``constant`` 1; ``cosine`` (1 + cos(pi t)) / 2 falling to ``floor``, t from 0 to 1
    after the warm-up; ``exponential`` factor^(step / every). A warm-up rises linearly
    before.
    """

    # its name; a recipe may give it alone
    kind: Literal["constant", "cosine", "exponential"] = "constant"
    factor: float = Field(default=0.1, gt=0, le=1)  # of the exponential decay
    # steps in which it decays by the factor
    every: int = Field(default=5_000_000, gt=0)
    # share of the rate that the cosine ends at
    floor: float = Field(default=0.01, ge=0, le=1)

    def factor_at(self, step: int, *, steps: int, warmup: int = 0) -> float:
        """Return the factor on the learning rate at a step, counted from 0.

        >>> cosine = Schedule(kind="cosine", floor=0)
        >>> [cosine.factor_at(step, steps=4) for step in (0, 2, 4)]
        [1.0, 0.5, 0.0]
        >>> decay = Schedule(kind="exponential", factor=0.1, every=100)
        >>> decay.factor_at(200, steps=1000)
        0.010000000000000002
        """
        warmup_share = (step + 1) / (warmup + 1)
        rise = min(1.0, warmup_share)
        if self.kind == "exponential":
            decay = self.factor ** (step / self.every)
            return float(rise * decay)
        if self.kind == "constant":
            return rise
        steps_since_warmup = max(0, step - warmup)
        cosine_steps = max(1, steps - warmup)
        progress = min(1.0, steps_since_warmup / cosine_steps)
        cosine = (1 + math.cos(math.pi * progress)) / 2
        return rise * (self.floor + (1 - self.floor) * cosine)


# share of a training's processor time that validations may take
VALIDATION_SHARE = 0.15

STEP_COST = 1.5
"""Processor time to train on a frame over that to roll one out.

Measured on mini: graph networks 1.5 to 2.4 (with bfloat16 in training alone), NeuralMPM
1.6, MLP 0.9 to 1.4, LSTM 4.
"""


def _expand_schedule(value: object) -> object:
    """Return the options of a schedule; a recipe may give its kind alone."""
    if isinstance(value, str):
        return {"kind": value}
    return value


class TrainingOptions(Settings):
    """Options of a training; recipes fill them."""

    steps: int | None = Field(default=None, gt=0)  # optimiser steps; or give 'epochs'
    # passes over all windows
    epochs: float | None = Field(
        default=None, gt=0, le=LARGEST_OPTION, allow_inf_nan=False
    )
    batch: int = Field(default=2, gt=0)  # windows of a step, in every process
    # of Adam, times the number of processes (thesis section 5.7.3)
    learning_rate: float = Field(default=1e-4, gt=0, allow_inf_nan=False)
    # decoupled (AdamW) where it is above 0
    weight_decay: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    # the rate over the steps
    schedule: Annotated[Schedule, BeforeValidator(_expand_schedule)] = Schedule()
    warmup_steps: int = Field(default=0, ge=0)  # steps over which the rate rises from 0
    # share of itself that the running mean of the weights keeps in a step, less at
    # first: n / (n + 9) after n steps. The mean is validated and published; with 0
    # there is no mean, and the weights themselves are
    ema: float = Field(default=0.0, ge=0.0, lt=1.0)
    # largest norm of the gradient; None clips nothing
    clip: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    # 'bf16' runs matrix products in bfloat16, weights stay float32; 'auto' does so
    # where the hardware multiplies in it
    precision: Literal["float32", "bf16", "auto"] = "float32"
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
    log_every: int = Field(default=10, gt=0)  # steps between entries in TensorBoard
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


FITTED_OPTIONS = (
    "windows",
    "validate_every",
    "validation_frames",
    "validation_scenarios",
    "seed",
)
"""Options of the training that a closed form uses: it is fitted, and takes no steps."""

REFUSED_BY_FIT = ("compile", "ema")
"""Options that the fit of a closed form refuses where they are on."""

LATER_OPTIONS: Mapping[str, Mapping[str, object]] = {
    "training": {
        "compile": False,
        "ema": 0.0,
        "opening_share": 0.0,
        "opening_frames": 40,
    },
    "model": {
        "pushforward": 0,
        "recovery": None,
        "strain": False,
        "mixture": False,
        "average": False,
        "conserve": False,
        "shape": [],
        "density": [],
        "neighbours": None,
        "viscosity": False,
        "shift": False,
        "body_force": False,
        "obstacle": False,
        "noise_spread": False,
        "compression": 0.0,
        "free_flight": None,
        "relaxation": 0,
        "densest": 1.1,
    },
}
"""Options that the logs of earlier trainings lack, with the values of that time.

With them such trainings can go on.
"""

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
    # log of the weights that the training starts from, their SHA-256 among it; None for
    # random ones
    start: Mapping[str, Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        values = {
            "baseline": self.baseline,
            "name": self.name,
            "model": _drop_later_defaults("model", self.model),
            "training": _drop_later_defaults(
                "training", self.training.model_dump(mode="json")
            ),
        }
        if self.start:
            values["start"] = dict(self.start)
        return values


def _drop_later_defaults(group: str, options: Mapping[str, Any]) -> Layer:
    """Return options without those that earlier logs lack, where they are as then."""
    later = LATER_OPTIONS[group]
    stated = {}
    for name, value in options.items():
        if name not in later or later[name] != value:
            stated[name] = value
    return stated


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


def recipe_names(entry: CatalogueEntry) -> tuple[str, ...]:
    """Return the names of a baseline's recipes, as in ``cavity/mini``.

    They are in the order of its file.
    """
    if entry.recipes:
        return tuple(_read_file(entry.recipes).recipes)
    return ()


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
        file = _read_file(path)

    size_name = size
    if variant:
        size_name = f"{size}-{variant}"
    name = f"{split}/{size_name}"
    part = file.recipes.get(name) or file.recipes.get(f"{ANY}/{size_name}")
    if part is None:
        if file.recipes or variant:
            is_own_file = file.recipes and path == entry.recipes
            if is_own_file and not _has_recipes_of(split, size, file):
                raise _no_recipe_of_split(entry, f"{split}/{size}", file)
            raise _missing_recipe(entry, name, variant, file)
        part = _SharedRecipe()
    _check_baselines(part, where=f"{path}, {name}, baselines")

    layers: Layer = {"model": file.model, "training": file.training}
    baseline_part = part.baselines.get(entry.name, _Part())
    learned_part = _Part(model=dict(learned or {}))
    for above in (part, baseline_part, learned_part):
        upper_layers = {"model": above.model, "training": above.training}
        layers = _merge(layers, upper_layers)
    where = f"{entry.name}, {name}"
    if path:
        where = f"{path.name}, {name}"
    settings = tuple(settings)
    if settings:
        where += ", and --set"
    for setting in settings:
        change = _parse_setting(setting)
        if entry.model.closed_form:
            _refuse_unused(entry, change, setting)
        layers = _merge(layers, change)
    if seed is not None:
        layers["training"]["seed"] = seed

    model = validate_options(entry.model.Options, layers["model"], "model", where)
    training = validate_options(TrainingOptions, layers["training"], "training", where)
    return Recipe(
        baseline=entry.name,
        name=name,
        model=model.model_dump(mode="json"),
        training=training,
    )


def _has_recipes_of(split: str, size: str, file: _RecipeFile) -> bool:
    """Return whether a file has a recipe of a split, or one of this size for all."""
    return split in _splits_of(file) or f"{ANY}/{size}" in file.recipes


def _splits_of(file: _RecipeFile) -> set[str]:
    """Return the splits that a file has recipes of."""
    splits = set()
    for recipe in file.recipes:
        split, _, _ = recipe.partition("/")
        splits.add(split)
    return splits


def _no_recipe_of_split(
    entry: CatalogueEntry, name: str, file: _RecipeFile
) -> UsageError:
    """Return the error of a split that a baseline knows nothing of, as a user's own."""
    splits = sorted(_splits_of(file))
    changes = "{training: {steps: 2000}}"
    if entry.model.closed_form:
        changes = "{}"
    example = f"{{format: 1, recipes: {{{name}: {changes}}}}}"
    return UsageError(
        f"{entry.name} has no recipe {name!r}",
        where="--recipe",
        expected=f"a YAML file with a recipe of {name}",
        got=f"recipes of {', '.join(splits) or 'no split'}",
        fix=f"write a file, as in {example}, and add --recipe FILE.yaml; "
        f"docs/exchange.md says more",
    )


def _missing_recipe(
    entry: CatalogueEntry, name: str, variant: str | None, file: _RecipeFile
) -> UsageError:
    """Return the error of a recipe that a file does not hold."""
    split, _, size_name = name.partition("/")
    if variant:
        size = size_name.removesuffix(f"-{variant}")
        ways_out = _suggest_variants(size, variant, split, file)
    else:
        ways_out = [_suggest_recipe(name, split, file)]
    ways_out.append("write your own: --recipe FILE.yaml, see docs/baselines.md")
    return UsageError(
        f"{entry.name} has no recipe {name!r}",
        where="--split, --size, --recipe",
        expected="a recipe of the split and size",
        got=ascii(name),
        fix="; or ".join(ways_out),
    )


def _suggest_recipe(name: str, split: str, file: _RecipeFile) -> str:
    """Return the nearest recipe, of the same split if it has any."""
    if not file.recipes:
        return "leave --recipe out"
    same_split = [other for other in file.recipes if other.startswith(f"{split}/")]
    return suggest_name(name, same_split or file.recipes)


def _suggest_variants(
    size: str, variant: str, split: str, file: _RecipeFile
) -> list[str]:
    """Return the nearest variant of the size, or the sizes that have this variant.

    Where the size has a recipe of its own, that is the second way out.
    """
    size_names = []
    for recipe in file.recipes:
        recipe_split, _, size_name = recipe.partition("/")
        if recipe_split in (split, ANY):
            size_names.append(size_name)
    variants = []
    sizes = []
    # A split may have a recipe that all splits have too.
    for size_name in dict.fromkeys(size_names):
        if size_name.startswith(f"{size}-"):
            variants.append(size_name.removeprefix(f"{size}-"))
        if size_name.endswith(f"-{variant}"):
            other_size = size_name.removesuffix(f"-{variant}")
            # Variants may have hyphens: mini-long-short is one of mini, unless there is
            # a size mini-long.
            if "-" not in other_size or other_size in size_names:
                sizes.append(other_size)

    has_size = size in size_names
    ways_out = []
    if has_size and sizes:
        ways_out.append(f"--size {' or '.join(sizes)} has it")
    elif variants:
        ways_out.append(suggest_name(variant, variants))
    elif not has_size:
        ways_out.append(_suggest_recipe(f"{split}/{size}-{variant}", split, file))
    if has_size:
        ways_out.append(f"leave --recipe out, for that of {size}")
    return ways_out


def _check_baselines(part: _SharedRecipe, *, where: str) -> None:
    """Refuse a recipe with a part for an unknown baseline."""
    names = list_names()
    for name in part.baselines:
        if name not in names:
            raise UnreadableFileError(
                f"unknown baseline {name!r}",
                where=where,
                expected="the name of a reference model",
                got=ascii(name),
                fix=suggest_name(name, names),
            )


def change_options(
    entry: CatalogueEntry, options: Mapping[str, Any], settings: Iterable[str]
) -> Layer:
    """Return the options of a trained model with settings.

    A setting is a text as in ``model.average=true``.

    Raises:
        UsageError: an option is unknown, or only a training can change it.
    """
    layers: Layer = {"model": dict(options)}
    for setting in settings:
        layers = _merge(layers, _parse_setting(setting))
        if "training" in layers:
            raise UsageError(
                "an option of the training cannot change now",
                where="--set",
                expected="an option of the model",
                got=setting,
                fix="set options of the model: --set model.KEY=VALUE",
            )
    model_options = entry.model.Options
    before = validate_options(model_options, dict(options), "model", "--set")
    after = validate_options(model_options, layers["model"], "model", "--set")
    before_values = before.model_dump(mode="json")
    after_values = after.model_dump(mode="json")
    _check_unchanged("training", model_options.in_training, before_values, after_values)
    _check_unchanged("weights", model_options.of_weights, before_values, after_values)
    return after_values


def _check_unchanged(
    kind: str, names: Iterable[str], before: Layer, after: Layer
) -> None:
    """Refuse changes of options that only a training can change."""
    changed = []
    for name in sorted(names):
        if before[name] != after[name]:
            changed.append(name)
    if not changed:
        return
    raise UsageError(
        f"an option of the {kind}",
        where="--set",
        expected=", ".join(f"model.{name}={before[name]}" for name in changed),
        got=", ".join(f"model.{name}={after[name]}" for name in changed),
        fix="leave it out, or train with it; docs/baselines.md says which options a "
        "trained model takes",
    )


def _refuse_unused(entry: CatalogueEntry, change: Layer, setting: str) -> None:
    """Refuse a known option of the training that a closed form does not use."""
    known_names = (*FITTED_OPTIONS, *REFUSED_BY_FIT)
    for name in change.get("training", {}):
        if name in known_names or name not in TrainingOptions.model_fields:
            continue
        used = [f"training.{known}" for known in FITTED_OPTIONS]
        raise UsageError(
            f"{entry.name} does not use training.{name}: it is fitted, without steps",
            where="--set",
            expected=f"an option of the model, or {', '.join(used)}",
            got=setting,
            fix="leave it out; docs/baselines.md says which options of the model bound "
            "the fit",
        )


def _read_file(path: Path) -> _RecipeFile:
    return validate_options(
        _RecipeFile,
        read_yaml(path),
        "",
        str(path),
        error_class=UnreadableFileError,
    )


def _merge(below: Layer, above: Layer) -> Layer:
    """Return two layers joined; mappings are joined key by key."""
    joined = dict(below)
    for key, value in above.items():
        lower_value = joined.get(key)
        if key == "schedule":
            lower_value = _expand_schedule(lower_value)
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
    """Return the change by a text such as ``training.schedule.every=100``."""
    key, equals, value_text = text.partition("=")
    group, *path = key.strip().split(".")
    groups = ("model", "training")
    if not equals or not path or group not in groups:
        hint = "name group, key and value, as in --set training.steps=100"
        if path and group in groups:
            hint = f"name its value: --set {text}=VALUE"
        if equals and path:
            hint = suggest_name(group, groups)
        elif equals:
            hint = f"name its group: --set training.{text}, or --set model.{text}"
        raise UsageError(
            "cannot understand the setting",
            where="--set",
            expected="model.KEY=VALUE or training.KEY=VALUE",
            got=text,
            fix=hint,
        )
    try:
        layer: Any = yaml.safe_load(value_text)
    # PyYAML raises other types too, as for numbers of thousands of digits.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UsageError(
            "the value is no YAML",
            where=f"--set {key}",
            expected="a value as in YAML: a number, true, a word, [1, 2]",
            got=" ".join(str(error).split()),
            fix="put the value in quotes: --set 'KEY=VALUE'",
        ) from None
    for name in reversed((group, *path)):
        layer = {name: layer}
    return dict(layer)


def validate_options(
    options: type[OptionsT],
    values: object,
    group: str,
    where: str,
    *,
    error_class: type[LagbenchError] = UsageError,
) -> OptionsT:
    """Return checked options; raise the first error that pydantic reports."""
    try:
        return options.model_validate(values)
    except ValidationError as error:
        detail = error.errors()[0]
    location = detail["loc"]
    path = [str(part) for part in (group, *location) if part != ""]
    key = ".".join(path) or "the file"
    if detail["type"] == "extra_forbidden":
        *parents, unknown_key = location
        known_keys = _known_keys(options, parents)
        prefix = "".join(f"{part}." for part in path[:-1])
        raise error_class(
            f"unknown key {key!r}",
            where=where,
            expected="a key of a recipe",
            got=repr(key),
            fix=suggest_name(str(unknown_key), known_keys, prefix=prefix),
        )

    if detail["type"] == "missing":
        raise error_class(
            f"{key} is missing",
            where=where,
            expected=f"the key {key}",
            got="no such key",
            fix="add it; docs/baselines.md has the keys and their values, and a file "
            "of recipes begins with the line format: 1",
        )

    value = detail["input"]
    got = repr(value)
    is_type_error = detail["type"].endswith("_type")
    if isinstance(value, Mapping) and not is_type_error:
        got = ", ".join(map(str, value))  # the mapping as a whole
    raise error_class(
        f"{key} does not fit",
        where=where,
        expected=describe_expectation(detail),
        got=got[:80],
        fix="give another value; docs/baselines.md has the keys and their values",
    )


def _known_keys(options: type[BaseModel], path: Iterable[int | str]) -> list[str]:
    """Return the keys of the options below a path."""
    holder = options
    for step in path:
        field = holder.model_fields.get(str(step))
        inner = None
        if field:
            inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            holder = inner
        elif step == "recipes" or holder is _RecipeFile:
            holder = _SharedRecipe
    return list(holder.model_fields)
