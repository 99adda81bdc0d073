"""Models beside their entries: weights of a training, or an ONNX file.

``lagbench submit --weights`` copies them, ``leaderboard check`` hashes them, and
``leaderboard reproduce`` runs them. A model is one of these files:

weights/<split>/<size>/<method>_<seed>.safetensors   weights of `lagbench train`
weights/<split>/<size>/<method>_<seed>.onnx          a model of another code base

A file with the ending .json beside it is the log of the training.

An entry may share the weights of another entry (:mod:`.sharing`). It predicts with them
at another size, or with other options, such as the mean over mirror images. Or it takes
the place of an inactive entry. In each case the file lies on the board only once.
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.data.checksums import file_sha256
from lagbench.errors import (
    UnreadableFileError,
    UsageError,
    check_installed,
    check_regular,
)
from lagbench.models.onnx_model import check_onnx
from lagbench.references.predictor import Kind
from lagbench.submission.format import Header
from lagbench.submission.issues import ValidationIssue

from .entry import Entry, Prediction, Status, Weights
from .entry_file import MOST_FILE_BYTES, is_unchanged
from .folder import Folder, Place, weights_path
from .issues import make_issue
from .sharing import (
    WeightsUse,
    check_sharing,
    check_uses,
    find_keeper,
    list_uses,
    weights_key,
)

if TYPE_CHECKING:
    from lagbench.baselines.weights_file import WeightsFile

MOST_BYTES = 40_000_000
"""All weights of a leaderboard together [bytes]: git keeps every version of them for
good.
"""

# longest log of a training beside its weights [bytes]; ours take 3 kB
MOST_LOG_BYTES = 256 << 10

TRAINING_LOG = "training.json"

HYBRID_BASELINES = ("hybrid-projection", "hybrid-coarse")
"""Our baselines that contain a solver; those of packages are not known."""


class LogLeftOutWarning(UserWarning):
    """A file beside submitted weights is no log of a training, and is not published."""


def require_weights(
    weights: Sequence[str | Path],
    headers: Sequence[Header],
    rivals: Mapping[Path, Entry],
    *,
    folder: Folder,
    place: Place,
    kind: Kind | None,
) -> tuple[Path | None, ...]:
    """Return the weights of each of the predictions, by seed; None where it has none.

    Args:
        weights: files of weights, or of ONNX models.
        headers: of the predictions.
        rivals: other active entries of the data set, by path.
        folder: the leaderboard.
        place: split, size and method of the entry.
        kind: what the submitter says of the method; None where it is not known.

    Raises:
        UsageError: the weights are too large, or more files than predictions; they did
            not make the predictions, or the predictions do not say so; another entry
            has the weights and predicts with them in the same way; they are those of
            a hybrid, and the kind is another one; or torch is not installed.
        UnreadableFileError: a file is no file of weights.
    """
    paths = [Path(path) for path in weights]
    _require_small(paths)
    if len(paths) > len(headers):
        raise UsageError(
            "more files of weights than predictions",
            where="--weights",
            expected=f"at most {len(headers)}, one for each prediction",
            got=str(len(paths)),
            fix="give the files of the models that made these predictions",
        )

    seeds = [header.seed or 0 for header in headers]
    owners = _owners_of_weights(rivals)
    uses = list_uses([*rivals.values()])
    chosen: list[Path | None] = [None] * len(headers)
    for path in paths:
        keeper = find_keeper(folder, place, path)
        if path.suffix == ".onnx":
            index = chosen.index(None)
            _require_onnx(path, headers[index], uses, keeper)
            chosen[index] = path
            continue
        file = _inspect_weights(path)
        _require_kind(file, kind)
        _require_fit(file, headers[0], seeds, any_size=keeper is not None)
        index = seeds.index(file.seed)
        if chosen[index] is not None:
            raise UsageError(
                f"two files of weights of seed {file.seed}",
                where=str(path),
                expected="one file for each seed",
                got=f"two of seed {file.seed}",
                fix="give one of each seed at most",
            )
        if file.sha256 in owners and keeper is None:
            raise _error_of_owned_weights(path, owners[file.sha256])
        _require_made_by(file, headers[index])
        chosen[index] = path
    return tuple(chosen)


def _inspect_weights(path: Path) -> WeightsFile:
    check_installed("torch", extra="baselines")
    from lagbench.baselines.weights_file import inspect_weights

    return inspect_weights(path)


def _describe_data_set(data_set: tuple[str, str, str]) -> str:
    split, size, sha256 = data_set
    return f"{split} {size}, data set {sha256[:16]}"


def _require_small(paths: Sequence[Path]) -> None:
    length = sum(path.stat().st_size for path in paths if path.is_file())
    if length > MOST_BYTES:
        raise UsageError(
            "the weights are too large to lie beside entries",
            where="--weights",
            expected=f"at most {MOST_BYTES} bytes on the whole board",
            got=f"{length} bytes",
            fix="leave --weights out, and name a file of a release by `weights: "
            "https://...` in --from",
        )


def _require_onnx(
    path: Path, header: Header, uses: Sequence[WeightsUse], keeper: Entry | None
) -> None:
    """Refuse an ONNX file that cannot be run, or that belongs to another prediction.

    ONNX files are given in the order of the predictions. An ONNX file has no options.
    So an entry can share it only with an inactive entry of the same data set and seed.
    """
    declared = check_onnx(path)
    if declared.split not in (None, header.split):
        raise UsageError(
            "the model states another split",
            where=str(path),
            expected=header.split,
            got=declared.split,
            fix="give the file of the model that made these predictions",
        )
    sha256 = file_sha256(path)
    for use in uses:
        if use.weights.sha256 == sha256:
            raise _error_of_owned_weights(path, str(use.entry.yaml_path))
    if keeper is not None:
        data_set = (header.split, header.size)
        kept_path = weights_path(keeper.place, header.seed, path)
        if keeper.place[:2] != data_set or kept_path.name != path.name:
            raise _error_of_owned_weights(path, str(keeper.yaml_path))
    if header.parameters is not None and header.parameters != declared.parameters:
        raise UsageError(
            "the model did not make these predictions",
            where=str(path),
            expected=f"{header.parameters} parameters",
            got=f"{declared.parameters} parameters",
            fix="predict with this file: lagbench predict",
        )


def _error_of_owned_weights(path: Path, owner: str) -> UsageError:
    return UsageError(
        "these weights lie beside another entry",
        where=str(path),
        expected="weights that lie beside no other entry",
        got=f"those of {owner}",
        fix="give those of this method; to share them, give the file that lies on the "
        "board, and predictions that another option or size made",
    )


def _settings_of(header: Header) -> tuple[str, ...]:
    """Return the options that a prediction changed."""
    if header.provenance is None:
        return ()
    return header.provenance.prediction_overrides


def _require_kind(file: WeightsFile, kind: Kind | None) -> None:
    """Refuse weights of a hybrid for an entry that states another kind."""
    is_hybrid = file.baseline in HYBRID_BASELINES
    if is_hybrid and kind not in (Kind.HYBRID, None):
        raise UsageError(
            "the weights are those of a hybrid, and the entry states another kind",
            where=f"kind in --from meta.yaml, and {file.path}",
            expected="kind: hybrid",
            got=f"kind: {kind}, and weights of the baseline {file.baseline}",
            fix="write kind: hybrid in meta.yaml",
        )


def _require_fit(
    file: WeightsFile, header: Header, seeds: Sequence[int], *, any_size: bool
) -> None:
    """Refuse a training state, and weights of another data set or seed.

    Args:
        file: the weights.
        header: of the predictions.
        seeds: of the predictions.
        any_size: whether the weights may be of another size of the split; shared ones
            may.
    """
    if file.is_state:
        raise UsageError(
            "this is a checkpoint of a training, not the weights of a model",
            where=str(file.path),
            expected="weights.safetensors",
            got="a checkpoint of a training",
            fix="give the weights.safetensors beside it, and predictions that it made",
        )
    data_set = (header.split, header.size, header.dataset_sha256)
    is_of_data = file.data_set == data_set
    if any_size and file.data_set[1] != header.size:
        is_of_data = file.data_set[0] == header.split
    if not is_of_data or file.seed not in seeds:
        raise UsageError(
            "the weights do not belong to these predictions",
            where=str(file.path),
            expected=f"{_describe_data_set(data_set)}, seeds {seeds}",
            got=f"{_describe_data_set(file.data_set)}, seed {file.seed}",
            fix="leave them out; of those of another size give the file that lies on "
            "the board",
        )


def _require_made_by(file: WeightsFile, header: Header) -> None:
    """Refuse weights that did not make the predictions.

    Predictions must state their training or their number of parameters, as evidence.
    """
    if header.parameters is None and header.provenance is None:
        raise UsageError(
            "nothing says that these weights made the predictions",
            where=str(file.path),
            expected="predictions that state their training, or how many parameters "
            "the model has",
            got="predictions that state neither",
            fix="predict with these weights: lagbench predict; or leave them out",
        )

    is_same_training = (
        header.provenance is None
        or header.provenance.training_only() == file.provenance
    )
    is_same_count = (
        header.parameters is None
        or file.parameters is None
        or header.parameters == file.parameters
    )
    if not is_same_training or not is_same_count:
        parameters = file.parameters or header.parameters
        raise UsageError(
            "the weights did not make these predictions",
            where=str(file.path),
            expected=f"{header.training or ''!a}, {header.parameters} parameters",
            got=f"{file.provenance.describe()!a}, {parameters} parameters of "
            f"{file.baseline}",
            fix="give the weights that `lagbench predict` was given, or predict "
            "with these",
        )


def name_weights(
    *,
    folder: Folder,
    place: Place,
    predictions: Sequence[Prediction],
    paths: Sequence[Path | None],
    previous: Entry | None,
    rivals: Mapping[Path, Entry],
) -> tuple[Weights | None, ...]:
    """Return the weights that an entry names for each of its predictions.

    A prediction without new weights keeps those of the previous entry, if they lie
    unchanged in their place and no other entry keeps them.

    Args:
        folder: the leaderboard.
        place: split, size and method of the entry.
        predictions: of the entry.
        paths: new weights of each prediction; None where there are none.
        previous: the entry as it was before, None for a new one.
        rivals: other active entries of the data set, by path.
    """
    previous_weights = _sound_weights(folder, place, previous, rivals)
    named: list[Weights | None] = []
    for prediction, path in zip(predictions, paths, strict=True):
        if path is None:
            key = (prediction.seed, prediction.sha256)
            named.append(previous_weights.get(key))
        else:
            keeper = find_keeper(folder, place, path)
            shared_with = None
            keeper_place = place
            if keeper is not None:
                keeper_place = keeper.place
                shared_with = "/".join(keeper_place)
            inner_path = weights_path(keeper_place, prediction.seed, path)
            named.append(
                Weights(
                    path=inner_path.as_posix(),
                    sha256=file_sha256(path),
                    shared_with=shared_with,
                )
            )
    return tuple(named)


def _sound_weights(
    folder: Folder,
    place: Place,
    previous: Entry | None,
    rivals: Mapping[Path, Entry],
) -> dict[tuple[int | None, str], Weights]:
    """Return the weights of the previous entry that may stay, by seed and predictions.

    Path and hash are checked on the disk, because an entry is written by its submitter.
    """
    if previous is None:
        return {}
    owners = _owners_of_weights(rivals)
    sound = {}
    for prediction in previous.predictions:
        weights = prediction.weights
        if weights is None:
            continue
        path = weights_path(weights.place_of(place), prediction.seed, weights.path)
        is_shared = find_keeper(folder, place, folder.path / path) is not None
        if (
            (is_shared or weights.sha256 not in owners)
            and weights.path == path.as_posix()
            and is_unchanged(folder, path, weights.sha256)
        ):
            sound[prediction.seed, prediction.sha256] = weights
    return sound


def _owners_of_weights(entries: Mapping[Path, Entry]) -> dict[str, str]:
    """Return the path of the entry that keeps each file of weights, by its SHA-256."""
    owners = {}
    for path, entry in entries.items():
        for prediction in entry.predictions:
            weights = prediction.weights
            if weights is not None and weights.shared_with is None:
                owners[weights.sha256] = str(path)
    return owners


def copy_weights(
    staging: Path, named: Sequence[Weights | None], paths: Sequence[Path | None]
) -> dict[Path, Path]:
    """Copy weights and the logs of their trainings to the staging folder.

    Returns:
        Path of each copy, by the path that it gets in the leaderboard's folder.
    """
    copies = {}
    for number, (weights, path) in enumerate(zip(named, paths, strict=True)):
        if weights is None or path is None or weights.shared_with is not None:
            continue
        sources = {Path(weights.path): path}
        log = _find_training_log(path)
        if log is not None:
            sources[Path(weights.path).with_suffix(".json")] = log
        for place, source in sources.items():
            copies[place] = staging / f"{number}{place.suffix}"
            shutil.copyfile(source, copies[place])
    return copies


def _find_training_log(path: Path) -> Path | None:
    """Return the log of a training, None where weights have none.

    It has the name of the weights, as on a board. Without such a file it is
    training.json, as in the folder of a run. A :class:`LogLeftOutWarning` tells of a
    file that can be no log.
    """
    for candidate in (path.with_suffix(".json"), path.with_name(TRAINING_LOG)):
        if not candidate.is_file():
            continue
        reason = reason_unfit_log(candidate)
        if reason is not None:
            message = f"{candidate} is left out, for it is no log of a training: "
            warnings.warn(message + reason, LogLeftOutWarning, stacklevel=2)
            continue
        # the JSON file that `lagbench predict` writes about costs has no step
        if "step" in json.loads(candidate.read_bytes()):
            return candidate
    return None


def reason_unfit_log(path: Path) -> str | None:
    """Return why a file cannot be the log of a training, None if it can."""
    try:
        check_regular(path, longest=MOST_LOG_BYTES)
        content = json.loads(path.read_bytes())
    except UnreadableFileError as error:
        return f"{error.what}: {error.got}"
    except (OSError, ValueError, RecursionError):
        return "no JSON"
    if isinstance(content, dict):
        return None
    return "no JSON object"


def check_weights(
    folder: Folder,
    entries: Sequence[Entry],
    *,
    unreadable_places: Set[Place] = frozenset(),
) -> Iterator[ValidationIssue]:
    """Yield what is wrong with the weights of a board.

    Weights may be missing, edited, misplaced, without an entry or too many, or two
    active entries use them in the same way. Logs of trainings that are no logs are
    reported too. A model needs no log.

    Args:
        folder: the leaderboard.
        entries: entries that fit the schema.
        unreadable_places: places of entries that cannot be read: nothing is said of
            their weights.
    """
    keepers = {entry.place: entry for entry in entries}
    known_paths: set[Path] = set()
    active_paths: dict[str, Path] = {}  # by SHA-256
    for entry in entries:
        for number, prediction in enumerate(entry.predictions):
            weights = prediction.weights
            if weights is None:
                continue
            where = weights_key(entry, number)
            place = weights.place_of(entry.place)
            path = weights_path(place, prediction.seed, weights.path)
            yield from _check_weights_file(folder, path, weights, where=where)
            if weights.shared_with is not None:
                if place not in unreadable_places:
                    yield from check_sharing(entry, number, keepers)
                continue
            log = path.with_suffix(".json")
            known_paths |= {path, log}
            yield from _check_log(folder, log)
            yield from _check_kind(folder, log, entry.kind, where=where)

            is_active = entry.status is Status.ACTIVE
            if is_active and is_unchanged(folder, path, weights.sha256):
                first_path = active_paths.setdefault(weights.sha256, path)
                if first_path != path:
                    yield make_issue(
                        "weights",
                        path,
                        f"the same file as {first_path}",
                        what="the same weights twice",
                        expected="one place",
                    )
    yield from check_uses(entries)

    stored_paths = folder.weight_files()
    for path in stored_paths:
        method = path.stem.rpartition("_")[0]
        owner = (path.parts[1], path.parts[2], method)
        if path not in known_paths and owner not in unreadable_places:
            yield make_issue(
                "weights",
                path,
                "none",
                what="weights that no entry has",
                expected="an entry",
            )
    lengths = []
    for path in stored_paths:
        lengths.append((folder.path / path).stat().st_size)
    total = sum(lengths)
    if total > MOST_BYTES:
        yield make_issue(
            "weights",
            "weights",
            f"{total} bytes",
            what="too many weights",
            expected=f"at most {MOST_BYTES} bytes in all",
            fix="keep larger ones as files of a release, and name them by `weights: "
            "https://...` in the entry",
        )


def _check_weights_file(
    folder: Folder, path: Path, weights: Weights, *, where: str
) -> Iterator[ValidationIssue]:
    file = folder.path / path
    if weights.path != path.as_posix():
        yield make_issue("weights", where, ascii(weights.path)[1:-1], expected=path)
    elif not file.is_file() or folder.link_in(path) is not None:
        yield make_issue("weights", where, "no such file", expected=path)
    elif file.stat().st_size > MOST_FILE_BYTES:
        length = f"{file.stat().st_size} bytes"
        most = f"at most {MOST_FILE_BYTES} bytes"
        yield make_issue("weights", path, length, expected=most)
    else:
        sha256 = file_sha256(file)
        if sha256 != weights.sha256:
            yield make_issue(
                "weights",
                path,
                f"SHA-256 {sha256[:16]}",
                expected=f"{weights.sha256[:16]} as the entry says",
            )


def _check_kind(
    folder: Folder, log: Path, kind: Kind, *, where: str
) -> Iterator[ValidationIssue]:
    """Yield that weights are those of a hybrid and the entry says otherwise.

    The log of a training names the baseline.
    """
    file = folder.path / log
    if not file.exists() or folder.link_in(log) is not None:
        return
    if reason_unfit_log(file) is not None:
        return
    baseline = json.loads(file.read_bytes()).get("baseline")
    if baseline in HYBRID_BASELINES and kind is not Kind.HYBRID:
        yield make_issue(
            "training",
            where,
            f"kind: {kind}",
            what=f"weights of {baseline}, which is a hybrid",
            expected="kind: hybrid",
        )


def _check_log(folder: Folder, path: Path) -> Iterator[ValidationIssue]:
    file = folder.path / path
    if not file.exists() or folder.link_in(path) is not None:
        return
    reason = reason_unfit_log(file)
    if reason is not None:
        yield make_issue(
            "weights",
            path,
            reason,
            what="no log of a training",
            expected=f"a JSON object of at most {MOST_LOG_BYTES} bytes, or no file",
        )
