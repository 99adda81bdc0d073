"""The command predict."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.types import NonNegativeInt, PositiveInt

from lagbench.data.layout import quote_root
from lagbench.data.registry import load
from lagbench.errors import UsageError, check_regular, format_count

from .model_options import require_libraries
from .options import (
    DeviceOption,
    JsonFlag,
    OverwriteFlag,
    QuietFlag,
    RootOption,
    ScoredSubsetOption,
    ThreadsOption,
)
from .output import print_result, progress_bar
from .solver_bench import time_solver

if TYPE_CHECKING:
    from lagbench.baselines.predict import PredictionResult
    from lagbench.models.predict_onnx import OnnxPredictionResult


def predict_command(
    checkpoint: Path,
    /,
    *,
    output: Annotated[Path, Parameter(alias="-o")] = Path("predictions.nc"),
    overwrite: OverwriteFlag = False,
    split: str | None = None,
    size: str | None = None,
    subset: ScoredSubsetOption = "test",
    settings: Annotated[list[str] | None, Parameter(name="--set")] = None,
    root: RootOption = None,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    batch: PositiveInt | None = None,
    method: str | None = None,
    seed: NonNegativeInt | None = None,
    bench: Annotated[bool, Parameter(negative="--no-bench")] = True,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Predict the test scenarios with a trained model.

    The predictions go into a predictions.nc.

    Args:
        checkpoint: A trained model: safetensors or ONNX.
        output: File to write.
        split: Split to predict: the folder of a local split; or a name, for an ONNX
            file that does not state its split.
        size: Size to predict; by default that of the training.
        settings: Change the model, as in model.average=true; repeatable.
        batch: Scenarios to predict together; by default 1 on a CPU, all on a GPU.
        method: Name of the method on a leaderboard.
        seed: Seed of the training of an ONNX file, which does not state it; 0 by
            default.
        bench: Time our solver too, for the speed-up.
    """
    clock = time_solver if bench else None
    check_regular(checkpoint)
    if checkpoint.suffix == ".onnx":
        has_other_device = device not in ("auto", "cpu") or threads not in (None, 1)
        if settings or batch is not None or has_other_device:
            raise UsageError(
                "--set, --device, --threads and --batch change nothing for an ONNX "
                "file; leave them out"
            )
        from lagbench.models.predict_onnx import predict_onnx

        with progress_bar(quiet=quiet) as progress:
            onnx_result = predict_onnx(
                checkpoint,
                output,
                overwrite=overwrite,
                split=split,
                size=size,
                subset=subset,
                method=method,
                seed=seed or 0,
                root=root,
                time_solver=clock,
                progress=progress,
            )
        lines = [
            f"{onnx_result.path}: {onnx_result.method}, "
            f"{format_count(onnx_result.scenarios, 'scenario')}, "
            f"{onnx_result.frames} frames",
            f"  model   {onnx_result.seconds_per_frame:.3g} s per frame: processor "
            "time of one thread, mean over all predicted frames",
            *_describe_solver(onnx_result),
            _next_command(onnx_result.path, split, root),
        ]
        print_result(onnx_result, lines, as_json=as_json, quiet=quiet)
        return

    if seed is not None:
        raise UsageError(
            "weights state the seed of their training; leave it out", where="--seed"
        )
    require_libraries()
    from lagbench.baselines.predict import predict

    is_replaced = output.is_file()
    with progress_bar(quiet=quiet) as progress:
        result = predict(
            checkpoint,
            output,
            overwrite=overwrite,
            root=root,
            split=split,
            size=size,
            subset=subset,
            settings=tuple(settings or ()),
            device=device,
            threads=threads,
            batch=batch,
            method=method,
            time_solver=clock,
            progress=progress,
        )
    lines = [
        *_describe(result, is_replaced=is_replaced),
        _next_command(result.path, split, root),
    ]
    print_result(result, lines, as_json=as_json, quiet=quiet)


def _describe(result: PredictionResult, *, is_replaced: bool) -> Iterator[str]:
    method_parts = [result.method]
    if result.trained_size != result.size:
        method_parts.append(f"trained at {result.trained_size}")
    method_parts += result.settings
    yield (
        f"{result.path}: {', '.join(method_parts)}, "
        f"{format_count(result.scenarios, 'scenario')}, "
        f"{result.frames} frames"
    )
    if is_replaced:
        yield "  in place of the predictions that were there"
    cost = f"{result.seconds_per_frame:.3g} s per frame"
    yield f"  model   {cost} on {result.device}"
    clock = f"{result.wall_seconds_per_frame:.3g} s on the wall"
    if result.clock != "wall":
        clock = f"processor time of {format_count(result.threads, 'thread')}; {clock}"
    yield f"          {clock}"
    yield from _describe_solver(result)
    if result.diverged:
        marks = []
        for scenario, frame in result.diverged.items():
            marks.append(f"scenario {scenario} at frame {frame}")
        yield f"  frozen  {', '.join(marks)}: not finite from there on"


def _describe_solver(
    result: PredictionResult | OnnxPredictionResult,
) -> Iterator[str]:
    """Yield the time of our solver, and how much faster one of both is."""
    solver_seconds = result.solver_seconds_per_frame
    if solver_seconds is None:
        return
    ratio = result.seconds_per_frame / solver_seconds
    speeds = f"{ratio:.2g} times as fast as the model"
    if ratio < 1.0:
        speeds = f"the model is {1.0 / ratio:.2g} times as fast"
    yield (
        f"  solver  {solver_seconds:.3g} s per frame on one core of this "
        f"machine: {speeds}"
    )


def _next_command(path: Path, split: str | None, root: str | Path | None) -> str:
    """Return the line that says how to score the predictions."""
    options = ""
    if split is not None and split not in load().splits:
        options = f" --split {shlex.quote(split)}"
    elif root:
        options = f" --root {quote_root(root)}"
    return f"next: lagbench score {shlex.quote(str(path))}{options}"
