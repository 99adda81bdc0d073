"""Check a stranger's file of weights in a child process with limits.

The child reads the file and builds the model: its options may ask for more memory than
there is, or for years of work. What passes here can be loaded in this process.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lagbench.errors import LagbenchError, UnreadableFileError
from lagbench.work.machine import run_in_child

from .checkpoint import load, restore
from .recipe_changes import find_refusal, list_effective_settings

SECONDS = 20.0  # processor time of reading and building, without imports [s]
WALL_SECONDS = 600.0
"""Time of the clock, with the imports [s]; only a child that waits gets that far.

What computes too long is stopped by its limit of processor time. On a machine that is
busy with other work the import of torch alone may take minutes.
"""
MEMORY = 8 << 30
"""Address space of the child [bytes]; importing torch for the CPU takes 1 GB of it, for
CUDA several.
"""


def examine(path: str) -> dict[str, Any]:
    """Return why weights are refused, None where they can be used.

    It is run in a child process.
    """
    try:
        checkpoint = load(path)
        restore(checkpoint, where=path)
    except LagbenchError as error:
        parts = [error.what, error.got]
        words = [str(part) for part in parts if part is not None]
        return {"refused": ": ".join(words)[:300], "fix": error.fix}
    # options and statistics of a stranger may break a model in any way
    except Exception as error:
        reason = " ".join(str(error).split())
        return {"refused": f"{type(error).__name__}: {reason}"[:300], "fix": None}
    return {"refused": None, "fix": None}


def check_in_child(path: Path) -> None:
    """Read weights and build their model in a child process.

    Raises:
        UnreadableFileError: the file or its recipe cannot be used, or needs too much
            memory or time.
        WorkFailedError: the machine is too busy.
    """
    answers = run_in_child(
        f"{__name__}.{examine.__name__}",
        [str(path.absolute())],
        seconds=SECONDS,
        wall=WALL_SECONDS,
        memory=MEMORY,
    )
    answers.require_in_time(str(path))
    reason = answers.stopped
    fix = None
    if answers.values:
        reason = answers.values[0]["refused"]
        fix = answers.values[0]["fix"]
    if reason is not None:
        raise UnreadableFileError(
            "the weights are refused",
            where=str(path),
            expected="weights of a registered architecture with their recipe",
            got=reason,
            fix=fix or "write them with lagbench.models.registered.export_safetensors",
        )


def check_settings(request: Sequence[str]) -> dict[str, Any]:
    """Return how the model of some weights takes the settings of a prediction.

    ``effective`` are those that change the model, in one form and order; ``refused`` is
    why the model does not take them, None if it does. Where the weights cannot be read,
    or their model is not installed, the settings are returned as they are written.

    Weights of strangers are for :func:`check_settings_in_child`.

    Args:
        request: path of the weights, then the settings.
    """
    path, *settings = request
    try:
        checkpoint = load(path)
        refused = find_refusal(checkpoint.baseline, checkpoint.options, settings)
        effective = list_effective_settings(
            checkpoint.baseline, checkpoint.options, settings
        )
    except Exception:  # options of a stranger may break a model in any way
        return _as_written(settings)
    return {"effective": list(effective), "refused": refused}


def check_settings_in_child(
    requests: Sequence[Sequence[str]],
) -> list[dict[str, Any]]:
    """Return what `check_settings` returns for each request.

    One child process reads all files. Its processor time is :data:`SECONDS` times the
    number of requests. Where it is stopped, the settings of the file that stopped it,
    and of those after it, are returned as they are written.

    Raises:
        WorkFailedError: the machine is too busy.
    """
    answers = run_in_child(
        f"{__name__}.{check_settings.__name__}",
        requests,
        seconds=SECONDS * max(1, len(requests)),
        wall=WALL_SECONDS * max(1, len(requests)),
        memory=MEMORY,
    )
    checked = list(answers.values)
    if len(checked) < len(requests):
        stopping_path = requests[len(checked)][0]
        answers.require_in_time(stopping_path)
    for request in requests[len(checked) :]:
        checked.append(_as_written(request[1:]))
    return checked


def _as_written(settings: Sequence[str]) -> dict[str, Any]:
    return {"effective": sorted(set(settings)), "refused": None}
