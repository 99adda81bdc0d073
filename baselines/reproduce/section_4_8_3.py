"""Section 4.8.3: VAR(1) on whole frames by the thesis's protocol: time, memory, divergence."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from lagbench.atomic import write_atomically
from lagbench.scoring.tables import Table

from .plan import Plan
from .sheet import Sheet
from .thesis import SECTION_4_8_3
from .wording import number

__all__ = ["FILE", "SPLIT", "beside", "measured"]

SPLIT = "fluid"
FILE = "var_protocol.json"
"""What ``python -m lagbench.baselines.reproduce.var_protocol --json`` prints."""


def measured(plan: Plan, name: str) -> Sheet:
    """Return time, memory and error of the fit and its forecast; measured once per size."""
    del name
    path = plan.home(SPLIT) / FILE
    if not path.is_file():
        from .var_protocol import measure

        found = asdict(measure(SPLIT, plan.size, root=plan.root))
        write_atomically(path, json.dumps(found, indent=1, sort_keys=True).encode())
    return beside(json.loads(path.read_text(encoding="utf-8")))


def beside(held: Mapping[str, Any]) -> Sheet:
    """Return what the protocol measured beside the thesis's figures."""
    ours = {
        "minutes": held["fit_seconds"] / 60.0,
        "gigabytes": held["peak_gb"],
        "mse": held["forecast_mse"],
    }
    rows = [(what, number(SECTION_4_8_3[what]), number(value)) for what, value in ours.items()]
    more = ("features", "frames", "cpu_seconds", "condition", "fit_mse", "growth", "persistence_mse")
    rows += [(what, "-", number(float(held[what]), 6)) for what in more]
    answer = "diverges" if held["growth"] > 1.0 else "does not diverge"
    note = (
        f"VAR of {held['features']} dimensions on {held['split']} {held['size']} by the thesis's protocol:"
        f" all frames concatenated, the first 70 % fitted, the next {held['forecast_frames']} forecast."
        f" The forecast {answer}: at its end it grows by a factor of {number(held['growth'], 5)} per frame."
    )
    return Sheet(notes=(note,), tables=(Table("", ("", "thesis", "ours"), tuple(rows)),))
