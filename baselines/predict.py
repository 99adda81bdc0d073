"""Predict: roll a trained model out over the test scenarios into a predictions.nc.

Only the given frames of the test subset are read. Times are those of rollouts alone,
after one step to warm up. On a CPU the cost is the processor time of all threads: other
work on the machine does not count, and it compares with that of a solver on one core.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lagbench.atomic import check_output_file, write_atomically
from lagbench.data.layout import expand_home
from lagbench.data.local import load_rooted_registry, locate_split, resolve_root
from lagbench.data.registry import Registry
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.store.copy import scenario_files
from lagbench.submission.writer import PredictionsWriter
from lagbench.work.run import Meter, Progress

from .augmentation import check_symmetry
from .baseline import Baseline, DatasetInfo, count_parameters, rescale
from .catalogue import find
from .checkpoint import Checkpoint, check_data, load, restore
from .dataset_info import find_forcing
from .machine import choose_device, hardware, use_threads
from .recipe import change_options
from .rollout import count_predicted, roll_out, scenario_batch


@dataclass(frozen=True, kw_only=True)
class PredictionResult:
    """Predictions and their costs."""

    path: Path  # the predictions.nc
    split: str  # name of the split
    size: str  # name of the size
    trained_size: str  # name of the size that the model was trained at
    settings: tuple[str, ...]  # changes of its options, as in model.average=true
    method: str  # name of the method
    scenarios: int  # scenarios predicted
    frames: int  # frames of each
    batch: int  # scenarios that were rolled out side by side
    # time of one frame of one scenario by the clock below [s]
    seconds_per_frame: float
    # 'processor' on a CPU: of all threads together, without other work on the machine;
    # 'wall' on a GPU
    clock: str
    wall_seconds_per_frame: float  # time on the wall, other work included [s]
    threads: int  # CPU threads
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
    overwrite: bool = False,
    root: str | Path | None = None,
    split: str | Path | None = None,
    size: str | None = None,
    subset: str = "test",
    settings: Sequence[str] = (),
    device: str = "auto",
    threads: int | None = None,
    batch: int | None = None,
    method: str | None = None,
    time_solver: Callable[[str, str], float | None] | None = None,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> PredictionResult:
    """Predict every test scenario of the data set that a model was trained on, or of
    another size of it.

    At another size the connectivity radius of the data set keeps its ratio to the
    distance of particles; a radius among the options stays. Statistics stay those of
    the training.

    Args:
        checkpoint: weights.safetensors or checkpoint.safetensors of a training.
        output: file to write; ``<name>.json`` beside it says what it cost.
        overwrite: whether to replace predictions of that name; files of another kind
            are never replaced.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        split: folder of the local split that the model was trained on, in place of
            ``root``; or the name of the training's split.
        size: size of the split to predict; that of the training when None.
        subset: the subset to predict: test, or shift, which lies outside train.
        settings: changes of options that have no weights, as in ``model.average=true``.
        device: ``cpu``, ``cuda`` or ``auto``; a model that computes on the CPU alone
            stays there.
        threads: threads on the CPU; one per core by default.
        batch: scenarios side by side; 1 on a CPU and all on a GPU by default.
        method: name of the method; the model's own by default.
        time_solver: function that returns the solver's time for a frame of a split and
            size on one core of this machine [s], or None where it cannot run. It is
            called after the rollouts. The caller gives it because baselines may not
            import the solver.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UnreadableFileError: the checkpoint is damaged or unsafe.
        DataError: the data set is missing, damaged, or of another version than that of
            the training.
        UsageError: the baseline is not installed, there is no such device, the model
            was trained on another split than ``split``, the weights cannot be run at
            that size or with those settings, ``batch`` is below 1, or the output would
            replace predictions without ``overwrite``, or a file of another kind, such
            as the weights.
        WorkFailedError: out of memory, or the disk is full, or another prediction
            writes the same output.
    """
    if batch is not None and batch < 1:
        raise UsageError("--batch is a number of scenarios, 1 or more")
    checkpoint_path = expand_home(checkpoint, "checkpoint")
    where = str(checkpoint_path)
    trained = load(checkpoint_path)
    output_path = expand_home(output, "--output")
    check_output_file(output_path, overwrite=overwrite)
    root_folder = resolve_root(root)
    if split is not None:
        location = locate_split(split, root=root, registry=registry)
        if location.name != trained.info.split:
            raise UsageError(
                f"the model was trained on {trained.info.split}; leave --split out, or "
                "name the folder of that split",
                where=where,
            )
        root_folder = location.root
    known_splits = load_rooted_registry(root_folder, registry)
    info = check_data(
        trained, root=root_folder, registry=known_splits, size=size, where=where
    )
    tier = known_splits.size(info.split, info.size)
    tier.scored_on(subset)
    files = scenario_files(tier, root_folder, (subset,))
    machine = choose_device(device)
    with use_threads(threads):
        model = restore_for_size(
            trained, info, settings, known_splits, root=root_folder, where=where
        )
        if model.computes_on_cpu:
            machine = "cpu"
        model = model.to(machine)
        if batch is None:
            batch = 1 if machine == "cpu" else len(files)
        batch = min(batch, len(files))
        found_hardware = hardware(machine)
        thread_count = torch.get_num_threads()
        label = str(found_hardware["device"])
        if machine == "cpu":
            plural = "s" if thread_count > 1 else ""
            label = f"{found_hardware['processor']}, {thread_count} thread{plural}"

        def read_clocks() -> NDArray[np.float64]:
            """Return the times of the wall and of the processor [s]."""
            if machine == "cuda":
                torch.cuda.synchronize()
            return np.array([time.perf_counter(), time.process_time()])

        writer = PredictionsWriter(
            output_path,
            split=info.split,
            size=info.size,
            method=method or model.method,
            subset=subset,
            dataset_sha256=info.dataset_sha256,
            root=root_folder,
            registry=known_splits,
            option="--output",
            device=label,
            parameters=count_parameters(model),
            **_training_attributes(trained, info, settings),
        )
        meter = Meter(progress)
        meter.begin("predicting", total=len(files), scenarios=len(files))
        solver_seconds = None
        seconds = np.zeros(2)  # of the rollouts, on the wall and of the processor
        frames = 0  # that the model predicted; frozen ones cost nothing
        diverged = {}
        paths = list(files.values())
        with writer:
            for first in range(0, len(paths), batch):
                given_frames = scenario_batch(
                    paths[first : first + batch],
                    slice(0, info.input_frames),
                    viscosity=tier.viscosity(),
                ).to(machine)
                if first == 0:
                    roll_out(model, given_frames, 1)  # to warm up
                before = read_clocks()
                rollouts = roll_out(model, given_frames, info.horizon)
                seconds += read_clocks() - before
                for rollout in rollouts:
                    frames += count_predicted(
                        rollout, info.horizon, input_frames=info.input_frames
                    )
                    diverged_at = rollout.diverged_at
                    if diverged_at is not None:
                        diverged[rollout.scenario] = diverged_at
                    writer.add(
                        rollout.scenario,
                        rollout.position.numpy(),
                        diverged_at=diverged_at,
                    )
                    meter.count(1, scenarios=1)
            wall_per_frame, processor_per_frame = (seconds / frames).tolist()
            seconds_per_frame = wall_per_frame
            if machine == "cpu":
                seconds_per_frame = processor_per_frame
            writer.label(seconds_per_frame=seconds_per_frame)
            if time_solver is not None:
                solver_seconds = time_solver(info.split, info.size)
            if solver_seconds is not None:
                writer.label(solver_seconds_per_frame=solver_seconds)

    result = PredictionResult(
        path=output_path,
        split=info.split,
        size=info.size,
        trained_size=trained.info.size,
        settings=tuple(settings),
        method=method or model.method,
        scenarios=len(files),
        frames=info.horizon,
        batch=batch,
        seconds_per_frame=seconds_per_frame,
        clock="processor" if machine == "cpu" else "wall",
        wall_seconds_per_frame=wall_per_frame,
        threads=thread_count,
        solver_seconds_per_frame=solver_seconds,
        device=label,
        parameters=count_parameters(model),
        diverged=diverged,
    )
    values = {**asdict(result), "path": output_path.name}
    text = json.dumps(values, indent=2, sort_keys=True)
    costs = costs_path(output_path)
    write_atomically(costs, text.encode() + b"\n", option="--output")
    return result


def costs_path(output: Path) -> Path:
    """Return the file with the costs of predictions: .json in place of .nc.

    Another ending is kept, so that run-0.5 and run-0.6 have costs of their own.

    >>> costs_path(Path("predictions.nc")).name, costs_path(Path("run-0.5")).name
    ('predictions.json', 'run-0.5.json')
    """
    if output.suffix.lower() == ".nc":
        return output.with_suffix(".json")
    return output.with_name(f"{output.name}.json")


def restore_for_size(
    checkpoint: Checkpoint,
    info: DatasetInfo,
    settings: Sequence[str],
    registry: Registry,
    *,
    root: Path,
    where: str,
) -> Baseline:
    """Return the model of a checkpoint for a size, with settings.

    Args:
        checkpoint: weights of the model.
        info: public figures of the size to predict.
        settings: changes of options that have no weights.
        registry: where splits are described.
        root: folder of all data sets.
        where: place of the checkpoint, for messages.

    Raises:
        UnreadableFileError: the checkpoint is damaged.
        UsageError: the model is not installed, or does not take the settings.
    """
    scaled = replace(checkpoint, info=rescale(checkpoint.info, info))
    # Without settings first, so that a damaged file is refused as such.
    model = restore(scaled, where=where)
    if not settings:
        return model
    entry = find(checkpoint.baseline)
    options = change_options(entry, checkpoint.options, settings)
    size = registry.size(info.split, info.size)
    check_symmetry(options.get("symmetry"), size, find_forcing(size, root))
    try:
        return restore(replace(scaled, options=options), where=where)
    except UnreadableFileError as error:
        raise UsageError(
            "the weights do not fit the model with these settings: "
            f"{', '.join(settings)}; set options without weights, or train with these "
            "settings",
            where="--set",
        ) from error


def _training_attributes(
    checkpoint: Checkpoint, target: DatasetInfo, settings: Sequence[str]
) -> dict[str, Any]:
    """Return the file's attributes of the training: provenance, seed and budget.

    The validations of a training at another size are left out: no validation of this
    size could be compared with them.
    """
    provenance = checkpoint.provenance().model_copy(
        update={"prediction_overrides": tuple(settings)}
    )
    attributes: dict[str, Any] = {
        "training": provenance.describe(),
        "provenance": provenance.to_json(),
        "seed": checkpoint.seed,
    }

    budget = checkpoint.budget
    if budget is not None:
        if target.size != checkpoint.info.size:
            unknown = {
                "metric": None,
                "best": None,
                "best_step": None,
                "validations": (),
            }
            budget = budget.model_copy(update=unknown)
        attributes["budget"] = budget.model_dump_json(exclude_defaults=True)
    return attributes
