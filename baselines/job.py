"""A training: what was asked for, the folder it writes, the record of what it did and
what it cost.

The folder holds checkpoint.pt, weights.pt, training.json and tensorboard/.
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from torch import Tensor

from lagbench.atomic import write_atomically
from lagbench.data.checksums import round_digits
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    check_regular,
)
from lagbench.submission.budget import MOST_VALIDATIONS, Budget, track_of
from lagbench.work.progress import Meter

from .baseline import Baseline, Facts
from .catalogue import find
from .checkpoint import Checkpoint, load
from .machine import hardware
from .recipe import ANY, LATER, Recipe, recipe_for, recipe_names

# state of a training whose validations brought nothing new; it is over
STOPPED_EARLY = "stopped early"
MOST_RECORD = 4 << 20  # longest training.json that is read [bytes]
# states of a training that is not to be gone on with
OVER = "finished", STOPPED_EARLY


@dataclass
class TrainingRecord:
    """What a training has done so far; it goes into checkpoints and training.json."""

    state: str = "running"  # running, interrupted, finished, stopped early or failed
    step: int = 0  # optimiser steps made
    # raw loss terms of the last step looked at, and their weighted sum 'total'
    loss: dict[str, float] = field(default_factory=dict)
    windows_seen: int = 0  # training windows of all steps
    epochs: float = 0.0  # the same over the windows of the training subsets
    metric: str | None = None  # what is validated by; None before the first validation
    # step and value of every validation, under the metric's name
    validation: list[dict[str, float]] = field(default_factory=list)
    best_step: int | None = None  # step of the best validation; None before the first
    best_value: float | None = None  # its value
    cpu_seconds: float = 0.0  # processor time of all processes, in all runs [s]
    validation_cpu_seconds: float = 0.0  # of it that of validations [s]
    gpu_seconds: float = 0.0  # time of all runs times the GPUs that were held [s]
    wall_seconds: float = 0.0  # time of all runs [s]

    def __post_init__(self) -> None:
        """Start the clocks."""
        self._cpu = _processor_seconds()
        self._wall = time.monotonic()

    def read_clocks(self, processes: int = 1, *, device: str = "cpu") -> None:
        """Add the time since the last reading, of as many processes as train alike."""
        cpu = _processor_seconds()
        wall = time.monotonic()
        self.cpu_seconds += (cpu - self._cpu) * processes
        self.gpu_seconds += (wall - self._wall) * processes * (device != "cpu")
        self.wall_seconds += wall - self._wall
        self._cpu = cpu
        self._wall = wall

    @contextmanager
    def validating(self, processes: int = 1, *, device: str = "cpu") -> Iterator[None]:
        """Take the processor time of a validation, for which as many processes wait."""
        self.read_clocks(processes, device=device)
        before = self.cpu_seconds
        yield
        self.read_clocks(processes, device=device)
        self.validation_cpu_seconds += self.cpu_seconds - before

    def validated(self, metric: str, value: float) -> bool:
        """Enter a validation at the present step; return whether it is the best so
        far.
        """
        self.metric = metric
        self.validation.append({"step": self.step, metric: value})
        if not math.isfinite(value) or (
            self.best_value is not None and not value < self.best_value
        ):
            return False
        self.best_step = self.step
        self.best_value = value
        return True

    def since_best(self) -> int:
        """Return how many validations came after the best one."""
        return sum(entry["step"] > (self.best_step or 0) for entry in self.validation)


def _processor_seconds() -> float:
    times = os.times()  # of children; of this process it has hundredths only
    return time.process_time() + times.children_user + times.children_system


class RunFolder:
    """Paths of a training's files, and what an earlier run left there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint = path / "checkpoint.pt"  # the last state, to go on from
        # the best weights in bfloat16, to predict from
        self.weights = path / "weights.pt"
        self.record = path / "training.json"  # what the training did and cost
        self.logs = path / "tensorboard"  # folder of TensorBoard's files

    def earlier(
        self, recipe: Recipe, facts: Facts, *, processes: int, resume: bool, fresh: bool
    ) -> Checkpoint | None:
        """Return the checkpoint to go on from; None for a training from the start."""
        left = [
            file
            for file in (self.checkpoint, self.weights, self.record)
            if file.exists()
        ]
        if fresh or not left:
            return None
        where = str(self.path)
        asked = recipe.as_json()
        taken = UsageError(
            "the folder holds a training",
            where=where,
            fix="go on with --resume, train anew with --fresh, or name another "
            "--output",
        )
        if self.checkpoint not in left:
            if not resume:
                raise taken
            if self.weights not in left:  # it failed before there was anything to keep
                return None
            # no training can go on from these weights, and none may replace them
            said = self._recorded()
            over = said.get("recipe") == asked and said.get("state") in OVER
            if over:
                instead = "predict from its weights"
            else:
                instead = "name another folder with --output"
            lacking = "the folder holds weights, and no checkpoint to go on from"
            raise UsageError(
                "the training is finished" if over else lacking,
                where=where,
                got=f"{self.weights.name} without {self.checkpoint.name}",
                fix=f"{instead}, or train anew with --fresh",
            )
        found = load(self.checkpoint)
        started = found.training.get("recipe", {}).get("start")
        if started != asked.get("start"):
            raise UsageError(
                "the folder holds a training that started from other weights",
                where=f"--start, {where}",
                expected=start_words(started) or "random weights: no --start",
                got=start_words(asked.get("start")) or "no --start",
                fix="give the same --start, name another folder with --output, or "
                "train anew with --fresh",
            )
        if found.training.get("recipe") != asked:
            raise UsageError(
                "the folder holds a training with another recipe",
                where=where,
                expected=first_difference(asked, found.training.get("recipe")),
                fix="name another folder with --output, or train anew with --fresh",
            )
        if not resume:
            raise taken
        if found.facts.dataset_sha256 != facts.dataset_sha256:
            raise DataError(
                "the training began on another version of the data set",
                where=where,
                expected=found.facts.dataset_sha256,
                got=facts.dataset_sha256,
                fix="train anew with --fresh",
            )
        if found.training.get("processes") != processes:
            raise UsageError(
                "the training began with another number of processes",
                where="--processes",
                expected=found.training.get("processes"),
                got=processes,
                fix="the learning rate and the order of windows follow from it; or "
                "train anew with --fresh",
            )
        return found

    def unfinished(self, trained: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return step and steps of a training that is not over, if its record has the
        weights' recipe.
        """
        said = self._recorded()
        step = said.get("step")
        steps = said.get("steps")
        if said.get("state") in OVER or said.get("recipe") != trained.get("recipe"):
            return None
        if isinstance(step, int) and isinstance(steps, int):
            return (step, steps)
        return None

    def _recorded(self) -> dict[str, Any]:
        """Return what training.json says; nothing where it is not there or no
        record.
        """
        try:
            check_regular(self.record, longest=MOST_RECORD)
            said = json.loads(self.record.read_bytes())
        except (UnreadableFileError, OSError, ValueError, RecursionError):
            return {}
        if isinstance(said, dict):
            return said
        return {}

    def holds(self, file: Path) -> bool:
        """Tell whether a file is one of those that a training here writes, behind a
        link perhaps.
        """
        return any(
            one.exists() and one.samefile(file)
            for one in (self.weights, self.checkpoint)
        )

    def clear(self) -> None:
        """Remove what an earlier training left, and nothing else."""
        logs = (*self.logs.glob("events.out.tfevents.*"), self.logs / "hparams.yaml")
        for file in (self.checkpoint, self.weights, self.record, *logs):
            file.unlink(missing_ok=True)
        with suppress(OSError):  # what is not ours stays
            self.logs.rmdir()

    def write_record(self, record: dict[str, Any]) -> None:
        """Write training.json; it appears whole or not at all."""
        text = json.dumps(record, indent=2, sort_keys=True)
        write_atomically(self.record, text.encode() + b"\n", option="--output")


def first_difference(wanted: dict[str, Any], found: object, path: str = "") -> str:
    """Return the first key whose value differs, with both values."""
    if isinstance(found, dict):
        theirs = found
    else:
        theirs = {}
    for key in sorted({*wanted, *theirs}):
        mine = wanted.get(key)
        other = theirs.get(key)
        if mine != other:
            if isinstance(mine, dict) and isinstance(other, dict):
                return first_difference(mine, other, f"{path}{key}.")
            return f"{path}{key} = {mine!r}, as asked for; the folder has {other!r}"
    return "the same recipe"


UNTOLD = (
    "seed",
    "compile",
    "log_every",
    "checkpoint_every",
)  # options that do not say what was learned
LONGEST_VALUE = 200  # letters of a changed option that are told


def settings_of(recipe: object) -> tuple[str, ...]:
    """Return what a training changed of the shipped recipe that it names, as ``--set``
    takes it.

    ``recipe`` is what a record of a training or its weights hold, of a stranger
    perhaps: options that are unknown here, and whatever names no shipped recipe, are
    passed over, long values are not told.
    """
    if isinstance(recipe, Mapping):
        held = recipe
    else:
        held = {}
    split, _, where = str(held.get("name")).partition("/")
    size, _, variant = where.partition("-")
    try:
        entry = find(str(held.get("baseline")))
        if not {f"{split}/{where}", f"{ANY}/{where}"} & set(recipe_names(entry)):
            return ()
        shipped = recipe_for(entry, split, size, variant=variant or None)
    except LagbenchError:
        return ()
    parts = {
        "model": shipped.model,
        "training": shipped.training.model_dump(mode="json"),
    }
    return tuple(
        sorted(
            f"{key}={_spelled(value)}" for key, value in _changes(parts, held, LATER)
        )
    )


def changes_of(recipe: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what a training changed of its recipe, and the weights that it started
    from, in words.
    """
    words = start_words(recipe.get("start"))
    return (*settings_of(recipe), *((f"started from {words}",) if words else ()))


def start_words(start: Mapping[str, Any] | None) -> str:
    """Return which weights a training starts from, in words; nothing for random
    ones.
    """
    if start:
        return f"{start['recipe']}, weights {start['sha256'][:12]}"
    return ""


def _changes(
    shipped: Mapping[str, Any], held: object, missing: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield where a record differs from the shipped options, with paths as in
    model.loss.vorticity.
    """
    if not isinstance(held, Mapping):
        return
    for key, value in shipped.items():
        got = held.get(key, missing.get(key, value))
        if isinstance(value, Mapping):
            yield from _changes(value, got, missing.get(key, {}), f"{path}{key}.")
        elif key not in UNTOLD and got != value:
            yield f"{path}{key}", got


def _spelled(value: object) -> str:
    """Return a value in a line of YAML, quote only where it would be read as something
    else.
    """
    plain = isinstance(value, str) and value.isascii() and value.isprintable()
    if plain:
        text = str(value)
    else:
        text = json.dumps(value)
    if len(text) > LONGEST_VALUE:
        return "..."
    try:
        bare = not plain or yaml.safe_load(text) == value
    except (
        yaml.YAMLError,
        ValueError,
    ):  # the latter of what looks like a date and is none
        bare = False
    if bare:
        return text
    return json.dumps(value)


FORMAT = 1  # of training.json
# whose versions decide the result
LIBRARIES = (
    "lagbench",
    "torch",
    "torch-geometric",
    "pytorch-lightning",
    "numpy",
    "scipy",
)


@dataclass(frozen=True, kw_only=True)
class TrainingJob:
    """A training to do."""

    recipe: Recipe  # model and training options
    facts: Facts  # public figures of the data set
    folder: RunFolder  # where files go
    earlier: Checkpoint | None  # checkpoint to go on from; None at the start
    root: Path  # folder of all data sets
    registry: Registry  # where the split is described
    device: str = "cpu"  # 'cpu' or 'cuda'
    processes: int = 1  # processes that share the training
    workers: int = 0  # processes that read windows ahead
    meter: Meter = field(default_factory=Meter)  # counts steps

    def ledger(self) -> TrainingRecord:
        """Return the ledger that goes on where an earlier run ended, in the state that
        it ended in.
        """
        if self.earlier:
            stored = self.earlier.training
        else:
            stored = {}
        return TrainingRecord(
            **{
                one.name: stored[one.name]
                for one in fields(TrainingRecord)
                if one.name in stored
            }
        )

    def budget(self, ledger: TrainingRecord) -> Budget:
        """Return what the training took so far, as predictions and entries say it.

        Hours are with those of the weights that it started from; epochs, steps and
        validations are its own. Of many validations every n-th is told, the last one
        among them.
        """
        machine = hardware(self.device)
        device = str(machine["device" if self.device != "cpu" else "processor"])
        known = [
            (int(one["step"]), one[str(ledger.metric)]) for one in ledger.validation
        ]
        told = [one for one in known if math.isfinite(one[1])]
        stride = -(-len(told) // MOST_VALIDATIONS) or 1
        # Processes that read windows ahead live on, so that nobody has their time.
        if self.workers:
            seconds = None
        else:
            seconds = ledger.cpu_seconds - ledger.validation_cpu_seconds
        earlier = (self.recipe.start or {}).get("took", {})

        def hours(own: float | None, name: str) -> float | None:
            spent = earlier.get(name, 0.0)
            if own is None or spent is None:
                return None
            return round_digits(own / 3600.0 + spent, 6)

        return Budget(
            windows=ledger.windows_seen or None,
            epochs=round_digits(ledger.epochs, 6),
            steps=ledger.step,
            start_steps=earlier.get("steps"),
            cpu_hours=hours(seconds, "cpu_hours"),
            validation_hours=hours(ledger.validation_cpu_seconds, "validation_hours"),
            gpu_hours=hours(ledger.gpu_seconds, "gpu_hours"),
            device=device.encode("ascii", "replace").decode()[:100],
            threads=machine["threads"],
            metric=ledger.metric,
            best=ledger.best_value,
            best_step=ledger.best_step,
            validations=tuple(told[::-1][::stride][::-1]),
        )

    def checkpoint(
        self,
        ledger: TrainingRecord,
        weights: Mapping[str, Tensor],
        optimizer: Mapping[str, Any] | None = None,
    ) -> Checkpoint:
        """Return a checkpoint of the present step."""
        fixed = {"recipe": self.recipe.as_json(), "processes": self.processes}
        return Checkpoint(
            baseline=self.recipe.baseline,
            options=self.recipe.model,
            facts=self.facts,
            weights=weights,
            training={
                **fixed,
                **asdict(ledger),
                "budget": self.budget(ledger).model_dump(mode="json"),
            },
            optimizer=optimizer,
        )

    def record(
        self, model: Baseline, ledger: TrainingRecord, **more: int
    ) -> dict[str, Any]:
        """Return what training.json says."""
        facts = self.facts
        budget = self.budget(ledger)
        return {
            "format": FORMAT,
            "baseline": self.recipe.baseline,
            "method": model.method,
            "recipe": self.recipe.as_json(),
            "split": facts.split,
            "size": facts.size,
            "dataset_version": facts.version,
            "dataset_sha256": facts.dataset_sha256,
            "parameters": parameter_count(model),
            "processes": self.processes,
            "hardware": hardware(self.device),
            "versions": {
                "python": platform.python_version(),
                **{name: version(name) for name in LIBRARIES},
            },
            "budget": budget.model_dump(mode="json"),
            "track": track_of(facts.size, budget),
            **more,
            **asdict(ledger),
        }


def parameter_count(model: Baseline) -> int:
    """Return the trained numbers of a model: parameters, or the coefficients of a
    closed form.
    """
    if getattr(model, "closed_form", False):
        return sum(
            value.numel()
            for value in model.state_dict().values()
            if value.is_floating_point()
        )
    return sum(p.numel() for p in model.parameters() if p.requires_grad)
