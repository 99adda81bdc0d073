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
    text = json.dumps(
        value,
        sort_keys=True,
        separators=(",", ":"),
        ensure_ascii=False,
    )
    return text.encode()


def attribute(value: Any) -> Any:
    """Return an attribute as a plain string, integer or float."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.item()
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, float):
        return value + 0.0
    return value


def value_bytes(data: Any) -> bytes:
    """Return the canonical values: one zero, one NaN, little-endian."""
    if data.dtype.kind == "O":
        return "\0".join(data.asstr()[()]).encode()
    little_endian = data.dtype.newbyteorder("<")
    values = data[()].astype(little_endian)
    if data.dtype.kind == "f":
        zero = np.array(0, values.dtype)
        nan = np.array(np.nan, values.dtype)
        values = np.where(values == 0, zero, values)
        values = np.where(np.isnan(values), nan, values)
    return values.astype(little_endian).tobytes()


def variable_hash(name: str, data: Any) -> str:
    """Return the hash of header, newline and canonical values."""
    dims = [name]
    if not data.is_scale:
        dims = [dim[0].name.lstrip("/") for dim in data.dims]
    dtype = "string"
    if data.dtype.kind != "O":
        dtype = data.dtype.newbyteorder("=").name
    header = {
        "name": name,
        "dtype": dtype,
        "dims": dims,
        "shape": list(data.shape),
    }
    text = dumps(header) + b"\n" + value_bytes(data)
    return hashlib.sha256(text).hexdigest()


def content_hash(path: Path) -> str:
    """Return the content hash of a scenario file."""
    with h5py.File(path) as file:
        attributes = {}
        for name, value in file.attrs.items():
            attributes[name] = attribute(value)
        whole = {}
        for name in ("split", "size", "subset", "seed", "scenario"):
            whole[name] = attributes[name]
        major, *_ = attributes["version"].split(".")
        whole["major"] = int(major)
        whole["parameters"] = {}
        for name in attributes["hashed_parameters"].split():
            whole["parameters"][name] = attributes[name]
        whole["variables"] = {}
        for name, data in file.items():
            whole["variables"][name] = variable_hash(name, data)
    return hashlib.sha256(dumps(whole)).hexdigest()
