"""Which scenarios of a data set are on disk, and whether their content is right.

Right means: the file says what it is in the place where it stands, its parameters are those
of the registry, its values have the hash that it states, and that hash is the one in
datasets.yaml; where there is none yet, the one in the manifest. A file of a machine that
promises no equal bits may differ from datasets.yaml, but not from its manifest.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .checksums import file_sha256, plain
from .errors import DataError
from .identity import may_differ
from .layout import dataset_folder, scenario_path
from .manifest import FileEntry, Manifest, describe_file
from .registry import Size
from .scenario_file import ScenarioHeader, check_scenario, read_scenario

__all__ = ["Finding", "Look", "State", "examine", "extra_files", "look", "recorded_hash"]


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
        entry: manifest entry of a good file, where one was asked for.
        tolerated: whether a good file has other bits than datasets.yaml.
    """

    scenario: int
    state: State
    content_sha256: str | None = None
    problem: str | None = None
    entry: FileEntry | None = None
    tolerated: bool = False


def recorded_hash(size: Size, scenario: int) -> str | None:
    """Return the first 16 digits of a content hash as datasets.yaml has them, or None."""
    return size.measured.scenario_sha256.get(scenario) if size.measured else None


def examine(
    root: Path, size: Size, scenario: int, *, manifest: Manifest | None = None, quick: bool = False
) -> Finding:
    """Look at the file of one scenario.

    Args:
        root: folder that holds all data sets.
        size: tier of a split.
        scenario: id.
        manifest: what the folder's manifest says, see above.
        quick: do not hash a file value by value that has the very bytes which the manifest
            describes; the finding then has a manifest entry.
    """
    from .generators.simulate import scenario_key

    key = scenario_key(size, scenario)
    path = scenario_path(root, key)
    if not path.exists():
        return Finding(scenario=scenario, state=State.MISSING)
    claim = manifest.entry(scenario) if manifest else None
    try:
        digest = file_sha256(path) if quick else None
        with read_scenario(path) as file:
            _check_header(path, file.header, size, scenario)
            unchanged = claim is not None and digest == claim.file_sha256
            if unchanged:
                file.check_attributes()
        content = claim.content_sha256 if claim and unchanged else check_scenario(path)
        tolerated = _check_known(path, content, recorded_hash(size, scenario), claim, manifest)
        entry = describe_file(root, key, digest=digest) if digest and not unchanged else claim
    except (DataError, OSError) as error:
        return Finding(scenario=scenario, state=State.WRONG, problem=_spelled(error, path))
    return Finding(
        scenario=scenario,
        state=State.GOOD,
        content_sha256=content,
        entry=entry if quick else None,
        tolerated=tolerated,
    )


@dataclass(frozen=True, kw_only=True)
class Look:
    """The arguments of a quick :func:`examine`, for a worker.

    Attributes:
        root: folder that holds all data sets.
        size: tier of a split.
        scenario: id.
        manifest: what the folder's manifest says of this scenario.
    """

    root: Path
    size: Size
    scenario: int
    manifest: Manifest


def look(order: Look, report: Callable[[int], None]) -> Finding:
    """Examine the file of one scenario quickly and report it as one unit of work."""
    finding = examine(order.root, order.size, order.scenario, manifest=order.manifest, quick=True)
    report(1)
    return finding


def _spelled(error: DataError | OSError, path: Path) -> str:
    if not isinstance(error, DataError):
        return f"cannot read {path}: {error.strerror}"
    # How to mend it depends on the split, and is said once for all files.
    return str(DataError(error.what, where=error.where, expected=error.expected, got=error.got))


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
    key = header.key
    found = (key.split, key.size, key.major, key.scenario, key.subset)
    wanted = (size.split, size.name, size.major, scenario, size.subset_of(scenario))
    if found != wanted:
        raise DataError("a file holds another scenario", where=str(path), expected=wanted, got=found)
    if not size.simulated:  # then the recorded content hash covers the parameters
        return
    from .generators.batch import draw
    from .generators.simulate import file_parameters

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


def _check_known(
    path: Path, content: str, recorded: str | None, claim: FileEntry | None, manifest: Manifest | None
) -> bool:
    """Compare a content hash with what is known; return whether its being another is tolerated."""
    expected = recorded or (claim.content_sha256 if claim else None)
    if expected is None or content.startswith(expected):
        return False
    if (
        manifest is not None
        and manifest.identity == "tolerance"
        and claim is not None
        and claim.content_sha256 == content
        and may_differ(claim.device, manifest.environments)
    ):
        return True
    raise DataError(
        "the file has another content hash",
        where=str(path),
        expected=f"{expected} of {'datasets.yaml' if recorded else 'the manifest'}",
        got=content,
    )
