"""Weights that several entries share: each active entry uses them in a way of its own.

A use is a file of weights, a data set and the options of the prediction. Options are
compared with the recipe in the weights: one that states what holds anyway is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from lagbench.errors import UsageError
from lagbench.submission.issues import ValidationIssue

from .entry import Entry, Status, Weights
from .entry_file import is_unchanged, read_entry_if_valid
from .folder import DEPTH, WEIGHTS, Folder, Place, entry_path
from .issues import make_issue


@dataclass(frozen=True, kw_only=True)
class Use:
    """How a prediction of an entry uses weights."""

    entry: Entry
    number: int  # of the prediction
    weights: Weights
    settings: tuple[str, ...]  # as the entry writes them

    @property
    def where(self) -> str:
        """Path of the entry, and the key of the weights in it."""
        return where_in(self.entry, self.number)

    @property
    def is_shared(self) -> bool:
        """Whether another entry keeps the weights."""
        return self.weights.shared_with is not None


def where_in(entry: Entry, number: int) -> str:
    """Return the path of an entry, and the key of the weights of a prediction."""
    return f"{entry.yaml_path}, predictions.{number}.weights"


def list_uses(entries: Sequence[Entry]) -> list[Use]:
    """Return how active entries use weights; those that keep the weights come first."""
    uses = []
    for entry in entries:
        if entry.status is not Status.ACTIVE:
            continue
        for number, prediction in enumerate(entry.predictions):
            if prediction.weights is None:
                continue
            use = Use(
                entry=entry,
                number=number,
                weights=prediction.weights,
                settings=entry.settings_of(prediction),
            )
            uses.append(use)
    return sorted(uses, key=lambda use: use.is_shared)


def find_keeper(folder: Folder, place: Place, path: Path) -> Entry | None:
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
        return entry
    return None


def require_weights_stay(folder: Folder, entry: Entry, previous: Entry | None) -> None:
    """Refuse to replace or remove weights that another entry shares.

    Raises:
        UsageError: another entry predicts with weights that would go.
    """
    if previous is None:
        return
    staying = {
        prediction.weights.sha256
        for prediction in entry.predictions
        if prediction.weights
    }
    keeper = "/".join(entry.place)
    for path in folder.entries():
        if path.parts[1] != entry.split or path == entry.yaml_path:
            continue
        other = read_entry_if_valid(folder.path / path)
        for prediction in () if other is None else other.predictions:
            weights = prediction.weights
            if weights is None or weights.shared_with != keeper:
                continue
            if weights.sha256 not in staying:
                raise UsageError(
                    "another entry predicts with the weights that would go",
                    where=str(folder.path / path),
                    expected=f"the weights {weights.sha256[:16]} of {keeper} stay",
                    got="other weights, or none",
                    fix="submit under a new --method, and set the old entry to "
                    "status: superseded",
                )


def check_sharing(
    entry: Entry, number: int, keepers: Mapping[Place, Entry]
) -> Iterator[ValidationIssue]:
    """Yield why a prediction may not share the weights that another entry keeps."""
    weights = entry.predictions[number].weights
    if weights is None or weights.shared_with is None:
        return
    where = where_in(entry, number)
    keeper = keepers.get(weights.place_of(entry.place))
    kept_hashes = set()
    for kept in () if keeper is None else keeper.predictions:
        if kept.weights is not None and kept.weights.shared_with is None:
            kept_hashes.add(kept.weights.sha256)
    if keeper is None or weights.sha256 not in kept_hashes:
        yield make_issue(
            "weights",
            where,
            f"{weights.shared_with} does not keep them",
            what="shared weights that their entry does not keep",
            expected="an entry with the same weights",
        )
    elif keeper.split != entry.split:
        yield make_issue(
            "weights",
            where,
            f"the weights of {weights.shared_with}",
            what="shared weights of another split",
            expected=f"weights of {entry.split}",
        )
    elif weights.path.endswith(".onnx") and keeper.size != entry.size:
        yield make_issue(
            "weights",
            where,
            f"the ONNX file of {weights.shared_with}",
            what="a shared ONNX file of another size",
            expected="weights of PyTorch, or a file of this entry",
        )


def check_uses(
    folder: Folder, entries: Sequence[Entry], *, isolated: bool
) -> Iterator[ValidationIssue]:
    """Yield shared weights that two active entries use in the same way."""
    groups: dict[tuple[str, str, str], list[Use]] = {}
    for use in list_uses(entries):
        key = (use.weights.sha256, use.entry.split, use.entry.size)
        groups.setdefault(key, []).append(use)
    compared = []
    for group in groups.values():
        if len(group) > 1 and any(use.is_shared for use in group):
            compared.append(group)

    uses = [use for group in compared for use in group]
    effective = _read_settings(folder, uses, isolated=isolated)
    for group in compared:
        first_uses: dict[tuple[str, ...], Use] = {}
        for use in group:
            first = first_uses.setdefault(effective[use.where], use)
            if first is not use and use.is_shared:
                yield make_issue(
                    "weights",
                    use.where,
                    f"used as in {first.entry.yaml_path}",
                    what="the same weights twice",
                    expected="another size, or options that change the model",
                )


def _read_settings(
    folder: Folder, uses: Sequence[Use], *, isolated: bool
) -> Mapping[str, tuple[str, ...]]:
    """Return the settings of uses that change the model, by place of the use.

    They are those that the entry writes where torch is not installed, or the weights
    are not those that the entry names: then another check finds them.
    """
    effective = {}
    read_uses = []
    requests = []
    for use in uses:
        path = Path(use.weights.path)
        effective[use.where] = tuple(sorted(set(use.settings)))
        if path.suffix == ".onnx":  # it has no options
            effective[use.where] = ()
        elif use.settings and is_unchanged(folder, path, use.weights.sha256):
            read_uses.append(use)
            requests.append((str((folder.path / path).absolute()), *use.settings))
    if not requests or find_spec("torch") is None:
        return effective

    from lagbench.baselines.weights_check import (
        read_effective_settings,
        read_in_child,
    )

    if isolated:
        answers = read_in_child(requests)
    else:
        answers = [read_effective_settings(request) for request in requests]
    for use, settings in zip(read_uses, answers, strict=True):
        effective[use.where] = tuple(settings)
    return effective
