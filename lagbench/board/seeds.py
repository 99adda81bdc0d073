"""Seeds of one method: files that come together, and an entry that gets more of
them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from lagbench.errors import ChecksFailedError, UsageError
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.submission.findings import quoted
from lagbench.submission.format import Header

from .entry import LONGEST_TEXT, MOST_SEEDS, Entry, Meta, Status
from .entry_file import is_there, read_entry
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
            raise UsageError(
                f"the files differ in {name}", got=", ".join(map(ascii, found)), fix=fix
            )
    seeds = tuple(header.seed for header in headers)
    if any(seed is not None and not 0 <= seed < 2**63 for seed in seeds):
        raise UsageError("a seed does not fit", expected="0 to 2^63 - 1", got=seeds)
    if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
        fix = "write them with submission.write(..., seed=0), seed=1 and so on"
        raise UsageError(
            "several files need seeds that differ", got=_spelled(seeds), fix=fix
        )
    return seeds


def _alike(trainings: Sequence[str]) -> list[str]:
    """Return trainings in words without what is each seed's own: its best step, and
    what it started from.

    Nothing where no recipe is named: words of people are not compared.
    """
    words = [re.sub(r"(, step |, weights )\w+", "", one) for one in trainings]
    if any(", recipe " in one for one in words):
        return words
    return []


def extendable(
    folder: Folder, place: Place, headers: Sequence[Header], meta: Meta
) -> Entry:
    """Return the entry that gets more seeds, its predictions perhaps gone; refuse what
    does not belong.
    """
    path = folder.path / entry_path(place)
    first = headers[0]
    anew = "or submit all seeds anew: --replace"
    if not path.exists():
        fix = "submit it without --add; --method names the entry"
        raise UsageError("there is no entry to add seeds to", where=str(path), fix=fix)
    entry = read_entry(path)
    if entry.status is not Status.ACTIVE:
        fix = "submit by another --method"
        raise UsageError(
            "seeds are added to active entries only",
            where=str(path),
            got=entry.status,
            fix=fix,
        )
    own = [made.seed for made in entry.predictions]
    seeds = [header.seed for header in headers]
    if None in own or None in seeds:
        raise UsageError(
            "seeds that are added need numbers, those of the entry too",
            where=str(path),
            got=f"the entry has {_spelled(own)}, the files {_spelled(seeds)}",
            fix="write every file with a seed, as submission.write(..., seed=0) does; "
            "submit all: --replace",
        )
    if common := sorted({*own} & {*seeds}, key=str):
        fix = f"leave out what is there, {anew}"
        got = f"seed {_spelled(common)}; the entry has {_spelled(own)}"
        raise UsageError(
            "the entry has such a seed already", where=str(path), got=got, fix=fix
        )
    if (count := len(own) + len(seeds)) > MOST_SEEDS:
        raise UsageError(
            "too many seeds",
            where=str(path),
            expected=f"at most {MOST_SEEDS}",
            got=count,
        )
    files = zip(entry.score_paths, entry.score.files, strict=True)
    named = [
        (path, said.sha256, "a score file of the entry is not the one")
        for path, said in files
    ]
    weights = [made.weights for made in entry.predictions if made.weights]
    named += [
        (Path(its.path), its.sha256, "weights of the entry are not those")
        for its in weights
    ]
    for inner, sha256, what in named:
        if not is_there(folder, inner, sha256):
            raise ChecksFailedError(
                f"{what} that it names",
                where=str(folder.path / inner),
                expected=f"SHA-256 {sha256[:16]}",
                fix=f"restore {'it' if inner.suffix == '.nc' else 'them'}, as `git "
                f"checkout` does, {anew}",
            )
    label = read_score_file(folder.path / entry.score_paths[0]).scores.identity[
        "method"
    ]
    told: dict[str, tuple[object, object]] = {
        "method": (label, first.method),
        "dataset_sha256": (entry.dataset.sha256, first.dataset_sha256),
    }
    if "parameters" not in meta.model_fields_set and first.parameters is not None:
        told["parameters"] = (entry.parameters, first.parameters)
    words = _alike([entry.training, (first.training or "")[:LONGEST_TEXT]])
    if "training" not in meta.model_fields_set and words:
        told["training"] = (words[0], words[1])
    for name, (theirs, ours) in told.items():
        if theirs != ours:
            raise UsageError(
                f"the files differ from the entry in {name}",
                where=str(path),
                expected=quoted(theirs),
                got=quoted(ours),
                fix=f"{OWN}, by another --method; {anew}",
            )
    return entry


def _spelled(seeds: Sequence[int | None]) -> str:
    return ", ".join("none" if seed is None else str(seed) for seed in seeds)


def require_new(
    prints: Sequence[str], paths: Sequence[Path], known: Mapping[str, str]
) -> None:
    """Refuse files that another entry or another seed has: `known` says whose a print
    is.
    """
    found = dict(known)
    for print_, path in zip(prints, paths, strict=True):
        if print_ in found:
            fix = "submit the file of each seed once; what goes by a new name supersedes its old entry"
            got = f"those of {found[print_]}"
            raise UsageError(
                "the same predictions are there", where=str(path), got=got, fix=fix
            )
        found[print_] = str(path)
