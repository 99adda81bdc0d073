"""The content hash of docs/format.md with h5py and hashlib alone, sharing nothing with
lagbench.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np


def dumps(value: Any) -> bytes:
    """Return canonical JSON."""
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False
    ).encode()


def attribute(value: Any) -> Any:
    """Return an attribute as a plain string, integer or float."""
    value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
    value = value.decode() if isinstance(value, bytes) else value
    return value + 0.0 if isinstance(value, float) else value


def variable_hash(name: str, data: Any) -> str:
    """Return the hash of header, newline and canonical values."""
    text = data.dtype.kind == "O"
    dims = [name] if data.is_scale else [dim[0].name.lstrip("/") for dim in data.dims]
    dtype = "string" if text else data.dtype.newbyteorder("=").name
    values = data.asstr()[()] if text else data[()].astype(data.dtype.newbyteorder("<"))
    if data.dtype.kind == "f":
        values = np.where(
            np.isnan(values),
            np.array(np.nan, values.dtype),
            np.where(values == 0, 0, values),
        )
    payload = (
        "\0".join(values).encode()
        if text
        else values.astype(data.dtype.newbyteorder("<")).tobytes()
    )
    header = dumps(
        {"name": name, "dtype": dtype, "dims": dims, "shape": list(data.shape)}
    )
    return hashlib.sha256(header + b"\n" + payload).hexdigest()


def content_hash(path: Path) -> str:
    """Return the content hash of a scenario file."""
    with h5py.File(path) as file:
        about = {name: attribute(value) for name, value in file.attrs.items()}
        whole = {
            name: about[name]
            for name in ("split", "size", "subset", "seed", "scenario")
        }
        whole["major"] = int(about["version"].split(".")[0])
        whole["parameters"] = {
            name: about[name] for name in about["hashed_parameters"].split()
        }
        whole["variables"] = {
            name: variable_hash(name, data) for name, data in file.items()
        }
    return hashlib.sha256(dumps(whole)).hexdigest()
