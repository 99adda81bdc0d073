"""Scenario files of a data set's subsets, as the registry names them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.errors import DataError, UsageError, nearest
from lagbench.layout import ScenarioKey, scenario_path
from lagbench.registry import Size
from lagbench.remedy import remedy
from lagbench.scenario_ids import spell_ids
from lagbench.store.bringing import bring

__all__ = ["Source", "sources_of"]


@dataclass(frozen=True, kw_only=True)
class Source:
    """A scenario file and what the registry says that it is.

    Attributes:
        path: path of the file.
        key: what names the scenario.
        frames: frames that it holds.
        digest: first digits of its content hash; empty when none is known.
        remedy: what writes the file anew, in words.
    """

    path: Path
    key: ScenarioKey
    frames: int
    digest: str = ""
    remedy: str = ""


def sources_of(size: Size, subsets: Sequence[str], root: Path) -> dict[int, Source]:
    """Return the scenario files of subsets by id; say which are missing."""
    digests = size.measured.scenario_sha256 if size.measured else {}
    sources: dict[int, Source] = {}
    for subset in subsets:
        if subset not in size.subsets:
            raise UsageError(
                f"no subset {subset!r}", where=f"{size.split} {size.name}", fix=nearest(subset, size.subsets)
            )
        for i in size.subsets[subset]:
            key = ScenarioKey(
                split=size.split, size=size.name, version=size.version, scenario=i, subset=subset
            )
            sources[i] = Source(
                path=scenario_path(root, key),
                key=key,
                frames=size.frame_count(i),
                digest=digests.get(i, ""),
                remedy=remedy(size, f"--subset {subset}"),
            )
    bring(size, root, sources)
    missing = [i for i, source in sources.items() if not source.path.is_file()]
    if missing:
        raise DataError(
            f"{len(missing)} of {len(sources)} scenarios are not there",
            where=str(root / size.split / size.name),
            got=f"missing: {spell_ids(missing)}",
            fix=remedy(size, root=root),
        )
    return sources
