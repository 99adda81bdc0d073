"""Commands around reference models: train, predict, bench."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lagbench.errors import LagbenchError, UsageError

from .options import (
    JsonFlag,
    NewSizeOption,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    SplitArgument,
    SplitOption,
    chosen,
    option,
)
from .output import progress_bar, show, spell_seconds

if TYPE_CHECKING:
    from lagbench.baselines.predict import PredictionResult
    from lagbench.baselines.train import TrainingResult

    from .machine import SolverBench

EXTRA = "baselines"
DeviceOption = Annotated[str, option("--device NAME", "cpu, cuda, or auto.")]
ThreadsOption = Annotated[
    int | None,
    option(
        "--threads N",
        "CPU threads; else OMP_NUM_THREADS, else its share of the cores.",
        min=1,
    ),
]


def train(
    name: SplitArgument = None,
    baseline: Annotated[
        str | None,
        option("--baseline NAME", "Model, as in gns; see docs/baselines.md."),
    ] = None,
    split: SplitOption = None,
    size: PresentSizeOption = None,
    recipe: Annotated[
        str | None, option("--recipe NAME", "Variant, as in short; or a YAML file.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        option("--set KEY=VALUE", "Change the recipe: training.steps=100; repeatable."),
    ] = None,
    seed: Annotated[
        int | None, option("--seed N", "Seed of all chance.", min=0)
    ] = None,
    start: Annotated[
        Path | None,
        option("--start FILE", "weights.pt to start from; of another size perhaps."),
    ] = None,
    root: RootOption = None,
    output: Annotated[
        Path | None,
        option(
            "--output -o FOLDER",
            "By default in runs/, named after recipe, baseline and seed.",
        ),
    ] = None,
    resume: Annotated[
        bool, option("--resume/--no-resume", "Go on with what is there.")
    ] = True,
    fresh: Annotated[bool, option("--fresh", "Train anew whatever is there.")] = False,
    device: DeviceOption = "auto",
    processes: Annotated[
        int, option("--processes N", "Processes, one device each (DDP).", min=1)
    ] = 1,
    threads: ThreadsOption = None,
    workers: Annotated[
        int, option("--workers N", "Processes that read windows ahead.", min=0)
    ] = 0,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Train a reference model; goes on where an earlier call stopped."""
    from lagbench.errors import check_installed

    if baseline is None:
        raise UsageError(
            "no model is named",
            where="--baseline",
            fix="name one, as in --baseline gns",
        )
    if fresh and not resume:
        fix = "--fresh trains anew whatever is there; --no-resume leaves alone what is there"
        raise UsageError(
            "two options that exclude each other",
            where="--fresh and --no-resume",
            fix=fix,
        )
    split = chosen(name, split)
    for module in ("torch", "torch_geometric", "lightning_fabric"):
        check_installed(module, extra=EXTRA)
    from lagbench.data.local import locate

    if "LOCAL_RANK" not in os.environ:  # of several processes one tells an error
        # PyTorch takes seconds to load: what can be refused before, is
        locate(split, size, root=root)
    with progress_bar(quiet=quiet):
        from lagbench.baselines.machine import is_helper
        from lagbench.baselines.train import train as run

    quiet = quiet or is_helper()
    if not is_helper():
        _warn_of_scores(split, size, root, baseline, recipe, tuple(settings or ()))
    with _told_once(), progress_bar(quiet=quiet, counted="steps") as draw:
        result = run(
            baseline,
            split,
            size,
            recipe=recipe,
            settings=tuple(settings or ()),
            seed=seed,
            start=start,
            root=root,
            output=output,
            resume=resume,
            fresh=fresh,
            device=device,
            processes=processes,
            threads=threads,
            workers=workers,
            progress=draw,
        )
    as_json = as_json and not is_helper()
    show(result, _trained(result, _where(split, root)), as_json=as_json, quiet=quiet)


