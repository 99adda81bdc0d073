"""Where data sets live below a root folder: ids, paths and names of files.

``<root>/<split>/<size>/v<MAJOR>/<subset>/<id:04d>.nc``, with ``manifest.json`` beside
the subsets. Nothing here writes to the disk. As text ids are written ``0,3-5``, which
means 0, 3, 4 and 5.

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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from lagbench.errors import UsageError, hide_credentials

CACHE_VARIABLE = "LAGBENCH_CACHE"
"""Environment variable for the folder of working copies and of measured speeds."""

DRAWN_PREFIX = "drawn-"
"""Begins the name of a folder of blind scenarios; the seed of their draws follows.
"""

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
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    if not isinstance(url, str):
        return None
    if as_url(url) == url and root == working_copy_of(url):
        return url
    return None


def working_copy_of(url: str) -> Path:
    """Return the working copy of a root in a store; its name is readable and unique.

    Raises:
        UsageError: the user has no home folder, and no folder is named.

    >>> working_copy_of("s3://bucket/data").name
    's3-bucket-data-397b84d8'
    """
    address = hide_credentials(url, mark="")
    words = re.sub(r"[^A-Za-z0-9._]+", "-", address).strip("-.")[:60]
    digest = hashlib.sha256(url.encode()).hexdigest()
    folder = os.environ.get(CACHE_VARIABLE)
    if folder:
        stores = expand_path(folder, CACHE_VARIABLE)
    else:
        stores = platformdirs.user_cache_path("lagbench", appauthor=False) / "stores"
    return refuse_homeless(stores, CACHE_VARIABLE) / f"{words}-{digest[:8]}"


MANIFEST_NAME = "manifest.json"

NOTES_NAME = ".verified.json"
"""Name of the file beside the manifest with the hashes that this machine computed."""

CARD_NAME = "README.md"
"""Name of the file beside the manifest that describes the data set to people."""

CROISSANT_NAME = "croissant.json"
"""Name of the file beside the manifest that describes the data set to programs."""

PICTURES: Mapping[str, str] = {
    "pictures/scenarios.png": "scenarios of this data set",
    "pictures/frame.png": "one frame of a test scenario",
}
"""Pictures of a card: path relative to the card, and what each shows."""


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


MAX_ID = 9999
"""Largest scenario id: file names have four digits."""


def parse_ids(
    text: str | int, *, where: str = "--scenarios", noun: str = "id"
) -> tuple[int, ...]:
    """Return the scenario ids that a text names, in its order.

    Args:
        text: comma-separated ids and inclusive ranges; an int stands for itself.
        where: option that gave the text, for messages.
        noun: what the numbers are, for messages.

    Raises:
        UsageError: the text is no list of ids, a range runs backwards, or an id stands
            twice.

    >>> parse_ids("0,3-5")
    (0, 3, 4, 5)
    """
    ids: list[int] = []
    issue = None
    fix = f"write {noun}s in ascending order, each once"
    for part in str(text).replace(" ", "").split(","):
        match = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part)
        if match is None:
            issue = f"{part!r} is no {noun} and no range"
            other_range = re.fullmatch(r"(\d{1,4})(?:\.+|:|_|to)(\d{1,4})", part)
            if other_range is not None:
                fix = f"a range has a hyphen: {other_range[1]}-{other_range[2]}"
            break
        first = int(match[1])
        last = int(match[2] or match[1])
        if last < first:
            issue = f"{part!r} runs backwards"
            break
        ids.extend(range(first, last + 1))
    if issue is None and len(set(ids)) != len(ids):
        issue = "a number stands twice"
    if issue is not None:
        raise UsageError(
            f"bad list of {noun}s {text!r}: got {issue}, expected {noun}s and ranges "
            f"from 0 to {MAX_ID}, as in 0,3-5; {fix}",
            where=where,
        )
    return tuple(ids)


def format_ids(ids: Iterable[int]) -> str:
    """Return the shortest text that :func:`parse_ids` reads as these ids.

    >>> format_ids([0, 3, 4, 5])
    '0,3-5'
    """
    runs: list[list[int]] = []
    for scenario in ids:
        if runs and scenario == runs[-1][-1] + 1:
            runs[-1].append(scenario)
        else:
            runs.append([scenario])
    texts = []
    for run in runs:
        if len(run) > 1:
            texts.append(f"{run[0]}-{run[-1]}")
        else:
            texts.append(str(run[0]))
    return ",".join(texts)


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
            f"there is no such home folder: {str(path)!a}; write the whole path",
            where=where,
        ) from error


def expand_home(path: str | Path, where: str) -> Path:
    """Return the path of a file, a first part ~ replaced by the home folder.

    Other paths stay as they are, also names that begin with ~.

    Args:
        path: the path that a user gave.
        where: the option or argument that held it, for the message.

    Raises:
        UsageError: the user of ``~user`` has no home folder.
    """
    if Path(path).parts[:1] == ("~",):
        return expand_path(path, where)
    return Path(path)


def refuse_homeless(folder: Path, where: str) -> Path:
    """Return a folder of the user; refuse it where the user has no home folder.

    Args:
        folder: the folder.
        where: the option or variable that names another one.
    """
    if not folder.is_absolute():  # as in some containers
        raise UsageError(
            f"you have no home folder; set HOME, or name a folder: {where}", where=where
        )
    return folder


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


def quote_root(root: str | Path) -> str:
    """Return a root as an option's value for a shell: its URL, or its absolute path."""
    url = as_url(root) or url_of(Path(root))
    if url is not None:
        return shlex.quote(hide_credentials(url))
    return shlex.quote(os.path.abspath(root))
