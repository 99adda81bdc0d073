"""Where data sets live below a root folder: the path of every scenario.

``<root>/<split>/<size>/v<MAJOR>/<subset>/<id:04d>.nc``, with ``manifest.json`` beside
the subsets. Nothing here writes to the disk.

A root in an object store has a local working copy, because netCDF4 and HDF5 read and
write files. A root given as a URL (``s3://bucket/prefix``) becomes a folder of the
user's cache. The folder is named from the URL, and its file ``store.json`` holds the
URL. All code works on that folder; ``lagbench.store`` fetches objects into it and puts
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

import platformdirs

from lagbench.errors import UsageError

CACHE_VARIABLE = "LAGBENCH_CACHE"
"""Environment variable for the folder of working copies and of measured speeds."""

SEASON_PREFIX = "season."
"""Begins the name of a folder of blind data, below the folder of all data sets."""

STORE_FILE = "store.json"
"""Name of the file that holds the URL of a working copy."""

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/(.*)", re.DOTALL)


def as_url(root: str | Path) -> str | None:
    """Return a root as a URL without a slash at its end; None where it is a path.

    A ``Path`` drops the second slash of a URL; it is put back.

    >>> as_url("s3://bucket/data/"), as_url(Path("s3://bucket/data"))
    ('s3://bucket/data', 's3://bucket/data')
    """
    match = _URL.fullmatch(str(root))
    if match is None:
        return None
    scheme, rest = match.groups()
    address = rest.strip("/")
    # A path of a local file system is absolute.
    if scheme in {"file", "local"}:
        address = f"/{address}"
    return f"{scheme}://{address}"


def url_of(root: Path) -> str | None:
    """Return the URL of a working copy; None for any other folder.

    The store file counts in the cache only: elsewhere a stranger may have put it.
    """
    try:
        text = (root / STORE_FILE).read_text(encoding="utf-8")
        url = json.loads(text)["url"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    if not isinstance(url, str):
        return None
    if as_url(url) == url and root == working_copy_of(url):
        return url
    return None


def working_copy_of(url: str) -> Path:
    """Return the working copy of a root in a store; its name is readable and unique.

    >>> working_copy_of("s3://bucket/data").name
    's3-bucket-data-397b84d8'
    """
    words = re.sub(r"[^A-Za-z0-9._]+", "-", url).strip("-.")[:60]
    digest = hashlib.sha256(url.encode()).hexdigest()
    return cache_folder("stores") / f"{words}-{digest[:8]}"


def cache_folder(part: str) -> Path:
    """Return a folder of the user's cache, or the folder of ``LAGBENCH_CACHE``."""
    folder = os.environ.get(CACHE_VARIABLE)
    if folder:
        return expand_path(folder, CACHE_VARIABLE)
    return platformdirs.user_cache_path("lagbench", appauthor=False) / part


MANIFEST_NAME = "manifest.json"

NOTES_NAME = ".verified.json"
"""Name of the file beside the manifest with the hashes that this machine computed."""


@dataclass(frozen=True, kw_only=True)
class ScenarioKey:
    """The names of one scenario."""

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
        """Return the part of the content hash beside the variables."""
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


def expand_path(path: str | Path, where: str) -> Path:
    """Return a path made absolute, ~ replaced by the home folder.

    Args:
        path: the path that a user gave.
        where: the option or variable that held it, for the message.

    Raises:
        UsageError: the user of ``~user`` has no home folder.
    """
    try:
        return Path(path).expanduser().absolute()
    except RuntimeError as error:
        raise UsageError(
            "there is no such home folder",
            where=where,
            got=ascii(str(path)),
            fix="write it out",
        ) from error


def dataset_folder(root: Path, split: str, size: str, major: int) -> Path:
    """Return the folder of one data set version.

    >>> dataset_folder(Path("data"), "cavity", "tiny", 1).as_posix()
    'data/cavity/tiny/v1'
    """
    return root / split / size / f"v{major}"


def scenario_path(root: Path, key: ScenarioKey) -> Path:
    """Return the path of a scenario file."""
    folder = dataset_folder(root, key.split, key.size, key.major)
    return folder / key.subset / f"{key.scenario:04d}.nc"


def generation_command(path: Path) -> str | None:
    """Return the command that makes a scenario file anew.

    None where the path is not that of a data set.

    >>> generation_command(Path("/my data/cavity/tiny/v2/test/0003.nc"))
    "lagbench generate --split cavity --size tiny --subset test --root '/my data'"
    >>> generation_command(Path("/d/season.may/cavity/tiny/v2/blind/1000.nc"))
    'lagbench generate --season may --split cavity --size tiny --root /d'
    """
    folders = path.parts[:-1]
    if len(folders) < 4 or re.fullmatch(r"v\d+", folders[-2]) is None:
        return None
    split, size, _, subset = folders[-4:]
    data_root = path.parents[4]
    if data_root.name.startswith(SEASON_PREFIX):
        season = shlex.quote(data_root.name.removeprefix(SEASON_PREFIX))
        root = quote_root(data_root.parent)
        names = f"--season {season} --split {split} --size {size}"
        return f"lagbench generate {names} --root {root}"
    root = quote_root(data_root)
    names = f"--split {split} --size {size} --subset {subset}"
    return f"lagbench generate {names} --root {root}"


def quote_root(root: Path) -> str:
    """Return a root as an option's value for a shell: its URL, or its absolute path."""
    return shlex.quote(url_of(root) or os.path.abspath(root))
