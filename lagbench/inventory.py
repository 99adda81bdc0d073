"""Which scenarios of a data set are on disk, and whether their content is right.

Right means: the file says what it is in the place where it stands, its parameters are those
of the registry, its values have the hash that it states, and that hash is the one in
datasets.yaml where there is one.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path

from .checksums import file_sha256, plain
from .errors import DataError
from .layout import dataset_folder, scenario_path
from .manifest import FileEntry
from .registry import Size
from .scenario_file import ScenarioHeader, check_scenario, read_scenario

__all__ = ["Finding", "State", "examine", "extra_files", "is_unchanged", "recorded_hash"]


class State(enum.StrEnum):
    """What became of a scenario's file."""

    GOOD = "good"
    MISSING = "missing"
    WRONG = "wrong"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a look at one scenario's file showed.

    Attributes:
        scenario: its id.
        state: whether the file is there and right.
        content_sha256: content hash of a good file.
        problem: what is wrong, naming file and, where it can be told, variable.
    """

    scenario: int
    state: State
    content_sha256: str | None = None
    problem: str | None = None


def recorded_hash(size: Size, scenario: int) -> str | None:
    """Return the first 16 digits of a content hash as datasets.yaml has them, or None."""
    return size.measured.scenario_sha256.get(scenario) if size.measured else None


def examine(root: Path, size: Size, scenario: int, *, trusted: FileEntry | None = None) -> Finding:
    """Look at the file of one scenario.

    Args:
        root: folder that holds all data sets.
        size: tier of a split.
        scenario: id.
        trusted: manifest entry; a file with its very bytes is not hashed value by value again.
    """
    from .generators.simulate import scenario_key

    path = scenario_path(root, scenario_key(size, scenario))
    if not path.exists():
        return Finding(scenario=scenario, state=State.MISSING)
    try:
        with read_scenario(path) as file:
            _check_header(path, file.header, size, scenario)
        if trusted is not None and is_unchanged(path, trusted):
            content = trusted.content_sha256
            _check_recorded(path, content, recorded_hash(size, scenario))
        else:
            content = check_scenario(path, recorded_hash(size, scenario))
    except DataError as error:
        return Finding(scenario=scenario, state=State.WRONG, problem=str(error))
    return Finding(scenario=scenario, state=State.GOOD, content_sha256=content)


def is_unchanged(path: Path, entry: FileEntry) -> bool:
    """Return whether a file has the very bytes that the manifest describes."""
    return path.stat().st_size == entry.bytes and file_sha256(path) == entry.file_sha256


def extra_files(root: Path, size: Size) -> dict[str, list[str]]:
    """Return, by subset folder, the names of files that no scenario of the size has."""
    folder = dataset_folder(root, size.split, size.name, size.major)
    known = {(subset, f"{i:04d}.nc") for subset, ids in size.subsets.items() for i in ids}
    extra: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*/*.nc")):
        if (path.parent.name, path.name) not in known and not path.name.startswith("."):
            extra.setdefault(path.parent.name, []).append(path.name)
    return extra


def _check_header(path: Path, header: ScenarioHeader, size: Size, scenario: int) -> None:
    """Refuse a file of another scenario or simulated with other parameters."""
    from .generators.batch import draw
    from .generators.simulate import file_parameters

    key = header.key
    found = (key.split, key.size, key.major, key.scenario, key.subset)
    wanted = (size.split, size.name, size.major, scenario, size.subset_of(scenario))
    if found != wanted:
        raise DataError("a file holds another scenario", where=str(path), expected=wanted, got=found)
    parameters = plain(file_parameters(size, draw(size, scenario)))
    if parameters != dict(header.parameters):
        names = _differing(parameters, header.parameters)
        raise DataError(
            "a file was simulated with other parameters",
            where=f"{path}, attributes {', '.join(names)}",
            expected="those of datasets.yaml",
        )


def _differing(wanted: object, found: object) -> list[str]:
    left = dict(wanted) if isinstance(wanted, dict) else {}
    right = dict(found) if isinstance(found, dict) else {}
    return sorted(name for name in left.keys() | right.keys() if left.get(name) != right.get(name))


def _check_recorded(path: Path, content: str, recorded: str | None) -> None:
    if recorded is not None and not content.startswith(recorded):
        raise DataError(
            "the file has another content hash",
            where=str(path),
            expected=recorded,
            got=content,
            fix="lagbench generate writes what is missing or damaged anew",
        )
