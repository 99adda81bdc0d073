"""The command predict."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lagbench.data.layout import quote_root
from lagbench.data.registry import load
from lagbench.errors import LagbenchError, UsageError, check_regular, format_count
from lagbench.work.machine import available_cores

from .model_options import (
    PREDICTION_LIBRARIES,
    DeviceOption,
    ThreadsOption,
    require_libraries,
)
from .options import JsonFlag, OverwriteFlag, QuietFlag, RootOption, option
from .output import print_result, print_warning
from .progress import progress_bar
from .solver_bench import SolverBench, bench_apart

if TYPE_CHECKING:
    from lagbench.baselines.predict import PredictionResult

WeightsArgument = Annotated[
    Path,
    typer.Argument(
        metavar="FILE", help="A trained model: weights.pt, safetensors or ONNX."
    ),
]
PredictionsOption = Annotated[Path, option("--output -o FILE", "File to write.")]
OnnxSplitOption = Annotated[
    str | None,
    option(
        "--split NAME",
        "Split to predict; only for an ONNX file, which does not state it.",
    ),
]
PredictedSizeOption = Annotated[
    str | None,
    option("--size NAME", "Size to predict; by default that of the training."),
]
SubsetOption = Annotated[
    str, option("--subset NAME", "test, or shift, which lies outside train.")
]
ModelChangesOption = Annotated[
    list[str] | None,
    option(
        "--set KEY=VALUE",
        "Change the model, as in model.average=true; repeatable.",
    ),
]
BatchOption = Annotated[
    int | None,
    option(
        "--batch N",
        "Scenarios to predict together; by default 1 on a CPU, all on a GPU.",
        min=1,
    ),
]
MethodOption = Annotated[
    str | None, option("--method NAME", "Name of the method on a leaderboard.")
]
BenchFlag = Annotated[
    bool, option("--bench/--no-bench", "Time our solver too, for the speed-up.")
]


def predict_command(
    checkpoint: WeightsArgument,
    output: PredictionsOption = Path("predictions.nc"),
    overwrite: OverwriteFlag = False,
    split: OnnxSplitOption = None,
    size: PredictedSizeOption = None,
    subset: SubsetOption = "test",
    settings: ModelChangesOption = None,
    root: RootOption = None,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    batch: BatchOption = None,
    method: MethodOption = None,
    bench: BenchFlag = True,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Predict the test scenarios with a trained model.

    The predictions go into a predictions.nc.
    """
    if checkpoint.suffix == ".onnx":
        _predict_onnx(
            checkpoint,
            output,
            overwrite=overwrite,
            split=split,
            size=size,
            method=method,
            root=root,
            as_json=as_json,
            quiet=quiet,
        )
        return
    if split is not None:
        raise UsageError(
            "weights state their split themselves",
            where="--split",
            expected="no such option, as the model is no ONNX file",
            got=split,
            fix="leave it out; --size chooses another size",
        )
    require_libraries(PREDICTION_LIBRARIES)
    from lagbench.baselines.predict import predict

    is_replaced = output.is_file()
    solver: SolverBench | None = None

    def time_solver(split: str, size: str) -> float | None:
        nonlocal solver
        solver = _bench_solver(split, size, quiet=quiet)
        if solver is None:
            return None
        return solver.seconds_per_frame

    with progress_bar(quiet=quiet) as progress:
        result = predict(
            checkpoint,
            output,
            overwrite=overwrite,
            root=root,
            size=size,
            subset=subset,
            settings=tuple(settings or ()),
            device=device,
            threads=threads,
            batch=batch,
            method=method,
            time_solver=time_solver if bench else None,
            progress=progress,
        )
    lines = _describe(result, solver=solver, is_replaced=is_replaced, root=root)
    value = {**vars(result), "solver": solver}
    print_result(value, lines, as_json=as_json, quiet=quiet)


def _predict_onnx(
    model: Path,
    output: Path,
    *,
    overwrite: bool,
    split: str | None,
    size: str | None,
    method: str | None,
    root: Path | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Predict with an ONNX file, which does not state its split."""
    from lagbench.models.predict_onnx import predict_onnx

    check_regular(model)
    if split is None:
        raise UsageError(
            "an ONNX file does not state its split",
            where="--split",
            expected="the split that the model predicts",
            got="nothing",
            fix="name it: --split cavity --size mini",
        )
    with progress_bar(quiet=quiet) as progress:
        result = predict_onnx(
            model,
            output,
            overwrite=overwrite,
            split=split,
            size=size,
            method=method,
            root=root,
            progress=progress,
        )
    lines = [
        f"{result.path}: {result.method}, {result.scenarios} scenarios, "
        f"{result.frames} frames",
        f"  model   {result.seconds_per_frame:.3g} s per frame: processor time of one "
        "thread, mean over all predicted frames",
        _next_command(result.path, root),
    ]
    print_result(result, lines, as_json=as_json, quiet=quiet)


def _bench_solver(split: str, size: str, *, quiet: bool) -> SolverBench | None:
    """Return the cost of our solver on this machine.

    None stands for local splits, and for machines where the solver cannot run, with a
    warning.
    """
    if split not in load().splits:
        return None
    try:
        return bench_apart(split, size)
    except LagbenchError as error:
        if not quiet:
            print_warning(f"no speed-up over the solver: {error}")
        return None


def _describe(
    result: PredictionResult,
    *,
    solver: SolverBench | None,
    is_replaced: bool,
    root: Path | None,
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
    yield (
        f"  model   {result.seconds_per_frame:.3g} s per frame "
        f"({result.seconds_without_search:.3g} s without the neighbour search) "
        f"on {result.device}"
    )
    yield f"          {_describe_clock(result)}"
    if solver is not None:
        yield (
            f"  solver  {solver.seconds_per_frame:.3g} s per frame on one core of this "
            f"machine: {_compare_speed(result, solver)}"
        )
    if result.diverged:
        marks = []
        for scenario, frame in result.diverged.items():
            marks.append(f"scenario {scenario} at frame {frame}")
        yield f"  frozen  {', '.join(marks)}: not finite from there on"
    yield _next_command(result.path, root)


def _describe_clock(result: PredictionResult) -> str:
    """Return which clock took the time of a model, and what else the machine did."""
    wall = f"{result.wall_seconds_per_frame:.3g} s on the wall"
    if result.load is not None:
        wall += f", with a load of {result.load:.1f} on {available_cores()} cores"
    if result.clock == "wall":
        return wall
    threads = format_count(result.threads, "thread")
    return f"processor time of {threads}; {wall}"


def _next_command(path: Path, root: Path | None) -> str:
    """Return the line that says how to score the predictions."""
    root_option = ""
    if root:
        root_option = f" --root {quote_root(root)}"
    return f"next: lagbench score {shlex.quote(str(path))}{root_option}"


def _compare_speed(result: PredictionResult, solver: SolverBench) -> str:
    ratio = result.seconds_per_frame / solver.seconds_per_frame
    if ratio > 1:
        return f"{_format_ratio(ratio)} times as fast as the model"
    return f"the model is {_format_ratio(1 / ratio)} times as fast"


def _format_ratio(ratio: float) -> str:
    """Return a ratio with two digits, or as a whole number.

    >>> _format_ratio(1.234), _format_ratio(463.2)
    ('1.2', '463')
    """
    if ratio < 10:
        return f"{ratio:.2g}"
    return f"{ratio:.0f}"
