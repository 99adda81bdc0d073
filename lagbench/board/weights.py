"""Models beside their entries: weights of a training, or an ONNX file.

``lagbench submit --weights`` copies them, ``leaderboard check`` hashes them,
``leaderboard reproduce`` runs them.

weights/<split>/<size>/<method>_<seed>.pt     parameters, which `lagbench predict` reads
weights/<split>/<size>/<method>_<seed>.safetensors   or weights with their recipe
weights/<split>/<size>/<method>_<seed>.onnx   or a model of another code base
weights/<split>/<size>/<method>_<seed>.json   the log of the training, where it has one

An entry may share the weights of another one: it predicts with them at another size,
or with other options, such as the mean over mirror images. Then no second copy is kept.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.errors import (
    UnreadableFileError,
    UsageError,
    check_installed,
    check_regular,
)
from lagbench.submission.format import Header
from lagbench.submission.issues import ValidationIssue
from lagbench.submission.provenance import TrainingProvenance

from .entry import Entry, Prediction, Status, Weights
from .entry_file import MOST_FILE_BYTES, is_unchanged, read_entry_if_valid
from .folder import DEPTH, WEIGHTS, Folder, Place, entry_path, weights_path
from .issues import make_issue

MOST_BYTES = 60_000_000
"""All weights of a leaderboard together [bytes]: git keeps every version of them for
good.
"""

# longest log of a training beside its weights [bytes]; ours take 3 kB
MOST_LOG_BYTES = 256 << 10

TRAINING_LOG = "training.json"


@dataclass(frozen=True, kw_only=True)
class WeightsFile:
    """A file of weights that a submitter gives."""

    path: Path
    sha256: str
    is_state: bool  # a state to go on from, with an optimiser
    baseline: str
    data_set: tuple[str, str, str]  # split, size and SHA-256
    seed: int
    provenance: TrainingProvenance
    parameters: int | None  # None where the weights are not rounded

    def describe_data_set(self) -> str:
        """Return split, size, data set and seed in words."""
        return f"{_describe_data_set(self.data_set)}, seed {self.seed}"


def _describe_data_set(data_set: tuple[str, str, str]) -> str:
    split, size, sha256 = data_set
    return f"{split} {size}, data set {sha256[:16]}"


def inspect_weights(path: Path) -> WeightsFile:
    """Read a file of weights; nothing in it is run.

    Raises:
        UnreadableFileError: the file is damaged or no weights.
        UsageError: torch is not installed.
    """
    check_installed("torch", extra="baselines")
    from lagbench.baselines.checkpoint import count_rounded_parameters, load
    from lagbench.baselines.provenance import training_provenance
    from lagbench.baselines.weights_check import check_in_child

    if path.suffix == ".safetensors":
        check_in_child(path)
    checkpoint = load(path)
    info = checkpoint.info
    recipe = checkpoint.training.get("recipe", {})
    return WeightsFile(
        path=path,
        sha256=file_sha256(path),
        is_state=checkpoint.optimizer is not None,
        baseline=checkpoint.baseline,
        data_set=(info.split, info.size, info.dataset_sha256),
        seed=recipe.get("training", {}).get("seed", 0),
        provenance=training_provenance(checkpoint),
        parameters=count_rounded_parameters(checkpoint) or None,
    )


def find_keeper(folder: Folder, place: Place, path: Path) -> Place | None:
    """Return the other entry beside which a file of weights lies on this board.

    None where the file lies elsewhere, or beside the entry of this place.
    """
    board = folder.path.resolve()
    whole_path = path.resolve()
    if not whole_path.is_relative_to(board):
        return None
    inner_path = whole_path.relative_to(board)
    if len(inner_path.parts) != DEPTH or inner_path.parts[0] != WEIGHTS:
        return None
    _, split, size, _ = inner_path.parts
    method, _, _ = inner_path.stem.rpartition("_")
    keeper = (split, size, method)
    if keeper == place:
        return None
    entry = read_entry_if_valid(folder.path / entry_path(keeper))
    if entry is not None and inner_path in entry.files:
        return keeper
    return None


def require_weights(
    weights: Sequence[str | Path],
    headers: Sequence[Header],
    rivals: Mapping[Path, Entry],
    *,
    folder: Folder,
    place: Place,
) -> tuple[Path | None, ...]:
    """Return the weights of each of the predictions, by seed; None where it has none.

    Args:
        weights: files of weights, or of ONNX models.
        headers: of the predictions.
        rivals: other active entries of the data set, by path.
        folder: the leaderboard.
        place: split, size and method of the entry.

    Raises:
        UsageError: the weights are too large, cannot have made the predictions, nothing
            says that they have, or another entry has them and predicts in the same way.
        UnreadableFileError: a file is no file of weights.
    """
    paths = [Path(path) for path in weights]
    _require_small(paths)

    seeds = [header.seed or 0 for header in headers]
    owners = _owners_of_weights(rivals)
    chosen: list[Path | None] = [None] * len(headers)
    for path in paths:
        if path.suffix == ".onnx":
            if find_keeper(folder, place, path) is not None:
                raise _owned_error(path, "the entry beside it")
            index = chosen.index(None) if None in chosen else 0
            _require_onnx(path, headers[index], owners)
            chosen[index] = path
            continue
        file = inspect_weights(path)
        is_shared = find_keeper(folder, place, path) is not None
        _require_fit(file, headers[0], seeds, any_size=is_shared)
        index = seeds.index(file.seed)
        if chosen[index] is not None:
            raise UsageError(
                f"two files of weights of seed {file.seed}",
                where=str(path),
                expected="one file for each seed",
                got=f"two of seed {file.seed}",
                fix="give one of each seed at most",
            )
        is_owned = is_shared or file.sha256 in owners
        if is_owned and not (is_shared and _predicts_otherwise(file, headers[index])):
            raise _owned_error(path, owners.get(file.sha256, "the entry beside it"))
        _require_made_by(file, headers[index])
        chosen[index] = path
    return tuple(chosen)


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


def _require_onnx(path: Path, header: Header, owners: Mapping[str, str]) -> None:
    """Refuse an ONNX file that cannot be run, or is another entry's or seed's.

    ONNX files belong to the predictions in their order.
    """
    from lagbench.models.onnx_model import check_onnx

    declared = check_onnx(path)
    owner = owners.get(file_sha256(path))
    if owner is not None:
        raise _owned_error(path, owner)
    if header.parameters is not None and header.parameters != declared.parameters:
        raise UsageError(
            "the model did not make these predictions",
            where=str(path),
            expected=f"{header.parameters} parameters",
            got=f"{declared.parameters} parameters",
            fix="predict with this file: lagbench predict",
        )


def _owned_error(path: Path, owner: str) -> UsageError:
    return UsageError(
        "these weights lie beside another entry",
        where=str(path),
        expected="weights that no other entry has, or predictions of another size or "
        "with other options (lagbench predict --set)",
        got=f"those of {owner}",
        fix="give those of this method; to share them, give the file that lies on the "
        "board, and predictions that another option or size made",
    )


def _predicts_otherwise(file: WeightsFile, header: Header) -> bool:
    """Return whether predictions differ from what the weights predict by themselves."""
    _, size, _ = file.data_set
    if header.size != size:
        return True
    return header.provenance is not None and bool(
        header.provenance.prediction_overrides
    )


def _require_fit(
    file: WeightsFile, header: Header, seeds: Sequence[int], *, any_size: bool
) -> None:
    """Refuse a training state, and weights of another data set or seed.

    Shared weights may be those of another size of the split.
    """
    if file.is_state:
        raise UsageError(
            "this is a checkpoint of a training, not the weights of a model",
            where=str(file.path),
            expected="weights.pt",
            got="a checkpoint of a training",
            fix="give the weights.pt beside it, and predictions that it made",
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
            got=file.describe_data_set(),
            fix="leave them out; of those of another size give the file that lies on "
            "the board",
        )


def _require_made_by(file: WeightsFile, header: Header) -> None:
    """Refuse weights that did not make the predictions, or of which nothing says so."""
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

    Predictions without new weights keep those of the previous entry, where these lie
    unchanged in their place and are nobody else's.
    """
    previous_weights = _sound_weights(folder, place, previous, rivals)
    named: list[Weights | None] = []
    for prediction, path in zip(predictions, paths, strict=True):
        if path is None:
            key = (prediction.seed, prediction.sha256)
            named.append(previous_weights.get(key))
        else:
            keeper = find_keeper(folder, place, path)
            inner_path = weights_path(keeper or place, prediction.seed, path)
            named.append(
                Weights(
                    path=inner_path.as_posix(),
                    sha256=file_sha256(path),
                    shared_with=None if keeper is None else "/".join(keeper),
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

    The entry's own words about them are not believed.
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
    """Return which entry holds each file of weights.

    The path of the entry is found by the SHA-256 of the weights.
    """
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
        Path of each copy, by its place in the leaderboard's folder.
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
    """Return the log beside weights on a board, else that beside weights of a run."""
    training_log = None
    for candidate in (path.with_suffix(".json"), path.with_name(TRAINING_LOG)):
        if not candidate.is_file() or reason_unfit_log(candidate) is not None:
            continue
        # the JSON file that `lagbench predict` writes about costs has no step
        if "step" in json.loads(candidate.read_bytes()):
            training_log = candidate
    return training_log


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
    folder: Folder, entries: Sequence[Entry]
) -> Iterator[ValidationIssue]:
    """Yield weights that are missing, edited, misplaced, without an entry or too many.

    Unfit logs of trainings are reported, too; a log that is not there is no issue.
    """
    keepers = {entry.place: entry for entry in entries}
    known_paths: set[Path] = set()
    uses: dict[tuple[object, ...], Path] = {}  # of shared weights, by active entries
    active_paths: dict[str, Path] = {}  # by SHA-256
    for entry in entries:
        for number, prediction in enumerate(entry.predictions):
            weights = prediction.weights
            if weights is None:
                continue
            where = f"{entry.yaml_path}, predictions.{number}.weights"
            place = weights.place_of(entry.place)
            path = weights_path(place, prediction.seed, weights.path)
            if weights.shared_with is not None:
                yield from _check_sharing(entry, prediction, keepers.get(place), where)
                use = _use_of_shared(entry, prediction)
                first_user = entry.yaml_path
                if entry.status is Status.ACTIVE:
                    first_user = uses.setdefault(use, entry.yaml_path)
                if first_user != entry.yaml_path:
                    yield make_issue(
                        "weights",
                        where,
                        f"used as in {first_user}",
                        what="the same weights twice",
                        expected="other options, or another size",
                    )
                yield from _check_weights_file(folder, path, weights, where=where)
                continue
            log = path.with_suffix(".json")
            known_paths |= {path, log}
            yield from _check_weights_file(folder, path, weights, where=where)
            yield from _check_log(folder, log)

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

    lying_paths = folder.weight_files()
    for path in lying_paths:
        if path not in known_paths:
            yield make_issue(
                "weights",
                path,
                "none",
                what="weights that no entry has",
                expected="an entry",
            )
    lengths = []
    for path in lying_paths:
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


def _use_of_shared(entry: Entry, prediction: Prediction) -> tuple[object, ...]:
    """Return what tells one use of shared weights from another."""
    provenance = prediction.provenance or entry.provenance
    options: tuple[str, ...] = ()
    if provenance is not None:
        options = tuple(sorted(set(provenance.prediction_overrides)))
    sha256 = None if prediction.weights is None else prediction.weights.sha256
    return sha256, entry.split, entry.size, options


def _check_sharing(
    entry: Entry, prediction: Prediction, keeper: Entry | None, where: str
) -> Iterator[ValidationIssue]:
    """Yield why an entry may not share the weights that another one keeps."""
    weights = prediction.weights
    if weights is None:
        return
    kept_hashes = set()
    for kept in () if keeper is None else keeper.predictions:
        if kept.weights is not None and kept.weights.shared_with is None:
            kept_hashes.add(kept.weights.sha256)
    if weights.sha256 not in kept_hashes:
        yield make_issue(
            "weights",
            where,
            f"{weights.shared_with} does not keep them",
            what="shared weights that their entry does not keep",
            expected="an entry with the same weights",
        )
    provenance = prediction.provenance or entry.provenance
    has_options = provenance is not None and bool(provenance.prediction_overrides)
    is_other_size = (
        keeper is not None and keeper.split == entry.split and keeper.size != entry.size
    )
    is_same_data = keeper is not None and keeper.place[:2] == entry.place[:2]
    is_onnx = weights.path.endswith(".onnx")  # it has no options
    if is_onnx or not (is_other_size or (is_same_data and has_options)):
        yield make_issue(
            "weights",
            where,
            f"the weights of {weights.shared_with}, used as there",
            what="the same weights twice",
            expected="weights of PyTorch; predictions of another size, or with other "
            "options",
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
