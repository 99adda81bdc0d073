"""Seeds of one method: files that come together, and an entry that gets more of them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lagbench.data.checksums import file_sha256
from lagbench.errors import ChecksFailedError, UsageError
from lagbench.submission.format import Header

from .entry import MOST_SEEDS, Entry, Status
from .entry_file import read_entry
from .folder import Folder, Place, entry_path

OWN = "submit each on its own"


def seeds_of(headers: Sequence[Header]) -> tuple[int | None, ...]:
    """Return the seeds of files that belong together; refuse those that do not."""
    alike = ("split", "size", "dataset_sha256", "method", "parameters")
    told = {name: [str(getattr(header, name)) for header in headers] for name in alike}
    told["training"] = _alike([header.training or "" for header in headers])
    for name, values in told.items():
        if len(found := dict.fromkeys(values)) > 1:
            rename = "; or write seeds of one method under one name: lagbench predict --method NAME"
            fix = OWN + rename * (name == "method")
            raise UsageError(f"the files differ in {name}", got=", ".join(map(ascii, found)), fix=fix)
    seeds = tuple(header.seed for header in headers)
    if any(seed is not None and not 0 <= seed < 2**63 for seed in seeds):
        raise UsageError("a seed does not fit", expected="0 to 2^63 - 1", got=seeds)
    if len(seeds) > 1:
        _require_different(seeds)
    return seeds


def _alike(trainings: Sequence[str]) -> list[str]:
    """Return trainings in words without what is each seed's own: its best step, and what it started from."""
    words = [re.sub(r"(, step |, weights )\w+", "", one) for one in trainings]
    return words if all(", recipe " in one for one in words) else []


def _require_different(seeds: Sequence[int | None]) -> None:
    if None in seeds or len(set(seeds)) < len(seeds):
        raise UsageError(
            "several files need seeds that differ",
            got=", ".join("none" if seed is None else str(seed) for seed in seeds),
            fix="write them with submission.write(..., seed=0), seed=1 and so on",
        )


def entry_to_add_to(folder: Folder, place: Place, headers: Sequence[Header]) -> Entry:
    """Return the entry that gets more seeds; refuse one that files of other seeds do not belong to.

    Its own predictions need not be at hand: what they scored is read from its score files, which must be
    those that it names.
    """
    path, first = folder.path / entry_path(place), headers[0]
    if not path.exists():
        fix = "submit it without --add; --method names the entry"
        raise UsageError("there is no entry to add seeds to", where=str(path), fix=fix)
    entry = read_entry(path)
    if entry.status is not Status.ACTIVE:
        raise UsageError("the entry is not active", where=str(path), got=entry.status, fix=OWN)
    told = {
        "dataset_sha256": (entry.dataset.sha256, first.dataset_sha256),
        "parameters": (entry.parameters, first.parameters),
        "training": _alike([entry.training, first.training or ""]) or ("", ""),
    }
    for name, (theirs, ours) in told.items():
        if theirs != ours:
            raise UsageError(
                f"the files differ from the entry in {name}",
                where=str(path),
                expected=ascii(theirs),
                got=ascii(ours),
                fix=f"{OWN}, by another --method; or submit all seeds anew: --replace",
            )
    seeds = [*(made.seed for made in entry.predictions), *(header.seed for header in headers)]
    _require_different(seeds)
    if len(seeds) > MOST_SEEDS:
        raise UsageError("too many seeds", where=str(path), expected=f"at most {MOST_SEEDS}", got=len(seeds))
    for inner, said in zip(entry.score_paths, entry.score.files, strict=True):
        file = folder.path / inner
        if folder.link_in(inner) is not None or not file.is_file() or file_sha256(file) != said.sha256:
            raise ChecksFailedError(
                "a score file of the entry is not the one that it names",
                where=str(file),
                expected=f"SHA-256 {said.sha256[:16]}",
                fix="restore it, as `git checkout` does, or submit all seeds anew: --replace",
            )
    return entry
