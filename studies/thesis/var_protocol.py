"""VAR(1) by the thesis's own protocol (section 4.8.3, Listing 4.1).

    python -m studies.thesis.var_protocol [--split fluid] [--size full]
        [--root FOLDER] [--lags 1] [--json]

All frames of all scenarios, in the order of their ids, are standardised per feature,
flattened and concatenated. The first 70 % are fitted; the next 15 % are forecast from
the last frame of training. So frames of test scenarios enter the fit, and a forecast
runs across the starts of scenarios, which it cannot know. The protocol is a check of
the thesis's figures, not a benchmark. The benchmark's own way is ``lagbench train
--baseline var``.
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

from .formatting import number
from .items import Sheet, ThesisItem
from .plan import Plan
from .published import SECTION_4_8_3

TRAIN = 0.70  # share of the frames that are fitted
VALID = 0.15  # share of the frames that are forecast

# output of ``--json``, in a folder of runs or of other results
FILE_NAME = "var_protocol.json"

REPORTED_FRAMES = (1, 10, 100, 1000)
OVERFLOW = 1e150  # norm of a state at which a forecast ends

States = NDArray[np.float32]
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ProtocolResult:
    """Time, memory and errors of the fit and of its forecast."""

    split: str
    size: str
    features: int  # dimensions of the VAR
    frames: int  # frames fitted
    fit_seconds: float  # wall time of the fit [s]
    cpu_seconds: float  # CPU time of the fit, all threads [s]
    peak_gb: float  # largest resident memory of the process [GB]
    condition: float  # condition number of the regressors
    # share of the largest eigenvalue that was added to the Gram matrix
    floor: float
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
    # error of the last frame of training, taken for all later ones [standardised^2]
    persistence_mse: float


def measure(
    split: str = "fluid",
    size: str = "full",
    *,
    root: str | Path | None = None,
    lags: int = 1,
) -> ProtocolResult:
    """Fit a VAR with a number of lags and forecast by the thesis's protocol."""
    # it loads torch, which pages of results do without
    from lagbench.baselines.var import LaggedRows, solve

    states = read_states(split, size, root=root)
    train = int(TRAIN * len(states))
    valid = states[train : train + int(VALID * len(states))]

    rows = LaggedRows([states[:train]], lags=lags)
    wall_start = time.perf_counter()
    cpu_start = time.process_time()
    fit = solve(rows)
    fit_seconds = time.perf_counter() - wall_start
    cpu_seconds = time.process_time() - cpu_start
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    squared_errors = math.fsum(
        np.square(target - regressors @ fit.coefficients).sum()
        for regressors, target in rows
    )
    feature_count = len(fit.coefficients[0])
    last_states = states[train - lags : train]
    errors, growth = forecast_errors(fit.coefficients, last_states, valid)
    mse_at = {}
    for frame in REPORTED_FRAMES:
        if frame <= len(errors):
            mse_at[frame] = float(errors[frame - 1])
    persistence_errors = np.square(valid - states[train - 1], dtype=np.float64)
    return ProtocolResult(
        split=split,
        size=size,
        features=states.shape[1],
        frames=train,
        fit_seconds=fit_seconds,
        cpu_seconds=cpu_seconds,
        peak_gb=peak_kib * 1024 / 1e9,
        condition=fit.condition,
        floor=fit.floor,
        fit_mse=float(squared_errors / (rows.rows * feature_count)),
        forecast_frames=len(valid),
        forecast_mse=float(errors.mean()),
        mse_at=mse_at,
        growth=growth,
        persistence_mse=float(persistence_errors.mean()),
    )


def read_states(split: str, size: str, *, root: str | Path | None) -> States:
    """Return the standardised states of all scenarios, shape [frame, feature].

    A state has the positions and the solver's velocities of all particles.
    """
    from lagbench.baselines.rollout import scenario_paths

    paths: dict[int, Path] = {}
    for subset in ("train", "valid", "test"):
        paths |= scenario_paths(split, subset=subset, size=size, root=root)
    tier = load().size(split, size)
    frame_count = sum(map(tier.frame_count, paths))
    frames = np.empty((frame_count, tier.particles, 4), np.float32)
    start = 0
    for scenario in sorted(paths):
        with read_scenario(paths[scenario]) as file:
            blocks = zip(file.blocks("position"), file.blocks("velocity"), strict=True)
            for position, velocity in blocks:
                end = start + len(position)
                frames[start:end] = np.concatenate([position, velocity], axis=-1)
                start = end
    for feature in np.moveaxis(frames, -1, 0):
        feature -= feature.mean(dtype=np.float64)
        feature /= feature.std(dtype=np.float64)
    return frames.reshape(frame_count, -1)


