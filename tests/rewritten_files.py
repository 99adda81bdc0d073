"""Files that somebody changed and then made agree with themselves."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import h5py
import netCDF4
import numpy as np
from independent_hash import content_hash, variable_hash


def forge(path: Path) -> str:
    """Change one velocity of a scenario file and mend every hash in it; return the
    content hash.
    """
    with h5py.File(path, "r+") as file:
        file["velocity"][7, 11, 0] += np.float32(1e-6)
        digest = variable_hash("velocity", file["velocity"])
    with netCDF4.Dataset(path, "r+") as file:
        file["velocity"].content_sha256 = digest
    content = content_hash(path)
    with netCDF4.Dataset(path, "r+") as file:
        file.content_sha256 = content
    return content


def mend_manifest(path: Path, scenario: int, file: Path, content: str) -> None:
    """Make the manifest agree with a forged file."""
    told = json.loads(path.read_text())
    entry = next(entry for entry in told["files"] if entry["scenario"] == scenario)
    data = file.read_bytes()
    entry |= {
        "content_sha256": content,
        "bytes": len(data),
        "file_sha256": hashlib.sha256(data).hexdigest(),
    }
    path.write_text(json.dumps(told))
