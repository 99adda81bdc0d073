"""How entries use weights. No two active entries use shared ones in the same way.

A use of weights consists of the file, the data set and the options of the prediction.
Some options change nothing: they repeat a value of the recipe in the weights, or its
default. Such options do not make two uses different.

The *keeper* of weights is the entry beside which their file lies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.errors import UsageError
from lagbench.submission.issues import ValidationIssue

from .entry import Entry, Status, Weights
from .entry_file import read_entry_if_valid
from .folder import DEPTH, WEIGHTS, Folder, Place, entry_path
from .issues import make_issue


@dataclass(frozen=True, kw_only=True)
class WeightsUse:
    """How a prediction of an entry uses weights."""

    entry: Entry
    number: int  # of the prediction in the entry
    weights: Weights
    settings: tuple[str, ...]  # options of the prediction, as the entry writes them

    @property
    def where(self) -> str:
        """Path of the entry, and the key of the weights in it, for messages."""
        return weights_key(self.entry, self.number)

    @property
    def is_shared(self) -> bool:
        """Whether the keeper of the weights is another entry."""
        return self.weights.shared_with is not None


@dataclass(frozen=True, kw_only=True)
class CheckedSettings:
    """Options of a prediction, as the model of its weights takes them."""

    # those that change the model, in one form and order
    effective: tuple[str, ...]
    refused: str | None = None  # why the model does not take them


def weights_key(entry: Entry, number: int) -> str:
    """Return path and key of the weights of a prediction, for messages."""
    return f"{entry.yaml_path}, predictions.{number}.weights"


def list_uses(entries: Sequence[Entry]) -> list[WeightsUse]:
    """Return how active entries use weights; uses by keepers come first."""
    uses = []
    for entry in entries:
        if entry.status is not Status.ACTIVE:
            continue
        for number, prediction in enumerate(entry.predictions):
            if prediction.weights is None:
                continue
            use = WeightsUse(
                entry=entry,
                number=number,
                weights=prediction.weights,
                settings=entry.settings_of(prediction),
            )
            uses.append(use)
    return sorted(uses, key=lambda use: use.is_shared)


def find_keeper(folder: Folder, place: Place, path: Path) -> Entry | None:
    """Return the entry that keeps a file of weights on this board.

    Returns:
        None where the file lies elsewhere, where no entry names it, or where its keeper
        is the entry of this place.
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
    keeper_place = (split, size, method)
    if keeper_place == place:
        return None
    keeper = read_entry_if_valid(folder.path / entry_path(keeper_place))
    if keeper is not None and inner_path in keeper.files:
        return keeper
    return None


def require_weights_stay(folder: Folder, entry: Entry, previous: Entry | None) -> None:
    """Refuse an entry without the weights of its previous version that others share.

    Raises:
        UsageError: another entry predicts with weights that the entry lacks.
    """
    if previous is None:
        return
    kept_hashes = set()
    for prediction in entry.predictions:
        if prediction.weights is not None:
            kept_hashes.add(prediction.weights.sha256)
    keeper_name = "/".join(entry.place)
    for path in folder.entries():
        if path.parts[1] != entry.split or path == entry.yaml_path:
            continue
        other = read_entry_if_valid(folder.path / path)
        if other is None:
            continue
        for prediction in other.predictions:
            weights = prediction.weights
            if weights is None or weights.shared_with != keeper_name:
                continue
            if weights.sha256 not in kept_hashes:
                raise UsageError(
                    "another entry predicts with the weights that would go",
                    where=str(folder.path / path),
                    expected=f"the weights {weights.sha256[:16]} of {keeper_name} stay",
                    got="other weights, or none",
                    fix="submit under a new --method, and set the old entry to "
                    "status: superseded",
                )


def check_sharing(
    entry: Entry, number: int, entries_by_place: Mapping[Place, Entry]
) -> Iterator[ValidationIssue]:
    """Yield why a prediction may not share the weights that another entry keeps.

    Args:
        entry: the entry that shares them.
        number: the prediction in it.
        entries_by_place: all entries.
    """
    weights = entry.predictions[number].weights
    if weights is None or weights.shared_with is None:
        return
    where = weights_key(entry, number)
    keeper = entries_by_place.get(weights.place_of(entry.place))
    if keeper is None or weights.sha256 not in _hashes_of_kept_weights(keeper):
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


def _hashes_of_kept_weights(keeper: Entry) -> set[str]:
    """Return the SHA-256 of the weights that lie beside an entry."""
    hashes = set()
    for prediction in keeper.predictions:
        weights = prediction.weights
        if weights is not None and weights.shared_with is None:
            hashes.add(weights.sha256)
    return hashes


def check_uses(entries: Sequence[Entry]) -> Iterator[ValidationIssue]:
    """Yield options that models do not have, and weights used in the same way twice."""
    groups: dict[tuple[str, str, str], list[WeightsUse]] = {}
    uses = list_uses(entries)
    checked_settings = _check_settings(uses)
    for use in uses:
        refused = checked_settings[use.where].refused
        if refused is not None:
            yield make_issue(
                "weights",
                f"{use.entry.yaml_path}, predictions.{use.number}.provenance."
                "prediction_overrides",
                ascii(refused)[1:-1][:200],
                what="options of the prediction that the model does not take",
                expected="options of the model in the weights, as `lagbench predict "
                "--set` takes them",
                fix="submit what `lagbench predict` wrote, or leave the weights out",
            )
            continue
        key = (use.weights.sha256, use.entry.split, use.entry.size)
        groups.setdefault(key, []).append(use)

    for group in groups.values():
        first_uses: dict[tuple[str, ...], WeightsUse] = {}  # by effective settings
        for use in group:
            effective = checked_settings[use.where].effective
            first_use = first_uses.setdefault(effective, use)
            if first_use is not use and use.is_shared:
                yield make_issue(
                    "weights",
                    use.where,
                    f"used as in {first_use.entry.yaml_path}",
                    what="the same weights twice",
                    expected="another size, or options that change the model",
                )


def _check_settings(uses: Sequence[WeightsUse]) -> Mapping[str, CheckedSettings]:
    """Return the settings of each use as the entry writes them, by ``use.where``."""
    settings_of_uses = {}
    for use in uses:
        written = tuple(sorted(set(use.settings)))
        settings_of_uses[use.where] = CheckedSettings(effective=written)
    return settings_of_uses