def forecast_errors(
    coefficients: Floats, last: States, truth: States
) -> tuple[Floats, float]:
    """Forecast; return the mean squared error of each frame and the final growth.

    Args:
        coefficients: as :class:`~lagbench.baselines.var.VAR` lays them out.
        last: the states before the forecast, the latest last, shape [lag, feature].
        truth: the states to compare with, shape [frame, feature].

    Returns:
        Errors, shape [frame], infinite once the forecast overflows; and the factor by
        which a state grows per frame at the end of the forecast, NaN for a forecast of
        one frame.
    """
    history = list(last[::-1].astype(np.float64))
    errors = np.full(len(truth), np.inf)
    norms = np.full(len(truth), np.nan)
    transposed = coefficients.T
    if not coefficients.flags.f_contiguous:
        transposed = np.ascontiguousarray(coefficients.T)
    for frame, true_state in enumerate(truth):
        state = transposed @ np.concatenate([[1.0], *history])
        history = [state, *history[:-1]]
        with np.errstate(over="ignore", invalid="ignore"):
            norms[frame] = np.linalg.norm(state)
        if not np.isfinite(norms[frame]) or norms[frame] > OVERFLOW:
            break
        errors[frame] = np.square(state - true_state).mean()
    return errors, _final_growth(norms[np.isfinite(norms)])


def _final_growth(norms: Floats) -> float:
    """Return the factor per frame over the last hundred norms; NaN for a single one."""
    span = min(100, len(norms) - 1)
    if span <= 0:
        return math.nan
    return float((norms[-1] / norms[-1 - span]) ** (1 / span))


def draw(plan: Plan, item: ThesisItem) -> Sheet:
    """Return time, memory and errors of the protocol; they are measured once."""
    path = plan.home(item.split) / FILE_NAME
    if not path.is_file():
        result = asdict(measure(item.split, plan.size, root=plan.root))
        content = json.dumps(result, indent=1, sort_keys=True)
        write_atomically(path, content.encode())
    return beside_thesis(json.loads(path.read_text(encoding="utf-8")))


def beside_thesis(result: Mapping[str, Any]) -> Sheet:
    """Return a measured result beside the thesis's figures."""
    thesis = SECTION_4_8_3
    unit = "[standardised^2]"
    # quantity, thesis, ours
    rows: list[tuple[str, float | None, float]] = [
        ("time of the fit [min]", thesis["minutes"], result["fit_seconds"] / 60.0),
        ("processor time of the fit [s]", None, result["cpu_seconds"]),
        (
            "memory, thesis: virtual, ours: largest resident [GB]",
            thesis["gigabytes"],
            result["peak_gb"],
        ),
        ("frames fitted", None, result["frames"]),
        ("condition number of the regressors", None, result["condition"]),
        (
            "share of its largest eigenvalue that was added to the Gram matrix",
            None,
            result["floor"],
        ),
        (
            f"squared error of one step, over the frames fitted {unit}",
            None,
            result["fit_mse"],
        ),
        (
            f"squared error of the forecast {unit}",
            thesis["mse"],
            result["forecast_mse"],
        ),
        (
            f"squared error of standing still after those frames {unit}",
            None,
            result["persistence_mse"],
        ),
        (
            "factor by which the forecast grows per frame at its end",
            None,
            result["growth"],
        ),
    ]
    mse_at = {int(frame): value for frame, value in result["mse_at"].items()}
    for frame in sorted(mse_at):
        quantity = f"squared error in frame {frame} of the forecast {unit}"
        rows.append((quantity, None, mse_at[frame]))

    cells = []
    for quantity, thesis_value, our_value in rows:
        our_cell = number(our_value, 5)
        if isinstance(our_value, int):
            our_cell = f"{our_value:,}"
        cells.append((quantity, number(thesis_value), our_cell))

    growth = result["growth"]
    is_divergent = growth > 1.0 or math.isinf(result["forecast_mse"])
    verdict = "diverges" if is_divergent else "does not diverge"
    # A forecast that overflows in its first frame has no growth.
    if not math.isnan(growth):
        factor = number(growth, 5)
        verdict += f": at its end it grows by a factor of {factor} per frame"
    note = (
        f"VAR of {result['features']} dimensions on {result['split']} "
        f"{result['size']} by the thesis's protocol: all frames are concatenated, the "
        f"first 70 % are fitted, the next 15 %, {result['forecast_frames']} frames, "
        f"are forecast. The forecast {verdict}."
    )
    table = Table("", ("", "thesis", "ours"), tuple(cells))
    return Sheet(notes=(note,), tables=(table,))


def result_markdown(result: ProtocolResult) -> str:
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
    options = parser.parse_args()
    result = measure(options.split, options.size, root=options.root, lags=options.lags)
    if options.json:
        sys.stdout.write(json.dumps(asdict(result), indent=1) + "\n")
    else:
        sys.stdout.write(result_markdown(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
