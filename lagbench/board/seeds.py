"""Seeds of one method: files that come together, and an entry that gets more seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lagbench.errors import ChecksFailedError, UsageError
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.submission.format import Header
from lagbench.submission.issues import quote
from lagbench.submission.provenance import TrainingProvenance

from .entry import Entry, Meta, Status
from .entry_file import is_unchanged, read_entry
from .fields import MOST_SEEDS
from .folder import Folder, Place, entry_path

SUBMIT_APART = "submit each on its own"
SUBMIT_ANEW = "or submit all seeds anew: --replace"

SHARED_LABELS = ("split", "size", "dataset_sha256", "method", "parameters")
"""Labels of predictions that all seeds of a method share."""


def seeds_of(headers: Sequence[Header]) -> tuple[int | None, ...]:
    """Return the seeds of files that belong together.

    Raises:
        UsageError: the files do not belong together, or their seeds do not differ.
    """
    for name in SHARED_LABELS:
        labels = []
        for header in headers:
            labels.append(str(getattr(header, name)))
        _require_equal(name, labels)
    provenances = [header.provenance for header in headers]
    _require_equal("training", _different_trainings(provenances))

    seeds = tuple(header.seed for header in headers)
    for seed in seeds:
        if seed is not None and not 0 <= seed < 2**63:
            raise UsageError(
                "a seed does not fit",
                where="seed of the predictions",
                expected="0 to 2^63 - 1",
                got=seeds,
                fix="write them again with such a seed: submission.write(..., seed=0)",
            )
    if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
        raise UsageError(
            "several files must have different seeds",
            where="the predictions, one file for each seed",
            expected="another seed in each file",
            got=_format_seeds(seeds),
            fix="write them with submission.write(..., seed=0), seed=1 and so on",
        )
    return seeds


def _require_equal(name: str, values: Sequence[str]) -> None:
    different = list(dict.fromkeys(values))
    if len(different) < 2:
        return
    fix = SUBMIT_APART
    if name == "method":
        fix += (
            "; or write seeds of one method under one name: "
            "lagbench predict --method NAME"
        )
    raise UsageError(
        f"the files differ in {name}",
        where="the predictions, one file for each seed",
        expected="files that differ in their seed only",
        got=", ".join(map(ascii, different)),
        fix=fix,
    )


def _different_trainings(
    provenances: Sequence[TrainingProvenance | None],
) -> list[str]:
    """Return the trainings in words, one for all that may be seeds of one method.

    Empty where no training is known as data: words of people are not compared.
    """
    if not any(provenances):
        return []
    trainings: dict[str, str] = {}
    for provenance in provenances:
        shared = whole = "a training in words"
        if provenance is not None:
            shared = provenance.shared_by_seeds().describe()
            whole = provenance.describe()
        trainings.setdefault(shared, whole)
    return list(trainings.values())


def require_extendable(
    folder: Folder, place: Place, headers: Sequence[Header], meta: Meta
) -> Entry:
    """Return the entry that gets more seeds; its predictions may be gone.

    Raises:
        UsageError: there is no such active entry, or the files do not belong to it.
        ChecksFailedError: score files or weights of the entry have changed.
    """
    path = folder.path / entry_path(place)
    if not path.exists():
        raise UsageError(
            "there is no entry to add seeds to",
            where=str(path),
            expected="an active entry of that name",
            got="no such file",
            fix="submit it without --add; --method names the entry",
        )
    entry = read_entry(path)
    if entry.status is not Status.ACTIVE:
        raise UsageError(
            "seeds are added to active entries only",
            where=str(path),
            expected=f"an entry whose status is {Status.ACTIVE}",
            got=entry.status,
            fix="submit by another --method",
        )
    _require_new_seeds(path, entry.seeds, [header.seed for header in headers])
    _require_unchanged_files(folder, entry)
    _require_same_method(folder, entry, headers[0], meta)
    return entry


def _require_new_seeds(
    path: Path, entry_seeds: Sequence[int | None], new_seeds: Sequence[int | None]
) -> None:
    if None in entry_seeds or None in new_seeds:
        raise UsageError(
            "seeds can be added only if the files and the entry state their seeds",
            where=str(path),
            expected="a number in each file",
            got=f"the entry has {_format_seeds(entry_seeds)}, "
            f"the files {_format_seeds(new_seeds)}",
            fix="write every file with a seed, as submission.write(..., seed=0) does; "
            "submit all: --replace",
        )
    common_seeds = sorted(set(entry_seeds) & set(new_seeds), key=str)
    if common_seeds:
        raise UsageError(
            "the entry has this seed already",
            where=str(path),
            expected="seeds that the entry does not have",
            got=f"seed {_format_seeds(common_seeds)}; "
            f"the entry has {_format_seeds(entry_seeds)}",
            fix=f"leave out the files of these seeds, {SUBMIT_ANEW}",
        )
    count = len(entry_seeds) + len(new_seeds)
    if count > MOST_SEEDS:
        raise UsageError(
            "too many seeds",
            where=str(path),
            expected=f"at most {MOST_SEEDS}",
            got=count,
            fix="submit fewer files",
        )


def _require_unchanged_files(folder: Folder, entry: Entry) -> None:
    for path, file in zip(entry.score_paths, entry.score.files, strict=True):
        if not is_unchanged(folder, path, file.sha256):
            raise ChecksFailedError(
                "a score file of the entry is not the one that it names",
                where=str(folder.path / path),
                expected=f"SHA-256 {file.sha256[:16]}",
                got="another file, or none",
                fix=f"restore it, as `git checkout` does, {SUBMIT_ANEW}",
            )
    for prediction in entry.predictions:
        weights = prediction.weights
        if weights is None:
            continue
        if not is_unchanged(folder, Path(weights.path), weights.sha256):
            raise ChecksFailedError(
                "weights of the entry are not those that it names",
                where=str(folder.path / weights.path),
                expected=f"SHA-256 {weights.sha256[:16]}",
                got="another file, or none",
                fix=f"restore them, as `git checkout` does, {SUBMIT_ANEW}",
            )


def _require_same_method(
    folder: Folder, entry: Entry, header: Header, meta: Meta
) -> None:
    for name, expected, got in _labels_to_compare(folder, entry, header, meta):
        if expected != got:
            raise UsageError(
                f"the files differ from the entry in {name}",
                where=str(folder.path / entry.yaml_path),
                expected=quote(expected),
                got=quote(got),
                fix=f"{SUBMIT_APART}, by another --method; {SUBMIT_ANEW}",
            )


def _labels_to_compare(
    folder: Folder, entry: Entry, header: Header, meta: Meta
) -> Iterator[tuple[str, object, object]]:
    """Yield labels with their values in the entry and in the files.

    What the submitter states anew is not compared.
    """
    identity = read_score_file(folder.path / entry.score_paths[0]).scores.identity
    yield "method", identity["method"], header.method
    yield "dataset_sha256", entry.dataset.sha256, header.dataset_sha256
    if "parameters" not in meta.model_fields_set and header.parameters is not None:
        yield "parameters", entry.parameters, header.parameters
    if "training" not in meta.model_fields_set:
        trainings = _different_trainings([entry.provenance, header.provenance])
        if len(trainings) > 1:
            yield "training", trainings[0], trainings[1]


def _format_seeds(seeds: Iterable[int | None]) -> str:
    return ", ".join("none" if seed is None else str(seed) for seed in seeds)


def require_new(
    identities: Sequence[str], paths: Sequence[Path], owners: Mapping[str, str]
) -> None:
    """Refuse predictions that an entry or another of the files has.

    An identity is a content hash or a fingerprint; ``owners`` names the file or entry
    of the leaderboard that has it already.

    Raises:
        UsageError: these predictions are submitted already, or two files have the same.
    """
    path_of: dict[str, Path] = {}
    for identity, path in zip(identities, paths, strict=True):
        if identity in owners:
            raise UsageError(
                "these predictions are submitted already",
                where=str(path),
                expected="predictions that no entry and no other seed has",
                got=f"those of {owners[identity]}",
                fix="a further seed needs predictions of another training; what goes "
                "by a new name supersedes its old entry",
            )
        if identity in path_of:
            raise UsageError(
                "the predictions of several seeds are equal",
                where=str(path),
                expected="predictions of another training for each seed",
                got=f"those of {path_of[identity]}",
                fix="train with each seed, and predict with the weights of each "
                "training; or submit one of the files",
            )
        path_of[identity] = path
