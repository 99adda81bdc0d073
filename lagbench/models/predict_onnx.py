"""Predict the test scenarios of a data set with an ONNX model."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import check_output_file
from lagbench.data.local import load_rooted_registry, locate, resolve_root
from lagbench.data.registry import Registry
from lagbench.store.copy import scenario_files
from lagbench.submission.format import PREDICTIONS_SIGNS
from lagbench.submission.writer import PredictionsWriter
from lagbench.work.progress import Meter, Progress

from .onnx_model import LEAST_SECONDS, open_onnx


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


def predict_onnx(
    model: str | Path,
    output: str | Path = "predictions.nc",
    *,
    overwrite: bool = False,
    split: str,
    size: str | None = None,
    method: str | None = None,
    seed: int = 0,
    root: str | Path | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> OnnxPredictionResult:
    """Predict every test scenario with an ONNX model, in child processes with limits.

    Args:
        model: the ONNX file, docs/submitting.md describes it.
        output: the predictions.nc to write.
        overwrite: whether to replace predictions of that name; files of another kind,
            such as the model, are never replaced.
        split: name of the split.
        size: name of the size; the only one that is there when None.
        method: name of the method; by default the stem of the file.
        seed: seed of the training.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.
        progress: called as the work advances.

    Raises:
        UsageError: no such split or size, there is such a file, or onnx is not
            installed.
        UnreadableFileError: the model is refused, or cannot be run.
        DataError: the test subset is missing.
        WorkFailedError: the model needs more time or memory than allowed.
    """
    check_output_file(Path(output), overwrite=overwrite, signs=PREDICTIONS_SIGNS)
    root_folder = resolve_root(root)
    known = load_rooted_registry(root_folder, registry)
    tier, folder, _ = locate(split, size, root=root, registry=known)
    runner = open_onnx(Path(model), size=tier, root=folder)
    paths = scenario_files(tier, folder, ("test",))
    label = method or Path(model).stem
    meter = Meter(progress)
    meter.begin("predicting", total=len(paths), scenarios=len(paths))
    writer = PredictionsWriter(
        output,
        split=tier.split,
        size=tier.name,
        method=label,
        root=root_folder,
        registry=known,
        seed=seed,
        parameters=runner.parameters,
        device=f"{platform.processor() or platform.machine()}, 1 thread",
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
    return OnnxPredictionResult(
        path=Path(output),
        split=tier.split,
        size=tier.name,
        method=label,
        scenarios=len(paths),
        frames=tier.task.horizon,
        seconds_per_frame=seconds_per_frame,
        parameters=runner.parameters,
    )
