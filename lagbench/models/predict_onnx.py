"""Predict the test scenarios of a data set with an ONNX model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import check_output_file
from lagbench.data.layout import expand_home
from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.store.copy import scenario_files
from lagbench.submission.writer import (
    PredictionsWriter,
)
from lagbench.work.machine import processor_name
from lagbench.work.run import Meter, Progress

from .onnx_model import LEAST_SECONDS, OnnxModel, check_onnx


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
    """Predict a subset with an ONNX model.

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
        UsageError: no such split, size or subset; neither ``split`` nor the file names
            a split; there is such an output, or onnx is not installed.
        UnreadableFileError: the model cannot be run.
        DataError: the subset is missing.
    """
    model_path = expand_home(model, "model")
    output_path = expand_home(output, "--output")
    check_output_file(output_path, overwrite=overwrite)
    declared = check_onnx(model_path)
    if split is None:
        split = declared.split
    if split is None:
        raise UsageError(
            "the file does not state its split; name it: --split cavity --size mini",
            where=str(model_path),
        )
    if size is None and split == declared.split:
        size = declared.size
    any_tier, folder, known = locate(split, size, root=root, registry=registry)
    if declared.split not in (None, any_tier.split):
        raise UsageError(
            f"the model was trained on {declared.split}; leave --split out",
            where=str(model_path),
        )
    tier = any_tier.scored_on(subset)
    paths = scenario_files(tier, folder, (subset,))
    runner = OnnxModel(model_path, size=tier, root=folder)
    meter = Meter(progress)
    meter.begin("predicting", total=len(paths), scenarios=len(paths))
    label = method or model_path.stem
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
