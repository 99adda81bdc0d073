"""Compare the values of scenario files with the recorded content hashes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from lagbench.errors import DataError

from .checksums import load_recorded_hashes, record_hashes
from .layout import quote_root
from .local import suggest_repair
from .manifest import Manifest, read_or_empty
from .registry import Size
from .scenario import check_scenario


def check_contents(size: Size, root: Path, scenarios: Iterable[int]) -> None:
    """Compare the content hash of scenarios with the recorded one.

    Values are hashed, unless this machine has hashed the same file before. The recorded
    hash is that of datasets.yaml, or of the manifest for a size that has none there. A
    scenario without any recorded hash is only read.

    Args:
        size: the data set.
        root: folder of all data sets.
        scenarios: ids of the scenarios.

    Raises:
        DataError: a scenario is missing, damaged or not the recorded one.
    """
    folder = size.folder(root)
    noted_hash = load_recorded_hashes(folder)
    manifest = None
    if not size.measured:
        manifest = read_or_empty(size, root)

    new_hashes: dict[Path, str] = {}
    for scenario in sorted(scenarios):
        path = size.path(root, scenario)
        subset = size.subset_of(scenario)
        hint = _hint_for_damage(size, root, subset)
        content = _content_hash(path, noted_hash, new_hashes, subset=subset, hint=hint)
        expected = _expected_hash(size, scenario, manifest)
        if not content.startswith(expected):
            raise DataError(
                f"a {subset} scenario has another content hash",
                where=str(path),
                expected=expected,
                got=content,
                fix=hint,
            )
    record_hashes(folder, new_hashes)


def _content_hash(
    path: Path,
    noted_hash: Callable[[Path], tuple[str, str] | None],
    new_hashes: dict[Path, str],
    *,
    subset: str,
    hint: str,
) -> str:
    """Return the content hash of a file; one that was not noted is added."""
    try:
        hashes = noted_hash(path)
        if hashes is not None:
            return hashes[0]
        new_hashes[path] = check_scenario(path)
    except OSError as error:
        raise DataError(
            f"cannot read a {subset} scenario",
            where=str(path),
            expected="a readable file",
            got=error.strerror,
            fix=hint,
        ) from error
    except DataError as error:
        raise DataError(
            error.what,
            where=error.where or str(path),
            expected=error.expected,
            got=error.got,
            fix=hint,
        ) from error
    return new_hashes[path]


def _expected_hash(size: Size, scenario: int, manifest: Manifest | None) -> str:
    """Return what is recorded of a content hash: all, its first digits, or nothing."""
    if manifest is not None:
        entry = manifest.entry(scenario)
        if entry is not None:
            return entry.content_sha256
    return size.registered_hash(scenario)


def _hint_for_damage(size: Size, root: Path, subset: str) -> str:
    repair = suggest_repair(size, f"--subset {subset}", root=root)
    verify = f"lagbench verify --split {size.split} --size {size.name}"
    return f"{repair}; {verify} --root {quote_root(root)} says what is wrong"
