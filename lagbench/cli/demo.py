"""The command demo: the commands that lead from nothing to a leaderboard's page."""

from __future__ import annotations

import importlib.util
import shlex
from collections.abc import Iterator
from pathlib import Path

from .options import WorkersOption
from .output import print_line

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
MODEL_SPLIT = "cavity"
MODEL = "neuralmpm"

STEPS = 150
"""Steps of the training: half a minute. The model then beats the naive baselines."""

META = """\
name: NeuralMPM, trained for seconds
authors: [lagbench demo]
licence: MIT
notes: It shows the way, and says little of what such a model can do.
command: lagbench demo
"""


def demo_command(
    *, root: Path = Path("demo"), workers: WorkersOption = None
) -> int | None:
    """Make data sets, train a model, score it and draw a leaderboard page.

    It prints each command before it runs it. An interrupted call goes on where it
    stopped.

    Args:
        root: Folder of all that the demo makes.
    """
    from .program import build_program

    for folder in ("pictures", "runs"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    (root / "runs" / "meta.yaml").write_text(META)
    for line in _command_lines(shlex.quote(str(root)), workers):
        print_line(f"\n$ lagbench {line}")
        exit_code: int | None = build_program()(shlex.split(line))
        if exit_code:
            return exit_code
    return None


def _command_lines(root: str, workers: int | None) -> Iterator[str]:
    """Yield the words of each command; a model is trained where torch is installed."""
    share = "" if workers is None else f" --workers {workers}"
    for split in SPLITS:
        data = f"{split} --size tiny --root {root}"
        yield f"generate {data}{share}"
        yield f"verify {data} --complete"
        yield f"plot {data} -o {root}/pictures/{split}.png --overwrite"
    if importlib.util.find_spec("torch") is None:
        return

    run = f"{root}/runs/{MODEL_SPLIT}-{MODEL}"
    predictions = f"{run}/predictions.nc --root {root}"
    board = f"--board {root}/leaderboard"
    # So small a model gains nothing by a second thread. With one thread the same
    # machine trains the same weights.
    device = "--device cpu --threads 1"
    yield (
        f"train {MODEL_SPLIT} --baseline {MODEL} --size tiny --root {root} -o {run} "
        f"--set training.steps={STEPS} {device}"
    )
    yield (
        f"predict {run}/weights.safetensors -o {predictions} --overwrite "
        f"--method {MODEL} {device}"
    )
    yield f"score {predictions}"
    yield (
        f"submit {predictions} --from {root}/runs/meta.yaml {board} --new-board "
        "--replace"
    )
    yield f"leaderboard build {board}"
