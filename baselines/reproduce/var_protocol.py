"""VAR(1) by the thesis's own protocol (section 4.8.3, Listing 4.1), timed and weighed.

    python -m lagbench.baselines.reproduce.var_protocol [--split fluid] [--size full]
        [--root FOLDER] [--lags 1] [--json]

All frames of all scenarios, in the order of their ids, are standardised per feature
over all frames, flattened and concatenated; the first 70 % are fitted, and the next 15
% forecast from the last frame of training. So frames of test scenarios enter, and a
forecast runs on across the starts of scenarios that it cannot know: as a benchmark it
says nothing, as a check of the thesis's figures it does. The benchmark's own way is
``lagbench train --baseline var``.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.figures.tables import Table

from .drawing import Figure, Sheet
from .plan import Plan
from .thesis import SECTION_4_8_3, number

TRAIN = 0.70
VALID = 0.15
"""Shares of the frames that are fitted and forecast."""

# what ``--json`` prints, in a folder of runs or of committed studies
FILE = "var_protocol.json"

States = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class ProtocolResult:
    """What the thesis states, and what explains it."""

    split: str
    size: str
    features: int  # dimensions of the VAR
    frames: int  # frames fitted
    fit_seconds: float  # wall time of the fit [s]
    cpu_seconds: float  # CPU time of the fit, all threads [s]
    peak_gb: float  # largest resident memory of the process [GB]
    condition: float  # condition number of the regressors
    floor: float  # as LeastSquares has it
    # mean squared error of one step over the frames fitted [standardised^2]
    fit_mse: float
    forecast_frames: int  # frames forecast
    # mean over them [standardised^2]; infinite once a forecast overflows
    forecast_mse: float
    # mean squared error of single frames of the forecast, by frame [standardised^2]
    mse_at: dict[int, float]
    # factor per frame by which the last frames of the forecast grow; above 1 it
    # diverges
    growth: float
    persistence_mse: float  # of the last frame of training, kept [standardised^2]


def measure(
    split: str = "fluid",
    size: str = "full",
    *,
    root: str | Path | None = None,
    lags: int = 1,
) -> ProtocolResult:
    """Fit a VAR of so many lags and forecast by the thesis's protocol."""
    # torch is loaded here, so that pages of results are written without it
    from lagbench.baselines.rollout import scenario_paths
    from lagbench.baselines.var import LaggedRows, solve

    paths: dict[int, Path] = {}
    for subset in ("train", "valid", "test"):
        paths |= scenario_paths(split, subset=subset, size=size, root=root)
    tier = load().size(split, size)
    frames = np.empty(
        (sum(map(tier.frame_count, paths)), tier.particles, 4), np.float32
    )
    filled = 0
    for _, path in sorted(paths.items()):
        with read_scenario(
            path
        ) as file:  # positions and the solver's velocities, block by block
            for position, velocity in zip(
                file.blocks("position"), file.blocks("velocity"), strict=True
            ):
                frames[filled : filled + len(position)] = np.concatenate(
                    [position, velocity], axis=-1
                )
                filled += len(position)
    for feature in np.moveaxis(frames, -1, 0):
        feature -= feature.mean(dtype=np.float64)
        feature /= feature.std(dtype=np.float64)
    states: States = frames.reshape(len(frames), -1)
    train = int(TRAIN * len(states))
    valid = states[train : train + int(VALID * len(states))]
    rows = LaggedRows([states[:train]], lags=lags)
    wall = time.perf_counter()
    cpu = time.process_time()
    found = solve(rows)
    wall = time.perf_counter() - wall
    cpu = time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    missed = math.fsum(np.square(y - x @ found.coefficients).sum() for x, y in rows)
    errors, growth = forecast_errors(
        found.coefficients, states[train - lags : train], valid
    )
    return ProtocolResult(
        split=split,
        size=size,
        features=states.shape[1],
        frames=train,
        fit_seconds=wall,
        cpu_seconds=cpu,
        peak_gb=peak,
        condition=found.condition,
        floor=found.floor,
        fit_mse=float(missed / (rows.rows * len(found.coefficients[0]))),
        forecast_frames=len(valid),
        forecast_mse=float(errors.mean()),
        mse_at={
            frame: float(errors[frame - 1])
            for frame in (1, 10, 100, 1000)
            if frame <= len(errors)
        },
        growth=growth,
        persistence_mse=float(
            np.square(valid - states[train - 1], dtype=np.float64).mean()
        ),
    )


