"""Where data sets live: the root folder and the path of every scenario.

``<root>/<split>/<size>/v<MAJOR>/<subset>/<id:04d>.nc``, with ``manifest.json`` beside the
subsets. Nothing here touches the disk, but that a root in an object store gets its working copy.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .working_copy import as_url, open_copy

__all__ = [
    "MANIFEST_NAME",
    "ROOT_VARIABLE",
    "ScenarioKey",
    "dataset_folder",
    "major_of",
    "resolve_root",
    "scenario_path",
]

ROOT_VARIABLE = "LAGBENCH_ROOT"
"""Environment variable that names the root folder."""

MANIFEST_NAME = "manifest.json"


@dataclass(frozen=True, kw_only=True)
class ScenarioKey:
    """What names one scenario.

    Attributes:
        split: name of the split.
        size: name of the size.
        version: semantic version of the split, as in "1.0.0".
        scenario: id within the size.
        subset: subset that holds the scenario.
    """

    split: str
    size: str
    version: str
    scenario: int
    subset: str

    @property
    def major(self) -> int:
        """MAJOR of the version: it changes when existing bits change."""
        return major_of(self.version)

    def identity(self, seed: str, parameters: Mapping[str, object]) -> dict[str, object]:
        """Return what enters the content hash beside the variables.

        Args:
            seed: how the random numbers were seeded.
            parameters: physical parameters by name.
        """
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


def resolve_root(root: str | Path | None = None) -> Path:
    """Return the folder that holds all data sets.

    Args:
        root: what the user gave; else ``LAGBENCH_ROOT``; else the platform's user data folder.
            A URL (``s3://bucket/prefix``) stands for its working copy, see
            :mod:`lagbench.working_copy`.

    Raises:
        WorkFailedError: the working copy of a URL cannot be made.
    """
    given = root or os.environ.get(ROOT_VARIABLE)
    if given:
        url = as_url(given)
        if url is not None:
            return open_copy(url)
        return Path(given).expanduser().absolute()
    import platformdirs

    return platformdirs.user_data_path("lagbench", appauthor=False)


def dataset_folder(root: Path, split: str, size: str, major: int) -> Path:
    """Return the folder of one data set version.

    >>> dataset_folder(Path("data"), "cavity", "tiny", 1).as_posix()
    'data/cavity/tiny/v1'
    """
    return root / split / size / f"v{major}"


def scenario_path(root: Path, key: ScenarioKey) -> Path:
    """Return the path of a scenario file."""
    return dataset_folder(root, key.split, key.size, key.major) / key.subset / f"{key.scenario:04d}.nc"