def _warn_of_scores(
    split: str,
    size: str | None,
    root: Path | None,
    baseline: str,
    variant: str | None,
    settings: tuple[str, ...],
) -> None:
    """Say on stderr why a user's own data cannot be scored, before a training is spent
    on them.
    """
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.recipe import recipe_for
    from lagbench.data.local import locate
    from lagbench.scoring.scorability import check_scorability

    tier, home, _ = locate(split, size, root=root)
    if tier.simulated:
        return
    plan = recipe_for(
        find(baseline), tier.split, tier.name, variant=variant, settings=settings
    )
    reasons = list(
        check_scorability(tier, home, validated=plan.training.validate_every != 0)
    )
    if reasons:
        warning = "warning: what is trained here cannot be scored as it should"
        typer.echo("\n  ".join([warning, *reasons]), err=True)


@contextmanager
def _told_once() -> Iterator[None]:
    """Let one process of each machine tell an error that befell all, and the first
    alone an interrupt.
    """
    from lagbench.baselines.machine import is_helper

    try:
        yield
    except KeyboardInterrupt:
        if is_helper():
            raise typer.Exit(128 + signal.SIGINT) from None
        raise
    except LagbenchError as error:
        # one with a cause, as where memory is full, befell this process only
        if os.environ.get("LOCAL_RANK", "0") != "0" and error.__cause__ is None:
            raise typer.Exit(error.exit_code) from error
        raise


def _where(split: str, root: Path | None) -> str:
    """Return the option that tells the next command where the data are."""
    from lagbench.data.local import locate_split
    from lagbench.data.registry import NO_GENERATOR

    found = locate_split(split, root=root)
    local = found.registry.split(found.name).generator == NO_GENERATOR
    if root or local:
        return f" --root {root or found.root}"
    return ""


def _trained(result: TrainingResult, where: str) -> Iterator[str]:
    time = f"{spell_seconds(result.wall_seconds)}, {spell_seconds(result.cpu_seconds)} of processor time"
    if result.gpu_seconds:
        time += f", {spell_seconds(result.gpu_seconds)} of GPU time"
    if result.first_step == result.step:
        time += "; it was over before, --fresh trains anew"
    elif result.first_step:
        time += f"; this call went on from step {result.first_step}"
    state = f"{result.state}, step {result.step} of {result.steps}"
    yield f"{result.baseline} on {result.recipe}: {state}, {time}"
    if result.start:
        yield f"  started    from {result.start}; hours and track count what they took"
    yield f"  parameters {result.parameters}"
    terms = sorted(result.loss, key=lambda name: (name == "total", name))
    yield "  loss       " + ", ".join(
        f"{name} {result.loss[name]:.4g}" for name in terms
    )
    if result.best_value is not None:
        if result.best_step == 0:
            worse = ": nothing better than the weights that it started from"
        else:
            worse = ""
        best = f"{result.best_value:.4g} on valid, step {result.best_step}{worse}"
        yield f"  best       {result.metric} {best}"
    share = result.validation_cpu_seconds / (result.cpu_seconds or 1.0)
    if result.windows_seen:
        seen = f"{result.windows_seen:,} windows, "
    else:
        seen = ""
    yield (
        f"  budget     {seen}{result.epochs:.3g} epochs; {share:.0%} of the processor "
        f"time for validations;"
        f" {result.device}, {result.threads} thread(s); track: {result.track or 'none'}"
    )
    yield f"  weights    {result.weights}"
    if result.size == "tiny":
        yield "hint: tiny is for tests: no model learns much from so little; try --size mini"
    yield f"next: lagbench predict {result.weights}{where} -o predictions.nc"


