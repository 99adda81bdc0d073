"""The command train."""

from __future__ import annotations

import os
import shlex
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.types import NonNegativeInt

from lagbench.data.local import locate
from lagbench.errors import LagbenchError, format_count
from lagbench.scoring.scorability import check_scorability
from lagbench.submission.budget import EQUAL_MINUTES

from .model_options import data_option, require_libraries
from .options import (
    DeviceOption,
    JsonFlag,
    OutputOption,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    ThreadsOption,
)
from .output import format_seconds, print_result, print_warning, progress_bar

if TYPE_CHECKING:
    from lagbench.baselines.train import TrainingResult

SECONDS_PER_LINE = 10.0  # time between two lines of progress that go to a file [s]


def train_command(
    split: str,
    *,
    baseline: str,
    size: PresentSizeOption = None,
    recipe: str | None = None,
    settings: Annotated[list[str] | None, Parameter(name="--set")] = None,
    seed: NonNegativeInt | None = None,
    start: Path | None = None,
    root: RootOption = None,
    output: OutputOption = None,
    fresh: bool = False,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Train a reference model.

    An interrupted call goes on where it stopped. Only a fit (VAR) begins anew.

    Args:
        split: Name of the split, or folder of a local one.
        baseline: Reference model, as in gns; see docs/baselines.md.
        recipe: Variant of the recipe, as in short; or a YAML file.
        settings: Change the recipe, as in training.steps=100; repeatable.
        seed: Seed of all random numbers.
        start: Weights to start from; they may be of another size.
        output: Folder of the run; by default in runs/, named after recipe, baseline and
            seed.
        fresh: Start anew and replace an earlier training.
    """
    require_libraries()
    # Torch takes seconds to load, so the data are looked for before. Of several
    # processes only the first does it, for an error to be printed once.
    if "LOCAL_RANK" not in os.environ:
        locate(split, size, root=root)

    changes = tuple(settings or ())
    with progress_bar(quiet=quiet):
        from lagbench.baselines.machine import is_helper
        from lagbench.baselines.train import train

    is_helper_process = is_helper()
    if is_helper_process:
        quiet = True
        as_json = False
    else:
        _warn_of_scorability(
            split, size, root=root, baseline=baseline, recipe=recipe, changes=changes
        )
    with (
        _errors_of_one_process(is_helper=is_helper_process),
        progress_bar(
            quiet=quiet, unit="steps", seconds_per_line=SECONDS_PER_LINE
        ) as progress,
    ):
        result = train(
            baseline,
            split,
            size,
            recipe=recipe,
            settings=changes,
            seed=seed,
            start=start,
            root=root,
            output=output,
            fresh=fresh,
            device=device,
            threads=threads,
            progress=progress,
        )
    lines = _describe(result, data_option(split, root))
    print_result(result, lines, as_json=as_json, quiet=quiet)


def _warn_of_scorability(
    split: str,
    size: str | None,
    *,
    root: str | Path | None,
    baseline: str,
    recipe: str | None,
    changes: tuple[str, ...],
) -> None:
    """Warn before the training where a user's own data cannot be scored."""
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.recipe import recipe_for

    tier, folder, _ = locate(split, size, root=root)
    if tier.simulated:
        return
    entry = find(baseline)
    plan = recipe_for(entry, tier.split, tier.name, variant=recipe, settings=changes)
    is_validated = plan.training.validate_every != 0
    reasons = list(check_scorability(tier, folder, validated=is_validated))
    if reasons:
        warning = "predictions of this model cannot be scored as they should"
        print_warning("\n  ".join([warning, *reasons]))


@contextmanager
def _errors_of_one_process(*, is_helper: bool) -> Iterator[None]:
    """Let one process of each machine print an error that all processes raise.

    An interruption is printed by the very first process only.
    """
    try:
        yield
    except KeyboardInterrupt:
        if is_helper:
            raise SystemExit(128 + signal.SIGINT) from None
        raise
    except LagbenchError as error:
        is_first_of_machine = os.environ.get("LOCAL_RANK", "0") == "0"
        # An error with a cause, as where memory is full, befell this process only.
        if is_first_of_machine or error.__cause__ is not None:
            raise
        raise SystemExit(error.exit_code) from error


def _describe(result: TrainingResult, data_option: str) -> Iterator[str]:
    time = (
        f"{format_seconds(result.wall_seconds)}, {format_seconds(result.cpu_seconds)} "
        "of processor time"
    )
    if result.gpu_seconds:
        time += f", {format_seconds(result.gpu_seconds)} of GPU time"
    if result.first_step == result.step:
        time += "; the training was over before, --fresh trains anew"
    elif result.first_step:
        time += f"; this call went on from step {result.first_step}"
    yield (
        f"{result.baseline} on {result.recipe}: {result.state}, "
        f"step {result.step} of {result.steps}, {time}"
    )
    if result.start:
        yield (
            f"  started    from {result.start}; "
            "hours and track count the training of these weights too"
        )
    yield f"  parameters {result.parameters}"
    # the sum of a loss's terms last
    terms = sorted(result.loss, key=lambda term: (term == "total", term))
    values = ", ".join(f"{term} {result.loss[term]:.4g}" for term in terms)
    yield f"  {'fit ' if result.is_fitted else 'loss'}       {values}"
    if result.best_value is not None:
        best = f"{result.best_value:.4g} on valid, step {result.best_step}"
        if result.best_step == 0:
            best += ": nothing better than the weights that it started from"
        yield f"  best       {result.metric} {best}"
    validation_share = result.validation_cpu_seconds / (result.cpu_seconds or 1.0)
    minutes = EQUAL_MINUTES.get(result.size)
    track = f"track: {result.track}"
    if result.track is None:
        track = "no track: it has not converged"
        if minutes is not None:
            track += f", nor is it equal compute ({minutes:.0f} min without a GPU)"
    yield (
        f"  budget     {result.windows_seen or 0:,} windows, {result.epochs:.3g} "
        f"epochs; {validation_share:.0%} of the processor time for validations; "
        f"{result.device}, {format_count(result.threads, 'thread')}; {track}"
    )
    yield f"  weights    {result.weights}"
    if result.size == "tiny":
        yield "hint: tiny is for tests: it is too small to learn from"
    weights = shlex.quote(str(result.weights))
    yield f"next: lagbench predict {weights}{data_option} -o predictions.nc"
