"""Where data sets live below a root folder: the path of every scenario.

``<root>/<split>/<size>/v<MAJOR>/<subset>/<id:04d>.nc``, with ``manifest.json`` beside
the subsets. Nothing here writes to the disk.

A root folder in an object store has a local folder that stands for it: netCDF4 and HDF5
read and write files, so a root given as a URL (``s3://bucket/prefix``) becomes a folder
of the user's cache, named from the URL, that says in ``store.json`` what it is a copy
of. Everything works on that folder; ``lagbench.store`` brings objects there and puts
them back.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from lagbench.errors import UsageError

CACHE_VARIABLE = "LAGBENCH_CACHE"
"""Environment variable that names the folder of working copies and of what this machine
measured.
"""

MARK = "store.json"
"""Name of the file that says what a folder is a working copy of."""

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/(.*)", re.DOTALL)


def as_url(root: str | Path) -> str | None:
    """Return a root as a URL without a slash at its end; None where it is a path.

    A ``Path`` takes the second slash away; it is put back.

    >>> as_url("s3://bucket/data/"), as_url(Path("s3://bucket/data")), as_url("data/cavity")
    ('s3://bucket/data', 's3://bucket/data', None)
    """
    match = _URL.fullmatch(str(root))
    if match is None:
        return None
    scheme, rest = match.groups()
    # What a local file system names by URL is absolute.
    if scheme in {"file", "local"}:
        lead = "/"
    else:
        lead = ""
    return f"{scheme}://{lead}{rest.strip('/')}"


def url_of(root: Path) -> str | None:
    """Return the URL that a root folder is the working copy of; None for any other
    folder.

    A mark in any other place than the cache means nothing: a stranger may have put it
    there.
    """
    try:
        url = json.loads((root / MARK).read_text(encoding="utf-8"))["url"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    if isinstance(url, str) and as_url(url) == url and root == place_of(url):
        return url
    return None


def place_of(url: str) -> Path:
    """Return the working copy of a root in a store, by a name that says the URL
    readably, and no other's.

    >>> place_of("s3://bucket/data").name
    's3-bucket-data-397b84d8'
    """
    words = re.sub(r"[^A-Za-z0-9._]+", "-", url).strip("-.")[:60]
    return (
        cache_folder("stores")
        / f"{words}-{hashlib.sha256(url.encode()).hexdigest()[:8]}"
    )


def cache_folder(part: str) -> Path:
    """Return a folder of the user's cache, or the one that ``LAGBENCH_CACHE`` names for
    every part.
    """
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return expanded(given, CACHE_VARIABLE)
    import platformdirs

    return platformdirs.user_cache_path("lagbench", appauthor=False) / part


MANIFEST_NAME = "manifest.json"

NOTES_NAME = ".verified.json"
"""Where a machine notes which files it has hashed; it stands beside the manifest."""


@dataclass(frozen=True, kw_only=True)
class ScenarioKey:
    """What names one scenario."""

    split: str  # name of the split
    size: str  # name of the size
    version: str  # semantic version of the split, as in "1.0.0"
    scenario: int  # id within the size
    subset: str  # subset that holds the scenario

    @property
    def major(self) -> int:
        """MAJOR of the version: it changes when existing bits change."""
        return major_of(self.version)

    def identity(
        self, seed: str, parameters: Mapping[str, object]
    ) -> dict[str, object]:
        """Return what enters the content hash beside the variables."""
        return {
            "split": self.split,
            "size": self.size,
            "major": self.major,
            "scenario": self.scenario,
            "subset": self.subset,
            "seed": seed,
            "parameters": dict(parameters),
        }


def major_of(version: str) -> int:
    """Return MAJOR of a semantic version.

    >>> major_of("2.1.0")
    2
    """
    return int(version.split(".")[0])


def expanded(path: str | Path, where: str) -> Path:
    """Return a path made absolute, ~ replaced by the home folder; refuse the home of
    nobody.
    """
    try:
        return Path(path).expanduser().absolute()
    except RuntimeError as error:
        got = ascii(str(path))
        raise UsageError(
            "there is no such home folder", where=where, got=got, fix="write it out"
        ) from error


def dataset_folder(root: Path, split: str, size: str, major: int) -> Path:
    """Return the folder of one data set version.

    >>> dataset_folder(Path("data"), "cavity", "tiny", 1).as_posix()
    'data/cavity/tiny/v1'
    """
    return root / split / size / f"v{major}"


def scenario_path(root: Path, key: ScenarioKey) -> Path:
    """Return the path of a scenario file."""
    return (
        dataset_folder(root, key.split, key.size, key.major)
        / key.subset
        / f"{key.scenario:04d}.nc"
    )


def generation_of(path: Path) -> str | None:
    """Return the command that makes a scenario file anew; None where its place says no
    data set.

    >>> generation_of(Path("/my data/cavity/tiny/v2/test/0003.nc"))
    "lagbench generate --split cavity --size tiny --subset test --root '/my data'"
    """
    subset, version, size, split, *_ = *reversed(path.parts[:-1]), *[""] * 4
    if re.fullmatch(r"v\d+", version) is None:
        return None
    root = path.parents[4]
    return f"lagbench generate --split {split} --size {size} --subset {subset} --root {spelled(root)}"


def spelled(root: Path) -> str:
    """Return a root as an option's value for a shell: its URL, or the absolute path
    without detours.
    """
    return shlex.quote(url_of(root) or os.path.abspath(root))
