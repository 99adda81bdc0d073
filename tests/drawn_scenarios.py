"""Recordings of made-up data sets of one scenario, without files."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lagbench.data.registry import load
from lagbench.data.scenario import ScenarioFile
from lagbench.figures.recording import Recording


def record(data: xr.Dataset) -> Recording:
    """Return the recording of a data set whose attributes name the scenario."""

    def read(name: str, frames: slice | int = slice(None)) -> NDArray[Any]:
        variable = data[name]
        if "frame" in variable.dims:
            variable = variable.isel(frame=frames)
        return np.asarray(variable)

    names = ("split", "size", "scenario")
    key = SimpleNamespace(**{name: data.attrs[name] for name in names})
    header = SimpleNamespace(key=key, parameters=data.attrs, frames=data.sizes["frame"])
    file = SimpleNamespace(header=header, variables=set(data.variables), read=read)
    return Recording(cast("ScenarioFile", file), load(), where="a made-up scenario")
