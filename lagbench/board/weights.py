"""Weights beside their entries: ``lagbench submit --weights`` copies them,
``leaderboard check`` hashes them.

weights/<split>/<size>/<method>_<seed>.pt     parameters, as `lagbench predict` reads them
weights/<split>/<size>/<method>_<seed>.json   what the training recorded, where it did
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.data.checksums import file_sha256
from lagbench.errors import (
    UnreadableFileError,
    UsageError,
    check_installed,
    check_regular,
)
from lagbench.submission.findings import Finding
from lagbench.submission.format import Header

from .entry import Entry, Prediction, Status, Weights
from .entry_file import is_there
from .findings import finding
from .folder import Folder, Place, weights_path

if TYPE_CHECKING:
    from lagbench.baselines.checkpoint import Checkpoint

MOST_BYTES = 40_000_000
"""All weights of a leaderboard together [bytes]: git keeps every version of them for
good.
"""

# longest record of a training beside its weights [bytes]; those of ours take 3 kB
MOST_RECORD = 256 << 10

RECORD = "training.json"


def require_weights(
    weights: Sequence[str | Path],
    headers: Sequence[Header],
    others: Mapping[Path, Entry],
) -> tuple[Path | None, ...]:
    """Return the file of weights of each of the predictions, found by its seed, None
    where there is none.

    Refused are weights that cannot have made the predictions, that nothing says have,
    and those of another entry: they lie on the board already.
    """
    found: list[Path | None] = [None] * len(headers)
    if not weights:
        return tuple(found)
    length = sum(Path(path).stat().st_size for path in weights if Path(path).is_file())
    if length > MOST_BYTES:
        raise UsageError(
            "the weights are too large to lie beside entries",
            where="--weights",
            expected=f"at most {MOST_BYTES} bytes on the whole board",
            got=f"{length} bytes",
            fix="leave --weights out, and name a file of a release by `weights: "
            "https://...` in --from",
        )
    check_installed("torch", extra="baselines")
    from lagbench.baselines.checkpoint import load

    seeds = [header.seed or 0 for header in headers]
    lying = _holders(others)
    for path in map(Path, weights):
        held = load(path)
        if held.optimizer is not None:
            fix = "give weights.pt beside it, and predictions that were made with that"
            raise UsageError(
                "a state to go on from, not the weights of a model",
                where=str(path),
                fix=fix,
            )
        seed = held.training.get("recipe", {}).get("training", {}).get("seed", 0)
        belong = attrgetter("split", "size", "dataset_sha256")
        got = belong(held.info)
        expected = belong(headers[0])
        if got != expected or seed not in seeds:
            raise UsageError(
                "the weights do not belong to these predictions",
                where=str(path),
                expected=f"{expected[0]} {expected[1]}, data set {expected[2][:16]}, "
                f"seeds {seeds}",
                got=f"{got[0]} {got[1]}, data set {got[2][:16]}, seed {seed}",
                fix="leave them out; those of another size are named in --command",
            )
        number = seeds.index(seed)
        if found[number] is not None:
            fix = "give one of each seed at most"
            raise UsageError(
                f"two files of weights of seed {seed}", where=str(path), fix=fix
            )
        if (holder := lying.get(file_sha256(path))) is not None:
            fix = "leave them out, and name them in --command; or give those of this method"
            what = "these weights lie beside another entry"
            theirs = f"those of {holder}"
            raise UsageError(what, where=str(path), got=theirs, fix=fix)
        _require_made_by(path, held, headers[number])
        found[number] = path
    return tuple(found)


def _require_made_by(path: Path, held: Checkpoint, header: Header) -> None:
    """Refuse weights of which the predictions say nothing, or that others than these
    made.
    """
    from lagbench.baselines.checkpoint import count_rounded_parameters
    from lagbench.baselines.predict import fits, told_by_us, training_words

    words = header.training or ""
    said = header.parameters
    if said is None and not told_by_us(words):
        raise UsageError(
            "nothing says that these weights made the predictions",
            where=str(path),
            expected="predictions that state their training, or how many parameters "
            "the model has",
            fix="predict with these weights: lagbench predict; or leave them out",
        )
    count = count_rounded_parameters(held) or said
    if not fits(words, held) or said not in (None, count):
        raise UsageError(
            "the weights did not make these predictions",
            where=str(path),
            expected=f"{words!a}, {said} parameters",
            got=f"{training_words(held)!a}, {count} parameters of {held.baseline}",
            fix="give the weights that `lagbench predict` was given, or predict "
            "with these",
        )


def named_weights(
    folder: Folder,
    place: Place,
    made: Sequence[Prediction],
    paths: Sequence[Path | None],
    before: Entry | None,
    others: Mapping[Path, Entry],
) -> tuple[Weights | None, ...]:
    """Return what an entry says of each seed's weights; those of before stay unless
    something is wrong.
    """
    lying = _holders(others)
    kept = {
        (one.seed, one.sha256): one.weights
        for one in (before.predictions if before else ())
        if one.weights is not None
        and one.weights.sha256 not in lying
        and one.weights.path == weights_path(place, one.seed).as_posix()
        and is_there(folder, weights_path(place, one.seed), one.weights.sha256)
    }
    return tuple(
        kept.get((one.seed, one.sha256))
        if path is None
        else Weights(
            path=weights_path(place, one.seed).as_posix(), sha256=file_sha256(path)
        )
        for one, path in zip(made, paths, strict=True)
    )


def _holders(entries: Mapping[Path, Entry]) -> dict[str, str]:
    """Return the entries that have weights, by the SHA-256 of these."""
    held = [
        (made.weights, where)
        for where, entry in entries.items()
        for made in entry.predictions
    ]
    return {
        weights.sha256: str(where) for weights, where in held if weights is not None
    }


def stage_weights(
    stage: Path, named: Sequence[Weights | None], paths: Sequence[Path | None]
) -> Iterator[tuple[Path, Path]]:
    """Copy weights, and what their trainings recorded, to a folder; yield each place
    and its copy.
    """
    for number, (said, path) in enumerate(zip(named, paths, strict=True)):
        if said is None or path is None:
            continue
        sources = {Path(said.path): path}
        for record in (
            path.with_suffix(".json"),
            path.with_name(RECORD),
        ):  # of weights on a board; of a run
            # what predictions cost has no step
            if (
                record.is_file()
                and not unfit_record(record)
                and "step" in json.loads(record.read_bytes())
            ):
                sources[Path(said.path).with_suffix(".json")] = record
        for place, source in sources.items():
            yield (
                place,
                Path(shutil.copyfile(source, stage / f"{number}{place.suffix}")),
            )


def unfit_record(path: Path) -> str | None:
    """Return why a file cannot be the record of a training, None if it can."""
    try:
        check_regular(path, longest=MOST_RECORD)
        held = json.loads(path.read_bytes())
    except UnreadableFileError as error:
        return f"{error.what}: {error.got}"
    except (OSError, ValueError, RecursionError):
        return "no JSON"
    if isinstance(held, dict):
        return None
    return "no JSON object"


def check_weights(folder: Folder, entries: Sequence[Entry]) -> Iterator[Finding]:
    """Yield weights that are missing, edited, out of place, without an entry, or too
    many; unfit records.
    """
    known: set[Path] = set()
    holders: dict[str, Path] = {}
    for entry in entries:
        for number, made in enumerate(entry.predictions):
            if made.weights is None:
                continue
            where = f"{entry.yaml_path}, predictions.{number}.weights"
            path = weights_path(entry.place, made.seed)
            record = path.with_suffix(".json")  # its absence is no finding
            known |= {path, record}
            file = folder.path / path
            kept = folder.path / record
            if made.weights.path != path.as_posix():
                yield finding(
                    "weights", where, ascii(made.weights.path)[1:-1], expected=path
                )
            elif not file.is_file() or folder.link_in(path) is not None:
                yield finding("weights", where, "no such file", expected=path)
            elif (found := file_sha256(file)) != made.weights.sha256:
                said = made.weights.sha256[:16]
                yield finding(
                    "weights",
                    path,
                    f"SHA-256 {found[:16]}",
                    expected=f"{said} as the entry says",
                )
            elif (
                entry.status is Status.ACTIVE
                and (holder := holders.setdefault(found, path)) != path
            ):
                got = f"the same file as {holder}"
                yield finding(
                    "weights",
                    path,
                    got,
                    what="the same weights twice",
                    expected="one place",
                )
            linked = folder.link_in(record) is not None
            if (
                kept.exists()
                and not linked
                and (reason := unfit_record(kept)) is not None
            ):
                most = f"a JSON object of at most {MOST_RECORD} bytes, or no file"
                yield finding(
                    "weights",
                    record,
                    reason,
                    what="no record of a training",
                    expected=most,
                )
    held = folder.weight_files()
    for path in held:
        if path not in known:
            yield finding(
                "weights",
                path,
                "none",
                what="weights that no entry has",
                expected="an entry",
            )
    total = sum((folder.path / path).stat().st_size for path in held)
    if total > MOST_BYTES:
        fix = "keep larger ones as files of a release, and name them by `weights: https://...` in the entry"
        most = f"at most {MOST_BYTES} bytes in all"
        yield finding(
            "weights",
            "weights",
            f"{total} bytes",
            what="too many",
            expected=most,
            fix=fix,
        )
