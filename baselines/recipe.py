"""Recipes: the options of a model and of its training for one split and size, from
YAML.

A training's options are its budget, its optimiser, and how often it is looked at.

A file of recipes holds defaults and what differs from them::

    format: 1
    model: {latent: 128}
    training: {learning_rate: 1.0e-4}
    recipes:
      cavity/full: {training: {steps: 20000}}
      cavity/full-short: {training: {steps: 2000}}    # --recipe short
      "*/tiny": {model: {latent: 16}, training: {steps: 50}}
      fluid/mini: {training: {steps: 900}, baselines: {gat: {training: {steps: 500}}}}

Later layers win: defaults, recipe, what it says of the baseline by name, ``--set``.
``steps`` and ``epochs`` replace each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator

from lagbench.data.yamlfile import read_yaml
from lagbench.errors import LagbenchError, UnreadableFileError, UsageError, suggest_name

from .baseline import Settings
from .catalogue import Entry, names


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

    def at(self, step: int, *, steps: int, warmup: int = 0) -> float:
        """Return the factor on the learning rate at a step, counted from 0.

        >>> [Schedule(kind="cosine", floor=0).at(step, steps=4) for step in (0, 2, 4)]
        [1.0, 0.5, 0.0]
        >>> Schedule(kind="exponential", factor=0.1, every=100).at(200, steps=1000)
        0.010000000000000002
        """
        rise = min(1.0, (step + 1) / (warmup + 1))
        if self.kind == "exponential":
            return float(rise * self.factor ** (step / self.every))
        if self.kind == "constant":
            return rise
        done = min(1.0, max(0, step - warmup) / max(1, steps - warmup))
        return rise * (
            self.floor + (1 - self.floor) * (1 + math.cos(math.pi * done)) / 2
        )


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
    schedule: Annotated[
        Schedule,
        BeforeValidator(
            lambda value: {"kind": value} if isinstance(value, str) else value
        ),
    ] = Schedule()  # the rate over the steps
    warmup_steps: int = Field(default=0, ge=0)  # steps over which the rate rises from 0
    # share of itself that the running mean of the weights keeps in a step, less at
    # first: n / (n + 9) after n steps. The mean is validated and published; with 0 the
    # weights themselves are
    ema: float = Field(default=0.0, ge=0.0, lt=1.0)
    # largest norm of the gradient; None clips nothing
    clip: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    # 'bf16' runs matrix products in bfloat16, weights stay float32; 'auto' does so
    # where the hardware multiplies in it
    precision: Literal["float32", "bf16", "auto"] = "float32"
    # fuse what a processor layer of a graph network does, by torch.compile; needs a C++
    # compiler on CPUs
    compile: bool = False
    windows: tuple[str, ...] = ("train",)  # subsets to train on
    # share of the windows that are drawn from those that begin in a scenario's first
    # frames, so many of them: bodies meet once, and rest for hundreds of frames
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
    def _one_budget(cls, data: object) -> object:
        if isinstance(data, Mapping) and data.get("steps") and data.get("epochs"):
            raise ValueError("give steps or epochs, not both")
        return data

    @model_validator(mode="after")
    def _own_subsets(self) -> TrainingOptions:
        if {"test", "valid"} & set(self.windows) or not self.windows:
            raise ValueError(
                f"windows={self.windows}: a model is trained on train (and extra), "
                f"never on test, and not on"
                " valid, by which its weights are chosen"
            )
        return self

    def total_steps(self, windows: int, *, processes: int = 1) -> int:
        """Return the optimiser steps of the training."""
        if self.steps is not None:
            return self.steps
        return max(
            1, math.ceil((self.epochs or 1.0) * windows / (self.batch * processes))
        )

    def validations(self, steps: int, *, trained: int, rolled: int) -> int:
        """Return how many validations take at most 15 % of a training: 8, 4 or 2, and 1
        in any case.

        A function of numbers alone, so that a training ends with the same bits on every
        machine: its steps, the frames that a step predicts, of all windows of a
        process, and those that a validation predicts.
        """
        affordable = VALIDATION_SHARE * STEP_COST * trained * steps / rolled
        return next((count for count in (8, 4, 2) if count <= affordable), 1)

    def is_validated(self, step: int, *, steps: int, validations: int) -> bool:
        """Return whether a step is followed by a validation; the last one is unless
        none is wanted.
        """
        if self.validate_every is None:
            return step * validations // steps > (step - 1) * validations // steps
        return self.validate_every > 0 and (
            step >= steps or step % self.validate_every == 0
        )


LATER: Mapping[str, Mapping[str, object]] = {
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
    },
}
"""Options that records of earlier trainings lack, with what they did: such trainings
can go on.
"""

Layer = dict[str, Any]
ANY = "*"
Checked = TypeVar("Checked", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What a model is and how it is trained; checked, with every default filled in."""

    baseline: str  # name of the baseline
    name: str  # name of the recipe, as in cavity/mini
    model: Mapping[str, Any]  # options of the model, plain values
    training: TrainingOptions  # options of the training
    # what is known of the weights that the training starts from, their SHA-256 among
    # it; None for random ones
    start: Mapping[str, Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        parts = {"model": self.model, "training": self.training.model_dump(mode="json")}
        told = {
            group: {
                key: value
                for key, value in part.items()
                if (key, value) not in LATER[group].items()
            }
            for group, part in parts.items()
        }
        if self.start:
            start = {"start": dict(self.start)}
        else:
            start = {}
        return {"baseline": self.baseline, "name": self.name, **told, **start}


class _Part(Settings):
    """One recipe: what differs from the defaults of its file."""

    model: Layer = Field(default_factory=dict)
    training: Layer = Field(default_factory=dict)


class _Shared(_Part):
    """A recipe of several baselines, with what differs for some of them by name."""

    baselines: dict[str, _Part] = Field(default_factory=dict)


class _File(_Part):
    """A whole file of recipes."""

    format: Literal[1]
    family: str = ""
    recipes: dict[str, _Shared] = Field(default_factory=dict)


def recipe_names(entry: Entry) -> tuple[str, ...]:
    """Return the names of a baseline's recipes, as in ``cavity/mini``, in the order of
    its file.
    """
    if entry.recipes:
        return tuple(_read(entry.recipes).recipes)
    return ()


def recipe_for(
    entry: Entry,
    split: str,
    size: str,
    *,
    variant: str | None = None,
    settings: Iterable[str] = (),
    seed: int | None = None,
    learned: Mapping[str, Any] | None = None,
) -> Recipe:
    """Return the recipe of a baseline for a split and size.

    ``learned`` are options of a trained model to go on with: above the recipe's, below
    ``settings``.
    """
    own_file = variant is not None and variant.endswith((".yaml", ".yml"))
    path = Path(str(variant)) if own_file else entry.recipes
    if path:
        file = _read(path)
    else:
        file = _File(format=1)
    if own_file or not variant:
        wanted = size
    else:
        wanted = f"{size}-{variant}"
    name = f"{split}/{wanted}"
    part = file.recipes.get(name) or file.recipes.get(f"{ANY}/{wanted}")
    if part is None and (file.recipes or (variant and not own_file)):
        same_split = [other for other in file.recipes if other.split("/")[0] == split]
        if file.recipes:
            fix = f"{suggest_name(name, same_split or file.recipes)}; or "
        else:
            fix = "leave --recipe out; or "
        if variant and not own_file:
            parts = [
                other.split("/")[1]
                for other in file.recipes
                if other.split("/")[0] in (split, ANY)
            ]
            variants = [
                other.removeprefix(f"{size}-")
                for other in parts
                if other.startswith(f"{size}-")
            ]
            if variants:
                fix = f"{suggest_name(variant, variants)}; or "
            else:
                fix = "" if size in parts else fix
            held = [
                other.removesuffix(f"-{variant}")
                for other in parts
                if other.endswith(f"-{variant}")
            ]
            if held and size in parts:
                fix = f"--size {' or '.join(held)} has it; or "
            fix += (
                f"leave --recipe out, for that of {size}; or " if size in parts else ""
            )
        raise UsageError(
            f"{entry.name} has no recipe {name!r}",
            where="--split, --size, --recipe",
            fix=f"{fix}write your own: --recipe FILE.yaml, see docs/baselines.md",
        )
    part = part or _Shared()
    for other in part.baselines:
        if other not in names():
            where = f"{path}, {name}, baselines"
            raise UnreadableFileError(
                f"unknown baseline {other!r}",
                where=where,
                fix=suggest_name(other, names()),
            )
    layers: Layer = {"model": file.model, "training": file.training}
    own = part.baselines.get(entry.name, _Part())
    settings = tuple(settings)
    for above in (part, own, _Part(model=dict(learned or {}))):
        layers = _merge(layers, {"model": above.model, "training": above.training})
    where = f"{path.name if path else entry.name}, {name}" + (
        ", and --set" if settings else ""
    )
    for setting in settings:
        layers = _merge(layers, _setting(setting))
    if seed is not None:
        layers["training"]["seed"] = seed
    return Recipe(
        baseline=entry.name,
        name=name,
        model=_checked(entry.model.Options, layers["model"], "model", where).model_dump(
            mode="json"
        ),
        training=_checked(TrainingOptions, layers["training"], "training", where),
    )


def changed_options(
    entry: Entry, options: Mapping[str, Any], settings: Iterable[str]
) -> Layer:
    """Return the options of a trained model with settings such as
    ``model.average=true``.
    """
    given: Layer = {"model": dict(options)}
    changed = given
    for setting in settings:
        changed = _merge(changed, _setting(setting))
        if "training" in changed:
            fix = "set options of the model: --set model.KEY=VALUE"
            raise UsageError(
                "the training is over", where="--set", got=setting, fix=fix
            )
    before, after = (
        _checked(entry.model.Options, layers["model"], "model", "--set").model_dump(
            mode="json"
        )
        for layers in (given, changed)
    )
    kinds = {
        "training": entry.model.Options.in_training,
        "weights": entry.model.Options.of_weights,
    }
    for kind, fixed in kinds.items():
        if other := sorted(name for name in fixed if before[name] != after[name]):
            expected, got = (
                ", ".join(f"model.{name}={layer[name]}" for name in other)
                for layer in (before, after)
            )
            fix = "leave it out, or train with it; docs/baselines.md says what a trained model takes"
            raise UsageError(
                f"an option of the {kind}",
                where="--set",
                expected=expected,
                got=got,
                fix=fix,
            )
    return after


def _read(path: Path) -> _File:
    return _checked(_File, read_yaml(path), "", str(path), UnreadableFileError)


def _merge(below: Layer, above: Layer) -> Layer:
    """Return two layers joined; mappings are joined key by key."""
    joined = dict(below)
    for key, value in above.items():
        held = joined.get(key)
        if key == "schedule" and isinstance(held, str):  # its kind alone
            held = {"kind": held}
        both = isinstance(value, Mapping) and isinstance(held, Mapping)
        if both:
            joined[key] = _merge(dict(held or {}), dict(value))
        else:
            joined[key] = value
    for key, other in (("steps", "epochs"), ("epochs", "steps")):
        if above.get(key) is not None and above.get(other) is None:
            joined.pop(other, None)
    return joined


def _setting(text: str) -> Layer:
    """Return the change by a text such as ``training.schedule.every=100``."""
    key, equals, value = text.partition("=")
    group, *path = key.strip().split(".")
    if not equals or not path or group not in ("model", "training"):
        raise UsageError(
            "cannot understand the setting",
            where="--set",
            expected="model.KEY=VALUE or training.KEY=VALUE",
            got=text,
            fix=suggest_name(group, ("model", "training")) if equals and path else None,
        )
    try:
        layer: Any = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise UsageError(
            "the value is no YAML",
            where=f"--set {key}",
            got=" ".join(str(error).split()),
        ) from None
    for name in reversed((group, *path)):
        layer = {name: layer}
    return dict(layer)


def _checked(
    options: type[Checked],
    values: object,
    group: str,
    where: str,
    kind: type[LagbenchError] = UsageError,
) -> Checked:
    """Return options, or say what is wrong with them first, with the nearest key for an
    unknown one.
    """
    try:
        return options.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
    key = ".".join(str(part) for part in (group, *first["loc"]) if part != "")
    if first["type"] == "extra_forbidden":
        holder: type[BaseModel] = options
        for step in first["loc"][:-1]:  # the keys of options nested below a path
            field = holder.model_fields.get(str(step))
            if field:
                inner = field.annotation
            else:
                inner = None
            if isinstance(inner, type) and issubclass(inner, BaseModel):
                holder = inner
            elif step == "recipes" or holder is _File:
                holder = _Shared
        fix = suggest_name(str(first["loc"][-1]), list(holder.model_fields))
        raise kind(f"unknown key {key!r}", where=where, fix=fix)
    expected = first["msg"].removeprefix("Value error, ")
    if first["type"] == "tuple_type":
        expected = "a list in brackets"
    whole = isinstance(first["input"], Mapping) and not first["type"].endswith("_type")
    if whole:
        got = None
    else:
        got = repr(first["input"])[:80]
    raise kind(f"{key} does not fit", where=where, expected=expected, got=got)
