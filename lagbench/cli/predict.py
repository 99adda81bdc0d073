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

from .model_options import PREDICTION_LIBRARIES, require_libraries
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
from .solver_bench import SolverBench, try_bench

LARGEST_SEED = 2**31 - 1

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
    solver_clock = _SolverClock(quiet=quiet)
    time_solver = solver_clock if bench else None
    if checkpoint.suffix == ".onnx":
        check_regular(checkpoint)
        _refuse_options_of_weights(
            settings=settings, device=device, threads=threads, batch=batch
        )
        onnx_result = _predict_onnx(
            checkpoint,
            output,
            overwrite=overwrite,
            split=split,
            size=size,
            subset=subset,
            method=method,
            seed=seed or 0,
            root=root,
            time_solver=time_solver,
            quiet=quiet,
        )
        lines = [
            *_describe_onnx(onnx_result, solver=solver_clock.bench),
            _next_command(onnx_result.path, split, root),
        ]
        value = {**vars(onnx_result), "solver": solver_clock.bench}
        print_result(value, lines, as_json=as_json, quiet=quiet)
        return

    _refuse_stated_seed(seed)
    require_libraries(PREDICTION_LIBRARIES)
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
            time_solver=time_solver,
            progress=progress,
        )
    solver = solver_clock.bench
    lines = [
        *_describe(result, solver=solver, is_replaced=is_replaced),
        _next_command(result.path, split, root),
    ]
    value = {**vars(result), "solver": solver}
    print_result(value, lines, as_json=as_json, quiet=quiet)


def _refuse_options_of_weights(
    *,
    settings: list[str] | None,
    device: str,
    threads: int | None,
    batch: int | None,
) -> None:
    """Refuse options that change nothing for an ONNX file."""
    is_given = {
        "--set": bool(settings),
        "--device": device not in {"auto", "cpu"},
        "--threads": threads not in {None, 1},
        "--batch": batch is not None,
    }
    for name, is_there in is_given.items():
        if is_there:
            raise UsageError("not with an ONNX file; leave it out", where=name)


def _refuse_stated_seed(seed: int | None) -> None:
    """Refuse a seed for weights, which state the seed of their training."""
    if seed is not None:
        raise UsageError(
            "weights state the seed of their training; leave it out",
            where="--seed",
        )


def _predict_onnx(
    model: Path,
    output: Path,
    *,
    overwrite: bool,
    split: str | None,
    size: str | None,
    subset: str,
    method: str | None,
    seed: int,
    root: str | Path | None,
    time_solver: _SolverClock | None,
    quiet: bool,
) -> OnnxPredictionResult:
    """Predict with an ONNX file."""
    from lagbench.models.predict_onnx import predict_onnx

    with progress_bar(quiet=quiet) as progress:
        return predict_onnx(
            model,
            output,
            overwrite=overwrite,
            split=split,
            size=size,
            subset=subset,
            method=method,
            seed=seed,
            root=root,
            time_solver=time_solver,
            progress=progress,
        )


class _SolverClock:
    """Times our solver when it is called, and keeps the result."""

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet
        self.bench: SolverBench | None = None

    def __call__(self, split: str, size: str) -> float | None:
        """Return the time of a frame [s]; None where the solver cannot run."""
        warning = None if self.quiet else "no speed-up over the solver"
        self.bench = try_bench(split, size, warning=warning)
        if self.bench is None:
            return None
        return self.bench.seconds_per_frame


def _describe_onnx(
    result: OnnxPredictionResult, *, solver: SolverBench | None
) -> Iterator[str]:
    scenarios = format_count(result.scenarios, "scenario")
    yield f"{result.path}: {result.method}, {scenarios}, {result.frames} frames"
    yield (
        f"  model   {result.seconds_per_frame:.3g} s per frame: processor time of one "
        "thread, mean over all predicted frames"
    )
    yield from _describe_solver(result.seconds_per_frame, solver)


def _describe(
    result: PredictionResult,
    *,
    solver: SolverBench | None,
    is_replaced: bool,
) -> Iterator[str]:
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
    yield f"          {_describe_clock(result)}"
    yield from _describe_solver(result.seconds_per_frame, solver)
    if result.diverged:
        marks = []
        for scenario, frame in result.diverged.items():
            marks.append(f"scenario {scenario} at frame {frame}")
        yield f"  frozen  {', '.join(marks)}: not finite from there on"


def _describe_solver(
    seconds_per_frame: float, solver: SolverBench | None
) -> Iterator[str]:
    """Yield the time of our solver, and how much faster one of both is."""
    if solver is None:
        return
    ratio = seconds_per_frame / solver.seconds_per_frame
    yield (
        f"  solver  {solver.seconds_per_frame:.3g} s per frame on one core of this "
        f"machine: {_compare_speeds(ratio)}"
    )


def _compare_speeds(ratio: float) -> str:
    """Return how fast the solver is, from the time of the model over its own.

    >>> for ratio in (4.0, 0.25, 1.04):
    ...     print(_compare_speeds(ratio))
    4 times as fast as the model
    the model is 4 times as fast
    as fast as the model
    """
    slowdown = _format_ratio(ratio)
    speed_up = _format_ratio(1 / ratio)
    if "1" in (slowdown, speed_up):
        return "as fast as the model"
    if ratio > 1:
        return f"{slowdown} times as fast as the model"
    return f"the model is {speed_up} times as fast"


def _describe_clock(result: PredictionResult) -> str:
    """Return which clock took the time of a model, and what else the machine did."""
    wall = f"{result.wall_seconds_per_frame:.3g} s on the wall"
    if result.clock == "wall":
        return wall
    threads = format_count(result.threads, "thread")
    return f"processor time of {threads}; {wall}"


def _next_command(path: Path, split: str | None, root: str | Path | None) -> str:
    """Return the line that says how to score the predictions."""
    options = ""
    if split is not None and split not in load().splits:
        options = f" --split {shlex.quote(split)}"
    elif root:
        options = f" --root {quote_root(root)}"
    return f"next: lagbench score {shlex.quote(str(path))}{options}"


def _format_ratio(ratio: float) -> str:
    """Return a ratio with two digits, or as a whole number.

    >>> _format_ratio(1.234), _format_ratio(463.2)
    ('1.2', '463')
    """
    if ratio < 10:
        return f"{ratio:.2g}"
    return f"{ratio:.0f}"
