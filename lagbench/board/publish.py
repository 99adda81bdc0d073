"""Write an entry with its score files and weights, whole or not at all.

All files are written to a staging folder first, then a journal of what is to be moved
and removed, then they are moved to their places, the YAML file last, which names the
others by SHA-256. A kill before the journal is written leaves the leaderboard as it
was; after a kill between two moves the next submission completes them
(:func:`complete_interrupted`). Both happen under the lock of the leaderboard.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from lagbench.atomic import move_together, write_atomically
from lagbench.errors import UsageError, WorkFailedError
from lagbench.metrics.aggregate import Tally
from lagbench.scoring.boards import SUBMISSIONS
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import SUBMISSION
from lagbench.scoring.score_file_checks import MAX_SCORE_BYTES, read_score_file
from lagbench.scoring.score_file_writer import write_statistics
from lagbench.submission.other_files import MODEL_ENDINGS

from .draft import Draft, PredictionsFile, require_valid
from .entry import DataSet, Entry, Prediction, ScoreBlock, ScoredFile
from .entry_file import entry_bytes, read_entry_if_valid
from .folder import (
    REFERENCES,
    SHIFT,
    STAGING,
    VERIFIED,
    Folder,
    entry_path,
    is_place_of_file,
    score_paths,
)
from .ranking import combine, scored_file, summarise, write_references
from .sharing import require_weights_stay
from .shift import shift_without_stale_line
from .verified import list_without_stale_line
from .weights import copy_weights, name_weights

JOURNAL = "journal.json"
"""List of moves and removals; once it is there, the entry counts as submitted."""

LONGEST_JOURNAL = 100_000  # bytes


@dataclass(frozen=True, kw_only=True)
class SubmitResult:
    """An entry that was written."""

    split: str
    size: str
    method: str
    ranking: str  # name of the ranking metric
    mean: float | None  # of it over scenarios and seeds; None where undefined
    std: float | None  # over seeds; None for one seed
    flags: tuple[str, ...]  # names of flags that were raised
    has_cost: bool  # whether the entry states the time of a frame
    board: Path
    # files that were written; verified.yaml, where the entry before had a line there
    files: tuple[Path, ...]
    # scores, weights and training logs of the entry before that are those of this one
    kept: tuple[Path, ...]
    removed: tuple[Path, ...]  # files that only the entry before had


def publish(
    draft: Draft,
    files: Sequence[PredictionsFile],
    cards: Sequence[ScoreCard],
    folder: Folder,
) -> SubmitResult:
    """Write the entry of a draft with its files; remove files that it no longer has.

    A full disk is met before anything of the previous entry is touched.

    Raises:
        UsageError: the entry has changed meanwhile, or a place is behind a link.
        WorkFailedError: a score file is too long.
        OSError: the disk is full or not writable.
    """
    previous = read_entry_if_valid(folder.path / entry_path(draft.place))
    if draft.extended is not None and previous != draft.extended:
        raise UsageError(
            "the entry changed while the files were scored",
            where=str(entry_path(draft.place)),
            expected="the entry as it was before",
            got="another one",
            fix="submit again; what others added meanwhile stays",
        )

    (folder.path / SUBMISSIONS).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=STAGING, dir=folder.path) as scratch:
        staging = Path(scratch)
        predictions = [*_kept_predictions(draft), *draft.predictions]
        staged_scores = _stage_scores(draft, predictions, cards, folder, staging)
        predictions = _with_weights(draft, predictions, folder, previous)
        entry = _form_entry(draft, predictions, files, cards, staged_scores)
        require_weights_stay(folder, entry, previous)

        moves = _moves_of_scores(draft, staged_scores)
        moves |= _stage_weights(draft, entry, staging)
        moves |= _stage_texts(entry, folder, staging)
        removed = _find_files_to_remove(entry, previous, moves, folder)
        parents = []
        for path in removed:
            parents.append(path.relative_to(folder.path).parent)
        folder.require_unlinked(
            [
                *moves,
                *parents,
                Path(REFERENCES, entry.split, entry.size),
            ]
        )
        references = write_references(cards[0], folder)
        _write_journal(staging, moves, removed, folder)
        copies_and_places = []
        for path, copy in moves.items():
            copies_and_places.append((copy, folder.path / path))
        move_together(copies_and_places)
        for path in removed:
            path.unlink()

    # the entry first, although it is moved last
    written = [folder.path / entry.yaml_path]
    for path in moves:
        if path != entry.yaml_path:
            written.append(folder.path / path)
    return _result_of(
        entry,
        board=folder.path,
        written=(*written, *references),
        kept=_find_kept_files(entry, moves, removed, folder),
        removed=removed,
    )


def _write_journal(
    staging: Path, moves: Mapping[Path, Path], removed: Sequence[Path], folder: Folder
) -> None:
    """Write down what is to be moved and removed, before any of it is done."""
    steps = []
    for path, copy in moves.items():
        steps.append([copy.relative_to(staging).as_posix(), path.as_posix()])
    removals = []
    for path in removed:
        removals.append(path.relative_to(folder.path).as_posix())
    content = json.dumps({"moves": steps, "removed": removals})
    write_atomically(staging / JOURNAL, content.encode(), option="--board")


def complete_interrupted(folder: Folder) -> None:
    """Complete or undo what killed submissions began. Call it under the lock.

    What a journal of strangers names outside the places of entries, score files and
    weights is not touched.
    """
    for staging in folder.staging_folders():
        if staging.is_symlink() or not staging.is_dir():
            staging.unlink()
            continue
        moves, removed = _read_journal(staging)
        folder.require_unlinked([*moves, *removed])
        copies_and_places = []
        for path, copy in moves.items():
            if copy.is_file() and not copy.is_symlink():
                copies_and_places.append((copy, folder.path / path))
        move_together(copies_and_places)
        for path in removed:
            if path not in moves:
                (folder.path / path).unlink(missing_ok=True)
        shutil.rmtree(staging)


def _read_journal(staging: Path) -> tuple[dict[Path, Path], list[Path]]:
    """Return copies by their places, and places to clear; nothing without a journal."""
    journal = staging / JOURNAL
    if journal.is_symlink() or not journal.is_file():
        return {}, []
    moves = {}
    removed = []
    try:
        with journal.open("rb") as file:
            content = json.loads(file.read(LONGEST_JOURNAL))
        for name, place in content["moves"]:
            if is_place_of_file(Path(place)):
                moves[Path(place)] = staging / Path(name).name
        for place in content["removed"]:
            if is_place_of_file(Path(place)):
                removed.append(Path(place))
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}, []
    return moves, removed


def _kept_predictions(draft: Draft) -> tuple[Prediction, ...]:
    if draft.extended is None:
        return ()
    return draft.extended.predictions


def _kept_score_paths(draft: Draft) -> tuple[Path, ...]:
    if draft.extended is None:
        return ()
    return draft.extended.score_paths


def _stage_scores(
    draft: Draft,
    predictions: Sequence[Prediction],
    cards: Sequence[ScoreCard],
    folder: Folder,
    staging: Path,
) -> dict[Path, Path]:
    """Write the score files of all seeds to the staging folder.

    Seeds that stay keep their score files, under new names where they had but one.

    Returns:
        Path of each copy, by its place in the leaderboard's folder.
    """
    seeds = [prediction.seed for prediction in predictions]
    staged = {}
    for path in score_paths(draft.place, seeds):
        staged[path] = staging / path.name
    copies = list(staged.values())
    kept_paths = _kept_score_paths(draft)
    for kept_path, copy in zip(kept_paths, copies, strict=False):
        shutil.copyfile(folder.path / kept_path, copy)
    for card, copy in zip(cards, copies[len(kept_paths) :], strict=True):
        write_statistics(card, copy, option="--board")
        _require_short(copy, card)
    return staged


def _require_short(path: Path, card: ScoreCard) -> None:
    length = path.stat().st_size
    if length > MAX_SCORE_BYTES:
        raise WorkFailedError(
            "the score file is too long",
            where=f"{card.header.split} {card.header.size}",
            expected=f"at most {MAX_SCORE_BYTES} bytes",
            got=f"{length} bytes",
            fix="no leaderboard takes a data set of so many scenarios and frames: "
            "submit predictions of a smaller size",
        )


def _with_weights(
    draft: Draft,
    predictions: Sequence[Prediction],
    folder: Folder,
    previous: Entry | None,
) -> list[Prediction]:
    """Return predictions that name their weights."""
    named = name_weights(
        folder=folder,
        place=draft.place,
        predictions=predictions,
        paths=_all_weight_paths(draft),
        previous=previous,
        rivals=draft.rivals,
    )
    updated = []
    for prediction, weights in zip(predictions, named, strict=True):
        updated.append(prediction.model_copy(update={"weights": weights}))
    return updated


def _all_weight_paths(draft: Draft) -> list[Path | None]:
    """Return the new weights of each prediction: None for seeds that stay."""
    return [*(None for _ in _kept_predictions(draft)), *draft.weight_paths]


def _form_entry(
    draft: Draft,
    predictions: Sequence[Prediction],
    files: Sequence[PredictionsFile],
    cards: Sequence[ScoreCard],
    staged_scores: Mapping[Path, Path],
) -> Entry:
    """Return the entry with its score block."""
    header = cards[0].header
    copies = list(staged_scores.values())
    kept_count = len(_kept_predictions(draft))

    # score files hold rounded statistics, and score cards have the same
    tallies: list[Mapping[int, Tally]] = []
    scored_files: list[ScoredFile] = []
    reason = ""
    if draft.extended is not None:
        reason = draft.extended.reason
        scored_files += draft.extended.score.files
        for copy in copies[:kept_count]:
            tallies.append(read_score_file(copy).scores.tallies)
    for file, card, copy in zip(files, cards, copies[kept_count:], strict=True):
        scored_files.append(scored_file(card, copy, file.outside_share))
        tallies.append(card.tallies[SUBMISSION])

    score_block = ScoreBlock(
        lagbench=version("lagbench"),
        dataset_sha256=header.dataset_sha256,
        ranking_metric=cards[0].ranking,
        files=tuple(scored_files),
        metrics=summarise(combine(tallies)),
    )
    split, size, method = draft.place
    keys = {
        **dict(draft.about),
        "format": 2,
        "split": split,
        "size": size,
        "method": method,
        "reason": reason,
        "dataset": DataSet(
            version=header.dataset_version, sha256=header.dataset_sha256
        ),
        "predictions": tuple(predictions),
        "score": score_block,
    }
    return require_valid(Entry, keys)


def _moves_of_scores(
    draft: Draft, staged_scores: Mapping[Path, Path]
) -> dict[Path, Path]:
    """Return the score files to move; those that lie there already are the same."""
    kept_paths = _kept_score_paths(draft)
    new_scores = {}
    for path, copy in staged_scores.items():
        if path not in kept_paths:
            new_scores[path] = copy
    return new_scores


def _stage_weights(draft: Draft, entry: Entry, staging: Path) -> dict[Path, Path]:
    named = [prediction.weights for prediction in entry.predictions]
    return copy_weights(staging, named, _all_weight_paths(draft))


def _stage_texts(entry: Entry, folder: Folder, staging: Path) -> dict[Path, Path]:
    """Write the lists that lose a line, and the entry, which comes last."""
    # a method may be called verified, so copies have names of their own
    copies = {}
    verified = list_without_stale_line(folder, entry)
    if verified is not None:
        copies[Path(VERIFIED)] = staging / "0.yaml"
        copies[Path(VERIFIED)].write_bytes(verified)
    shift = shift_without_stale_line(folder, entry)
    if shift is not None:
        copies[Path(SHIFT)] = staging / "2.yaml"
        copies[Path(SHIFT)].write_bytes(shift)
    copies[entry.yaml_path] = staging / "1.yaml"
    copies[entry.yaml_path].write_bytes(entry_bytes(entry))
    return copies


def _find_files_to_remove(
    entry: Entry,
    previous: Entry | None,
    moves: Mapping[Path, Path],
    folder: Folder,
) -> tuple[Path, ...]:
    """Return the files that the new entry does not have, by their whole paths.

    New weights without a training log leave no old log beside them.
    """
    stale_paths: set[Path] = set()
    if previous is not None:
        stale_paths = set(previous.files) - set(entry.files)
    for path in moves:
        log = path.with_suffix(".json")
        if path.suffix in MODEL_ENDINGS and log not in moves:
            stale_paths.add(log)
    whole_paths = []
    for path in sorted(stale_paths):
        whole_path = folder.path / path
        if os.path.lexists(whole_path):
            whole_paths.append(whole_path)
    return tuple(whole_paths)


def _find_kept_files(
    entry: Entry,
    moves: Mapping[Path, Path],
    removed: Sequence[Path],
    folder: Folder,
) -> tuple[Path, ...]:
    """Return the files of the entry that stay as they are, by their whole paths.

    Not all weights have a training log.
    """
    kept_paths = []
    for path in entry.files:
        whole_path = folder.path / path
        if path in moves or whole_path in removed:
            continue
        if os.path.lexists(whole_path):
            kept_paths.append(whole_path)
    return tuple(kept_paths)


def _result_of(
    entry: Entry,
    *,
    board: Path,
    written: tuple[Path, ...],
    kept: tuple[Path, ...],
    removed: tuple[Path, ...],
) -> SubmitResult:
    score = entry.score
    summary = score.metrics[score.ranking_metric]
    flags: dict[str, None] = {}
    for file in score.files:
        for flag in file.flags:
            flags[flag.name] = None
    return SubmitResult(
        split=entry.split,
        size=entry.size,
        method=entry.method,
        ranking=score.ranking_metric,
        mean=summary.mean,
        std=summary.std,
        flags=tuple(flags),
        has_cost=entry.cost is not None,
        board=board,
        files=written,
        kept=kept,
        removed=removed,
    )