def forecast_errors(
    coefficients: NDArray[np.float64], last: States, truth: States
) -> tuple[NDArray[np.float64], float]:
    """Forecast and return the mean squared error of each frame and the growth per frame
    at the end.

    Coefficients are as :class:`~lagbench.baselines.var.VAR` lays them out; ``last``,
    shape [lag, feature], are the states before the forecast, the latest last, and
    ``truth``, shape [frame, feature], those to compare with.
    """
    history = list(last[::-1].astype(np.float64))
    errors = np.full(len(truth), np.inf)
    norms = np.full(len(truth), np.nan)
    if coefficients.flags.f_contiguous:
        transposed = coefficients.T
    else:
        transposed = np.ascontiguousarray(coefficients.T)
    for frame, true in enumerate(truth):
        state = transposed @ np.concatenate([[1.0], *history])
        history = [state, *history[:-1]]
        norms[frame] = np.linalg.norm(state)
        if not np.isfinite(norms[frame]) or norms[frame] > 1e150:
            break
        errors[frame] = np.square(state - true).mean()
    grown = norms[np.isfinite(norms)]
    span = min(100, len(grown) - 1)
    return errors, float(
        (grown[-1] / grown[-1 - span]) ** (1 / span)
    ) if span > 0 else float("nan")


def draw(plan: Plan, figure: Figure) -> Sheet:
    """Return time, memory and error of the fit and its forecast; measured once per
    size.
    """
    path = plan.home(figure.split) / FILE
    if not path.is_file():
        found = asdict(measure(figure.split, plan.size, root=plan.root))
        write_atomically(path, json.dumps(found, indent=1, sort_keys=True).encode())
    return beside_thesis(json.loads(path.read_text(encoding="utf-8")))


def beside_thesis(held: Mapping[str, Any]) -> Sheet:
    """Return what was measured beside the thesis's figures."""
    thesis = SECTION_4_8_3
    unit = "[standardised^2]"
    rows: list[tuple[str, float | None, float]] = [
        ("time of the fit [min]", thesis["minutes"], held["fit_seconds"] / 60.0),
        ("processor time of the fit [s]", None, held["cpu_seconds"]),
        (
            "memory, thesis: virtual, ours: largest resident [GB]",
            thesis["gigabytes"],
            held["peak_gb"],
        ),
        ("frames fitted", None, held["frames"]),
        ("condition number of the regressors", None, held["condition"]),
        (
            "share of its largest eigenvalue that was added to the Gram matrix",
            None,
            held["floor"],
        ),
        (
            f"squared error of one step, over the frames fitted {unit}",
            None,
            held["fit_mse"],
        ),
        (f"squared error of the forecast {unit}", thesis["mse"], held["forecast_mse"]),
        (
            f"squared error of standing still after those frames {unit}",
            None,
            held["persistence_mse"],
        ),
        (
            "factor by which the forecast grows per frame at its end",
            None,
            held["growth"],
        ),
    ]
    at = sorted((int(frame), value) for frame, value in held["mse_at"].items())
    rows += [
        (f"squared error in frame {frame} of the forecast {unit}", None, value)
        for frame, value in at
    ]
    if held["growth"] > 1.0:
        answer = "diverges"
    else:
        answer = "does not diverge"
    note = (
        f"VAR of {held['features']} dimensions on {held['split']} {held['size']} by "
        f"the thesis's protocol:"
        f" all frames concatenated, the first 70 % fitted, the next 15 %, "
        f"{held['forecast_frames']} frames,"
        f" forecast. The forecast {answer}: at its end it grows by a factor of "
        f"{number(held['growth'], 5)}"
        " per frame."
    )
    cells = [
        (
            what,
            number(theirs),
            f"{ours:,}" if isinstance(ours, int) else number(ours, 5),
        )
        for what, theirs, ours in rows
    ]
    return Sheet(
        notes=(note,), tables=(Table("", ("", "thesis", "ours"), tuple(cells)),)
    )


def table(result: ProtocolResult) -> str:
    """Return the thesis's figures beside ours, as Markdown."""
    return beside_thesis(asdict(result)).text + "\n"


def main() -> int:
    """Measure what the arguments name and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--split", default="fluid")
    parser.add_argument("--size", default="full")
    parser.add_argument("--root", type=Path)
    parser.add_argument("--lags", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    result = measure(given.split, given.size, root=given.root, lags=given.lags)
    sys.stdout.write(
        json.dumps(asdict(result), indent=1) + "\n" if given.json else table(result)
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