def predict(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="FILE", help="weights.pt or checkpoint.pt.")
    ],
    output: Annotated[Path, option("--output -o FILE", "File to write.")] = Path(
        "predictions.nc"
    ),
    size: Annotated[
        str | None, option("--size NAME", "Another size than that of the training.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        option("--set KEY=VALUE", "Change the model: model.average=true; repeatable."),
    ] = None,
    root: RootOption = None,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    batch: Annotated[
        int | None,
        option("--batch N", "Scenarios side by side; 1 on a CPU, all on a GPU.", min=1),
    ] = None,
    method: Annotated[
        str | None, option("--method NAME", "What the board shall call it.")
    ] = None,
    solver: Annotated[
        bool, option("--bench/--no-bench", "Time our solver too, for the speed-up.")
    ] = True,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Roll a trained model out over the test scenarios into a predictions.nc."""
    from lagbench.errors import check_installed

    for module in ("torch", "torch_geometric"):
        check_installed(module, extra=EXTRA)
    from lagbench.baselines.predict import predict as run

    timed: SolverBench | None = None
    replaced = output.is_file()

    def time_solver(split: str, size: str) -> float | None:
        nonlocal timed
        timed = _solver_time(split, size, quiet=quiet)
        if timed is None:
            return None
        return timed.seconds_per_frame

    with progress_bar(quiet=quiet) as draw:
        result = run(
            checkpoint,
            output,
            root=root,
            size=size,
            settings=tuple(settings or ()),
            device=device,
            threads=threads,
            batch=batch,
            method=method,
            time_solver=time_solver if solver else None,
            progress=draw,
        )
    told = _predicted(result, timed, replaced, f" --root {root}" if root else "")
    show({**vars(result), "solver": timed}, told, as_json=as_json, quiet=quiet)


def _solver_time(split: str, size: str, *, quiet: bool) -> SolverBench | None:
    """Return what the solver takes here; None for local splits, and where it cannot
    run: stderr says why.
    """
    from lagbench.data.registry import load

    from .machine import bench_apart

    if split not in load().splits:
        return None
    try:
        return bench_apart(split, size)
    except LagbenchError as error:
        if not quiet:
            typer.echo(f"warning: no speed-up over the solver: {error}", err=True)
        return None


def _predicted(
    result: PredictionResult, solver: SolverBench | None, replaced: bool, where: str
) -> Iterator[str]:
    if result.trained_size != result.size:
        trained = f", trained at {result.trained_size}"
    else:
        trained = ""
    trained += "".join(f", {setting}" for setting in result.settings)
    yield f"{result.path}: {result.method}{trained}, {result.scenarios} scenarios, {result.frames} frames"
    if replaced:
        yield "  in place of the predictions that were there"
    yield (
        f"  model   {result.seconds_per_frame:.3g} s per frame "
        f"({result.seconds_without_search:.3g} s"
        f" without the neighbour search) on {result.device}"
    )
    if solver is not None:
        ratio = result.seconds_per_frame / solver.seconds_per_frame
        slower = f"{ratio:.2g} times as fast as the model"
        faster = f"the model is {1 / ratio:.2g} times as fast"
        if ratio > 1:
            beside = slower
        else:
            beside = faster
        yield f"  solver  {solver.seconds_per_frame:.3g} s per frame on one core of this machine: {beside}"
    if result.diverged:
        marks = ", ".join(
            f"scenario {i} at frame {frame}" for i, frame in result.diverged.items()
        )
        yield f"  frozen  {marks}: not finite from there on"
    yield f"next: lagbench score {result.path}{where}"


def bench(
    what: Annotated[str, typer.Argument(metavar="WHAT", help="solver.")],
    split: SplitOption = None,
    size: NewSizeOption = None,
    frames: Annotated[int, option("--frames N", "Frames to time.", min=1)] = 20,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Time our solver on this machine: processor seconds per frame of one scenario on
    one core.
    """
    from lagbench.data.local import locate_new

    from .machine import bench_solver

    if what != "solver":
        fix = "lagbench bench solver"
        raise UsageError(
            f"nothing to time is called {what!r}", expected="solver", fix=fix
        )
    tier = locate_new(chosen(None, split), size).size
    if not tier.simulated:
        fix = "lagbench list names splits of ours"
        raise UsageError(
            "a local split cannot be simulated",
            where="--split",
            got=tier.split,
            fix=fix,
        )
    result = bench_solver(tier.split, tier.name, frames=frames)
    told = (
        f"{result.split} {result.size}: {result.seconds_per_frame:.3g} s per frame of "
        f"{result.particles}"
        f" particles, {result.substeps} substeps, on one core"
    )
    show(result, [told], as_json=as_json, quiet=quiet)
