"""Predict: roll a trained model out over the test scenarios into a predictions.nc.

Of the test subset only the given frames are read. Time is taken of rollouts alone,
after one step to warm up; that of the neighbour search is measured on frames of the
same rollouts.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from lagbench.atomic import write_atomically
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.submission.provenance import StartWeights, TrainingProvenance
from lagbench.submission.writer import PredictionsWriter
from lagbench.work.progress import Meter, Progress

from .augmentation import check_symmetry
from .baseline import Baseline, Facts, rescaled
from .catalogue import find
from .checkpoint import Checkpoint, check_data, load, restore
from .graph import radius_graph
from .job import MOST_RECORD, RunFolder, parameter_count, settings_of
from .machine import (
    bound_memory,
    chosen_device,
    hardware,
    memory_errors_told,
    threads_used,
)
from .recipe import changed_options
from .rollout import Rollout, roll_out, scenario_batch, scenario_paths
from .start import warn_of_last_state

START_DIGITS = 12  # digits of a SHA-256 that provenance names

SEARCHES = 5  # frames of a rollout on which the neighbour search is timed alone


class UnfinishedWarning(UserWarning):
    """The weights are those of a training that did not come to its end."""


@dataclass(frozen=True, kw_only=True)
class PredictionResult:
    """What a prediction made and cost."""

    path: Path  # the predictions.nc
    split: str  # name of the split
    size: str  # name of the size
    trained_size: str  # name of the size that the model was trained at
    settings: tuple[str, ...]  # changes of its options, as in model.average=true
    method: str  # what made it
    scenarios: int  # scenarios predicted
    frames: int  # frames of each
    batch: int  # scenarios that were rolled out side by side
    seconds_per_frame: float  # time of one frame of one scenario [s]
    seconds_without_search: float  # the same without the neighbour search [s]
    # 'processor' on one CPU thread, where other work on the machine then does not
    # count; 'wall' on a GPU and on several threads
    clock: str
    # of our solver on one core of this machine [s]
    solver_seconds_per_frame: float | None
    device: str  # processor and threads, or GPU
    parameters: int  # trained numbers of the model
    # scenario id to the absolute frame from which its rollout is frozen
    diverged: Mapping[int, int]


def predict(
    checkpoint: str | Path,
    output: str | Path = "predictions.nc",
    *,
    root: str | Path | None = None,
    size: str | None = None,
    settings: Sequence[str] = (),
    device: str = "auto",
    threads: int | None = None,
    batch: int | None = None,
    method: str | None = None,
    solver: Callable[[str, str], float | None] | None = None,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> PredictionResult:
    """Predict every test scenario of the data set that a model was trained on, or of
    another size of it.

    At another size the connectivity radius keeps its ratio to the distance of
    particles, and statistics stay those of the training.

    Where a training.json beside the checkpoint says that its training is not over,
    there is an :class:`UnfinishedWarning`; where it holds the last state beside the
    best weights, a :class:`~lagbench.baselines.start.LastStateWarning`.

    Args:
        checkpoint: weights.pt or checkpoint.pt of a training.
        output: file to write; ``<name>.json`` beside it says what it cost.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        size: size of the split to predict; that of the training when None.
        settings: changes of options that have no weights, as in ``model.average=true``.
        device: ``cpu``, ``cuda`` or ``auto``.
        threads: threads on the CPU; one per core by default.
        batch: scenarios side by side; 1 on a CPU and all on a GPU by default.
        method: what to call it; the model's own name by default.
        solver: called with split and size after the rollouts: time of our solver for a
            frame on one core of this machine [s], None where it cannot be told.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UnreadableFileError: the checkpoint is damaged or unsafe.
        DataError: the data set is missing, damaged, or of another version than that of
            the training.
        UsageError: the baseline is not installed, no such device, weights of no use at
            the size or as set, or the output would replace something else, as the
            weights themselves.
        WorkFailedError: out of memory, or the disk is full.
    """
    check_replaceable(Path(output))
    found = load(checkpoint)
    warn_of_last_state(found, Path(checkpoint))
    # Weights of the best validation say 'running' for good: what became of the training
    # stands beside them.
    path = Path(checkpoint)
    if (reached := RunFolder(path.parent).unfinished(found.training)) is not None:
        warnings.warn(
            f"the training behind {path} stands at step {reached[0]} of {reached[1]}; "
            f"to go on with it"
            f" give its `lagbench train` command again, with --output {path.parent}",
            UnfinishedWarning,
            stacklevel=2,
        )
    home = resolve_root(root)
    known = load_rooted_registry(home, registry)
    facts = check_data(
        found, root=home, registry=known, size=size, where=str(checkpoint)
    )
    machine = chosen_device(device)
    bound_memory()
    tests = scenario_paths(
        facts.split, subset="test", size=facts.size, root=home, registry=known
    )
    paths = list(tests.values())
    side = min(batch or (1 if machine == "cpu" else len(paths)), len(paths))
    with threads_used(threads), memory_errors_told("lower --batch"):
        model = _model(found, facts, settings, known, where=str(checkpoint)).to(machine)
        work = _Rollouts(model, facts, paths, side, machine)
        label = method or model.method
        count = parameter_count(model)
        here = hardware(machine)
        on_cpu = f"{here['processor']}, {here['threads']} thread{'s' if here['threads'] > 1 else ''}"
        if machine == "cuda":
            hardware_label = str(here["device"])
        else:
            hardware_label = on_cpu
        writer = PredictionsWriter(
            output,
            split=facts.split,
            size=facts.size,
            method=label,
            dataset_sha256=facts.dataset_sha256,
            registry=known,
            device=hardware_label,
            parameters=count,
            **_provenance(found, facts, settings),
        )
        meter = Meter(progress)
        timed = None
        meter.begin("predicting", total=len(paths), scenarios=len(paths))
        with writer:
            for rollout in work:
                writer.add(
                    rollout.scenario,
                    rollout.position.numpy(),
                    diverged_at=rollout.diverged_at,
                )
                meter.count(1, scenarios=1)
            writer.label(seconds_per_frame=work.seconds_per_frame)
            if (
                solver is not None
                and (timed := solver(facts.split, facts.size)) is not None
            ):
                writer.label(solver_seconds_per_frame=timed)
    result = PredictionResult(
        path=Path(output),
        split=facts.split,
        size=facts.size,
        trained_size=found.facts.size,
        settings=tuple(settings),
        method=label,
        scenarios=len(paths),
        frames=facts.horizon,
        batch=side,
        seconds_per_frame=work.seconds_per_frame,
        seconds_without_search=work.seconds_per_frame - work.search_per_frame,
        clock=work.clock,
        solver_seconds_per_frame=timed,
        device=hardware_label,
        parameters=count,
        diverged=work.diverged,
    )
    plain = json.dumps(
        {**asdict(result), "path": result.path.name}, indent=2, sort_keys=True
    )
    write_atomically(
        result.path.with_suffix(".json"), plain.encode() + b"\n", option="--output"
    )
    return result


def check_replaceable(output: Path) -> None:
    """Refuse to write predictions, and what they cost beside them, over files that are
    something else.
    """
    # a folder may have no name of its own
    cost = output if output.is_dir() else output.with_suffix(".json")
    if cost.is_dir():
        fix = f"name a file, as in -o {cost / 'predictions.nc'}"
        raise UsageError(
            "the output is a folder", where="--output", got=str(cost), fix=fix
        )
    if output == cost:
        fix = f"name it {output.with_suffix('.nc').name}: what the predictions cost goes to {cost.name}"
        raise UsageError(
            "predictions are no JSON", where="--output", got=str(output), fix=fix
        )
    # scores have no format of data, scenarios no hash of the whole data set
    of_predictions = (b"lagbench_format", b"dataset_sha256")
    of_cost = (b"seconds_without_search",)
    for path, ours in ((output, of_predictions), (cost, of_cost)):
        if not path.is_file():
            continue
        with path.open("rb") as stream:
            held = stream.read(MOST_RECORD)
        if held and not all(sign in held for sign in ours):
            raise UsageError(
                "the output would replace a file that is something else",
                where="--output",
                got=str(path),
                fix="name another file: -o predictions.nc",
            )


class _Rollouts:
    """Rolls scenarios out, some side by side, and takes the time."""

    def __init__(
        self, model: Baseline, facts: Facts, paths: list[Path], side: int, machine: str
    ) -> None:
        self.seconds = 0.0  # time of the rollouts [s]
        # the time that is taken, 'processor' or 'wall'
        if machine == "cpu" and torch.get_num_threads() == 1:
            self.clock = "processor"
        else:
            self.clock = "wall"
        # frames that the model was asked for, of all scenarios; frozen ones cost
        # nothing
        self.frames = 0
        # scenario id to the absolute frame from which its rollout is frozen
        self.diverged: dict[int, int] = {}
        self._model = model
        self._facts = facts
        self._machine = machine
        self._groups = [
            paths[first : first + side] for first in range(0, len(paths), side)
        ]
        self._searches: list[float] = []

    def __iter__(self) -> Iterator[Rollout]:
        """Yield the rollout of every scenario."""
        for number, group in enumerate(self._groups):
            given = scenario_batch(group, slice(0, self._facts.input_frames)).to(
                self._machine
            )
            if number == 0:
                roll_out(self._model, given, 1)
            started = self._now()
            found = roll_out(self._model, given, self._facts.horizon)
            self.seconds += self._now() - started
            for one in found:
                if one.diverged_at is None:
                    self.frames += self._facts.horizon
                else:  # the first frame that is not finite was made, too
                    self.frames += one.diverged_at - self._facts.input_frames + 1
                    self.diverged[one.scenario] = one.diverged_at
            radius = getattr(self._model, "radius", None)
            if (
                radius is not None
            ):  # search neighbours once more in some frames, and take the time
                positions = torch.cat([one.position for one in found], dim=1).to(
                    self._machine
                )
                most = getattr(self._model.options, "neighbours", None)
                for frame in range(
                    0, len(positions), max(1, len(positions) // SEARCHES)
                ):
                    started = self._now()
                    radius_graph(
                        positions[frame], float(radius), given.sample, most=most
                    )
                    self._searches.append((self._now() - started) / len(found))
            yield from found

    @property
    def seconds_per_frame(self) -> float:
        """Time of one frame of one scenario [s]."""
        return self.seconds / self.frames

    @property
    def search_per_frame(self) -> float:
        """Time of the neighbour search in it [s]; 0 for a model without one."""
        if self._searches:
            return sum(self._searches) / len(self._searches)
        return 0.0

    def _now(self) -> float:
        if self._machine == "cuda":
            torch.cuda.synchronize()
        if self.clock == "processor":
            return time.process_time()
        return time.perf_counter()


def _model(
    found: Checkpoint,
    facts: Facts,
    settings: Sequence[str],
    known: Registry,
    *,
    where: str,
) -> Baseline:
    """Return the model of a checkpoint for the size that facts tell of, with
    settings.
    """
    scaled = replace(found, facts=rescaled(found.facts, facts))
    model = restore(scaled, where=where)  # refuses a damaged file, whatever is set
    if not settings:
        return model
    options = changed_options(find(found.baseline), found.options, settings)
    check_symmetry(options.get("symmetry"), known.size(facts.split, facts.size))
    try:
        return restore(replace(scaled, options=options), where=where)
    except UnreadableFileError as error:
        raise UsageError(
            "the weights do not fit the model with these settings",
            where="--set",
            got=", ".join(settings),
            fix="set what changes no weights, or train with these settings",
        ) from error


def provenance_of(checkpoint: Checkpoint) -> TrainingProvenance:
    """Return the training behind weights.

    Raises:
        UnreadableFileError: what the weights record of their training cannot be told.
    """
    facts = checkpoint.facts
    recipe = checkpoint.training.get("recipe", {})
    subsets = recipe.get("training", {}).get("windows", ("train",))
    start = recipe.get("start")
    try:
        start_weights = None
        if start:
            start_weights = StartWeights(
                recipe=start["recipe"], weights=start["sha256"][:START_DIGITS]
            )
        return TrainingProvenance(
            split=facts.split,
            size=facts.size,
            subsets=tuple(subsets),
            recipe=str(recipe.get("name")),
            step=checkpoint.training.get("step", 0),
            overrides=settings_of(recipe),
            start=start_weights,
        )
    except (ValidationError, TypeError, KeyError) as error:
        raise UnreadableFileError(
            "the weights record a training that cannot be told",
            where=f"{facts.split} {facts.size}",
            expected="a recipe, subsets and a step, as `lagbench train` records them",
            got=type(error).__name__,
            fix="train the model with `lagbench train`",
        ) from error


def _provenance(
    checkpoint: Checkpoint, here: Facts, settings: Sequence[str]
) -> dict[str, Any]:
    """Return seed, training as data and in words, and its budget, for the file's attributes.

    Validations at another size than the one predicted are left out: they compare with
    none there.
    """
    facts = checkpoint.facts
    done = checkpoint.training
    provenance = provenance_of(checkpoint).model_copy(
        update={"prediction_overrides": tuple(settings)}
    )
    seed = done.get("recipe", {}).get("training", {}).get("seed", 0)
    found: dict[str, Any] = {
        "training": provenance.describe(),
        "provenance": provenance.to_json(),
        "seed": int(seed),
    }
    if budget := checkpoint.budget:
        unknown = {"metric": None, "best": None, "best_step": None, "validations": ()}
        if here.size == facts.size:
            budget = budget
        else:
            budget = budget.model_copy(update=unknown)
        found["budget"] = budget.model_dump_json(exclude_defaults=True)
    return found
