"""Predict the test scenarios of a data set with an ONNX model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.layout import expand_home
from lagbench.data.local import SizeLocation, locate
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.store.copy import scenario_files
from lagbench.submission.format import describe_kind, is_name_valid
from lagbench.submission.writer import (
    PredictionsWriter,
    check_predictions_output,
)
from lagbench.work.machine import processor_name
from lagbench.work.run import Meter, Progress

from .onnx_model import LEAST_SECONDS, DeclaredModel, check_onnx, open_onnx
from .output_lock import hold_output


@dataclass(frozen=True, kw_only=True)
class OnnxPredictionResult:
    """Predictions of an ONNX model, and their cost."""

    path: Path  # the predictions.nc
    split: str
    size: str
    method: str
    scenarios: int  # scenarios predicted
    frames: int  # frames of each
    seconds_per_frame: float  # processor time on one thread [s]
    parameters: int  # numbers in the initialisers of the model
    solver_seconds_per_frame: float | None  # our solver's time on one core [s]


def predict_onnx(
    model: str | Path,
    output: str | Path = "predictions.nc",
    *,
    overwrite: bool = False,
    split: str | None = None,
    size: str | None = None,
    subset: str = "test",
    method: str | None = None,
    seed: int = 0,
    root: str | Path | None = None,
    registry: Registry | None = None,
    time_solver: Callable[[str, str], float | None] | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> OnnxPredictionResult:
    """Predict a subset with an ONNX model, in child processes with limits.

    Args:
        model: the ONNX file, docs/submitting.md describes it.
        output: the predictions.nc to write.
        overwrite: whether to replace predictions of that name; files of another kind,
            such as the model, are never replaced.
        split: name of the split, or the folder of a local one; the split that the file
            states when None.
        size: name of the size. When None, the size that the file states for this split;
            if it states none, the only size that is there.
        subset: the subset to predict: test, or shift, which lies outside train.
        method: name of the method; by default the stem of the file.
        seed: seed of the training.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.
        time_solver: function that returns the solver's time for a frame of a split and
            size on one core of this machine [s], or None where it cannot run; called
            after the rollouts.
        progress: called as the work advances.

    Raises:
        UsageError: no such split, size or subset, neither ``split`` nor the file names
            a split, the file states another split than ``split``, no method may have
            the name of the file, there is such an output, or onnx is not installed.
        UnreadableFileError: the model is refused, or cannot be run.
        DataError: the subset is missing.
        WorkFailedError: the model needs more time or memory than allowed, or another
            prediction writes the same output.
    """
    model_path = expand_home(model, "model")
    output_path = expand_home(output, "--output")
    check_predictions_output(output_path, overwrite=overwrite)
    declared = check_onnx(model_path)
    label = method or _method_of(model_path)
    any_tier, folder, known = _locate_data_set(
        split, size, declared, model_path, root=root, registry=registry
    )
    tier = any_tier.scored_on(subset)
    paths = scenario_files(tier, folder, (subset,))
    runner = open_onnx(model_path, size=tier, root=folder, declared=declared)
    meter = Meter(progress)
    meter.begin("predicting", total=len(paths), scenarios=len(paths))
    writer = PredictionsWriter(
        output_path,
        split=tier.split,
        size=tier.name,
        method=label,
        subset=subset,
        root=folder,
        registry=known,
        option="--output",
        seed=seed,
        parameters=runner.parameters,
        device=f"{processor_name()}, 1 thread",
    )
    seconds = 0.0
    with hold_output(output_path):
        # Another prediction may have written it since the first check.
        check_predictions_output(output_path, overwrite=overwrite)
        with writer:
            for scenario, path in paths.items():
                rollout = runner.roll_out(path)
                writer.add(scenario, rollout.position, diverged_at=rollout.diverged_at)
                seconds += max(rollout.seconds, LEAST_SECONDS)
                meter.count(1, scenarios=1)
            seconds_per_frame = seconds / (len(paths) * tier.task.horizon)
            writer.label(seconds_per_frame=seconds_per_frame)
            solver_seconds = None
            if time_solver is not None:
                solver_seconds = time_solver(tier.split, tier.name)
            if solver_seconds is not None:
                writer.label(solver_seconds_per_frame=solver_seconds)
    return OnnxPredictionResult(
        path=output_path,
        split=tier.split,
        size=tier.name,
        method=label,
        scenarios=len(paths),
        frames=tier.task.horizon,
        seconds_per_frame=seconds_per_frame,
        parameters=runner.parameters,
        solver_seconds_per_frame=solver_seconds,
    )


def _method_of(model: Path) -> str:
    """Return the name of the method that a file is named after.

    Raises:
        UsageError: no method may have that name.
    """
    if is_name_valid(model.stem):
        return model.stem
    raise UsageError(
        "a method cannot have the name of the file",
        where=f"{model}, --method",
        expected=describe_kind("method"),
        got=ascii(model.stem),
        fix="name the method: --method lines",
    )


def _locate_data_set(
    split: str | None,
    size: str | None,
    declared: DeclaredModel,
    model: Path,
    *,
    root: str | Path | None,
    registry: Registry | None,
) -> SizeLocation:
    """Return the data set to predict, and where it lies.

    Args:
        split: the named split; that of the file when None.
        size: the named size.
        declared: what the file states.
        model: the file, for messages.
        root: folder of all data sets.
        registry: where splits are described.

    Raises:
        UsageError: no split is named or stated, there is no such data set, or the file
            states another split than the named one.
    """
    chosen_split, chosen_size = _choose_data_set(split, size, declared, model)
    try:
        location = locate(chosen_split, chosen_size, root=root, registry=registry)
    except UsageError as error:
        if split is not None:
            raise
        raise UsageError(
            error.what,
            where=f"{model}, the data set that it states",
            expected=error.expected,
            got=error.got,
            fix="name the split, or the folder of a local one: --split",
        ) from error
    located_split = location.size.split
    if declared.split not in (None, located_split):
        raise UsageError(
            "the model was trained on another split",
            where=f"{model}, --split",
            expected=declared.split,
            got=located_split,
            fix="leave --split out, or give the model of this split",
        )
    return location


def _choose_data_set(
    split: str | None, size: str | None, declared: DeclaredModel, model: Path
) -> tuple[str, str | None]:
    """Return the split and size to predict: the named ones, or else the stated ones."""
    if split is None:
        split = declared.split
    if split is None:
        raise UsageError(
            "the ONNX file does not state its split",
            where=f"{model}, --split",
            expected="the split that the model predicts",
            got="nothing",
            fix="name it: --split cavity --size mini",
        )
    if size is None and split == declared.split:
        size = declared.size
    return split, size
