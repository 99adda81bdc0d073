"""How a data set compares with what datasets.yaml says about it, hash by hash."""

from __future__ import annotations

from collections.abc import Collection

from .errors import DataError
from .identity import may_differ
from .locating import DESCRIPTION
from .manifest import FileEntry, Manifest
from .registry import Size
from .scenario_ids import spell_ids

__all__ = ["EQUAL", "TOLERATED", "UNLIKE", "compare", "hash_verdict", "told", "unlike_measures"]

RECORD = "datasets.yaml"
"""Where the hashes of our own splits are recorded, as the words here have it."""

EQUAL = "equal to datasets.yaml"
UNLIKE = "NOT that of datasets.yaml"
TOLERATED = "other bits than datasets.yaml (identity: tolerance)"


def compare(size: Size, manifest: Manifest, *, promised: Collection[int] = ()) -> str:
    """Return how the hashes of a manifest compare with datasets.yaml, in words.

    Args:
        size: tier of a split with its recorded hashes.
        manifest: what the folder of the data set holds.
        promised: ids just simulated by a machine that promises equal bits.

    Raises:
        DataError: a hash differs, and not for a machine that promises no equal bits.
    """
    measured = size.measured
    if measured is None:
        return "datasets.yaml holds no hash of this size yet: nothing to compare with"
    recorded = measured.scenario_sha256
    differing = [e.scenario for e in manifest.files if not e.has_hash(recorded.get(e.scenario))]
    tolerated = {e.scenario for e in manifest.files if _may_differ(e, manifest)} - set(promised)
    broken = [i for i in differing if i not in tolerated]
    if broken:
        what = f"{len(broken)} of {len(manifest.files)} scenarios have another hash"
        raise _broken(what, f"{size.split} {size.name}, scenarios {spell_ids(broken)}")
    if differing:
        return f"scenarios {spell_ids(differing)} have {TOLERATED}"
    found = {**manifest.subset_sha256, "the data set": manifest.dataset_sha256}
    wanted = {**measured.subset_sha256, "the data set": measured.dataset_sha256}
    unlike = [name for name, digest in found.items() if digest is not None and digest != wanted.get(name)]
    if unlike:
        where = f"{size.split} {size.name}, {', '.join(unlike)}"
        raise _broken("subsets or the data set have another hash though every scenario has its own", where)
    return EQUAL if manifest.complete else f"what is there is {EQUAL}"


def hash_verdict(computed: str | None, recorded: str | None, *, tolerated: bool = False) -> str:
    """Return how one subset or data set hash compares with datasets.yaml, in words.

    Args:
        computed: hash of the files; None unless all are there and right.
        recorded: hash in datasets.yaml; None where there is none.
        tolerated: whether files of machines that promise no equal bits are among them.
    """
    if recorded is None:
        return "no hash in datasets.yaml yet"
    if computed is None:
        return "incomplete"
    if computed == recorded:
        return EQUAL
    return TOLERATED if tolerated else UNLIKE


def told(words: str, size: Size) -> str:
    """Return words about hashes that name the file which records those of a split.

    >>> from lagbench.registry import load
    >>> told(EQUAL, load().size("cavity", "tiny"))
    'equal to datasets.yaml'
    """
    return words if size.simulated else words.replace(RECORD, DESCRIPTION)


def unlike_measures(size: Size, manifest: Manifest) -> list[str]:
    """Return the statistics, and the twin floor, of a manifest that datasets.yaml has otherwise.

    They follow from the bits, so a manifest that is complete and bitwise must have them.
    """
    measured = size.measured
    if measured is None or not manifest.complete or manifest.identity != "bitwise":
        return []
    names = sorted(measured.statistics.keys() | manifest.statistics.keys())
    unlike = [n for n in names if measured.statistics.get(n) != manifest.statistics.get(n)]
    return unlike + (["twin floor"] if manifest.mean_twin_floor() != measured.twin_floor else [])


def _may_differ(entry: FileEntry, manifest: Manifest) -> bool:
    return may_differ(entry.device, manifest.environments)


def _broken(what: str, where: str) -> DataError:
    return DataError(
        what,
        where=where,
        expected="the hashes in datasets.yaml",
        fix="see docs/determinism.md; `lagbench doctor` prints what a report needs",
    )
