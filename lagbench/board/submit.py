"""Score predictions and write the entry: ``lagbench submit``.

All or nothing: the YAML file and the score files of all seeds appear together, after every
seed was scored. The board's page is not touched; ``lagbench leaderboard build`` draws it.
"""

from __future__ import annotations

import datetime
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError, WorkFailedError
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.score_file import write_statistics
from lagbench.submission import ValidationResult
from lagbench.work.progress import Progress

from .draft import Draft, check_needed, draft_of, headers_of
from .entry import About, DataSet, Entry, PredictionEntry
from .entry_file import examine, read_entry, spell_entry
from .floor_predictions import write_floor
from .folder import Folder, entry_path, score_paths
from .meta import Meta
from .publishing import batch
from .scored import score_block, scored_file
from .seeds import combine, summarise
from .stored import MAX_SCORE_BYTES, read_stored

__all__ = ["BOARD", "SubmitResult", "submit", "submit_floor"]

BOARD = Path("leaderboard")
"""The leaderboard's folder, from the root of the repository."""


@dataclass(frozen=True, kw_only=True)
class SubmitResult:
    """An entry that was written."""

    split: str  # name of the split
    size: str  # name of the size
    method: str  # id of the method
    ranking: str  # name of the ranking metric
    mean: float | None  # of the ranking metric over scenarios and seeds; None where undefined
    std: float | None  # over seeds; None for one seed
    flags: tuple[str, ...]  # names of flags that were raised
    files: tuple[Path, ...]  # what was written, the YAML file first


def submit(
    predictions: Sequence[str | Path],
    meta: Meta,
    *,
    board: str | Path = BOARD,
    root: str | Path | None = None,
    replace: bool = False,
    workers: int | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
    examined: Callable[[ValidationResult], None] | None = None,
) -> SubmitResult:
    """Score predictions and write their entry and score files.

    Args:
        predictions: one predictions.nc per seed.
        meta: what is said of the method.
        board: the leaderboard's folder.
        root: folder of all data sets.
        replace: whether an entry of that name may be replaced.
        workers: worker processes of the scorer.
        registry: where splits are described; ours when None.
        progress: told how far the scoring is.
        examined: told what the validation of each file found.

    Raises:
        UsageError: a key is missing, the entry is there already, the files do not belong
            together, or the method has the name of a floor.
        UnreadableFileError: predictions cannot be read.
        ChecksFailedError: they are not valid.
        DataError: the test subset is missing, or they were made from another data set.
        WorkFailedError: the disk is full or not writable, or a score file became too long.
    """
    check_needed(meta)
    folder, paths = Folder(board), [Path(path) for path in predictions]
    headers = headers_of(paths, root=root, registry=registry, examined=examined)
    draft = draft_of(headers, meta, folder, replace=replace)
    cards = [
        score(path, root=root, workers=workers, registry=registry, progress=progress, write=False)
        for path in paths
    ]
    made = [
        PredictionEntry(
            seed=seed,
            sha256=card.predictions_sha256,
            url=url,
            path=_inner_path(path, folder),
            bytes=path.stat().st_size,
        )
        for card, path, seed, url in zip(cards, paths, draft.seeds, draft.urls, strict=True)
    ]
    return _publish(draft, cards, made, folder)


def submit_floor(
    name: str,
    *,
    split: str,
    size: str = "full",
    board: str | Path = BOARD,
    root: str | Path | None = None,
    date: datetime.date | None = None,
    workers: int | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> SubmitResult:
    """Predict with a floor of the scorer, score that and write its entry, or write it anew.

    Args:
        name: persistence or constant-velocity.
        split: name of the split.
        size: name of the size.
        board: the leaderboard's folder.
        root: folder of all data sets.
        date: date of the entry; today by default.
        workers: worker processes of the scorer.
        registry: where splits are described; ours when None.
        progress: told how far the scoring is.

    Raises:
        UsageError: an unknown floor, split or size.
        DataError: the test subset is missing or damaged.
        WorkFailedError: the disk is full or not writable.
    """
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "predictions.nc"
        write_floor(name, path, split=split, size=size, root=root, registry=registry)
        card = score(path, root=root, workers=workers, registry=registry, progress=progress, write=False)
    about = About(
        name=name,
        authors=("lagbench",),
        licence="MIT",
        date=date or datetime.datetime.now(datetime.UTC).date(),
        training="none",
        parameters=0,
        notes="A floor: what costs nothing and every model should beat.",
        command=f"lagbench submit --floor {name} --split {split} --size {size}",
    )
    draft = Draft(place=(split, size, name), about=about, seeds=(None,), urls=(None,), scored_by="lagbench")
    return _publish(draft, [card], [PredictionEntry(sha256=card.predictions_sha256)], Folder(board))


def _publish(
    draft: Draft, cards: Sequence[ScoreCard], made: Sequence[PredictionEntry], folder: Folder
) -> SubmitResult:
    """Write score files and entry, all together; remove those of the entry that they replace."""
    names, yaml_path = score_paths(draft.place, draft.seeds), entry_path(draft.place)
    before = _score_files_of(folder, yaml_path)
    with batch(folder.path) as files:
        staged = [files.prepare(name) for name in names]
        for card, target in zip(cards, staged, strict=True):
            write_statistics(card, target)
            _check_length(target, card)
        entry = _entry(draft, cards, made, staged)
        files.prepare(yaml_path).write_bytes(spell_entry(entry))
        files.publish(remove=before)
    summary = entry.score.metrics[entry.score.ranking_metric]
    split, size, method = draft.place
    return SubmitResult(
        split=split,
        size=size,
        method=method,
        ranking=entry.score.ranking_metric,
        mean=summary.mean,
        std=summary.std,
        flags=tuple(dict.fromkeys(flag.name for file in entry.score.files for flag in file.flags)),
        files=tuple(folder.path / name for name in (yaml_path, *names)),
    )


def _entry(
    draft: Draft, cards: Sequence[ScoreCard], made: Sequence[PredictionEntry], staged: Sequence[Path]
) -> Entry:
    """Return the entry with the score block that follows from the score files."""
    split, size, method = draft.place
    header = cards[0].header
    dataset = DataSet(version=header.dataset_version, sha256=header.dataset_sha256)
    block = score_block(
        draft.place,
        dataset,
        made,
        [scored_file(card, target) for card, target in zip(cards, staged, strict=True)],
        summarise(combine([read_stored(target).scores for target in staged])),
        about=draft.about,
        ranking=cards[0].ranking,
        scored_by=draft.scored_by,
    )
    held = {"format": 1, "split": split, "size": size, "method": method}
    held |= {name: getattr(draft.about, name) for name in About.model_fields}
    entry, mistakes = examine(Entry, {**held, "dataset": dataset, "predictions": tuple(made), "score": block})
    if entry is None:
        raise ChecksFailedError("the entry does not fit the schema", got="\n    ".join(map(str, mistakes)))
    return entry


def _score_files_of(folder: Folder, yaml_path: Path) -> tuple[Path, ...]:
    """Return the score files of the entry that is there, so that none is left over."""
    if not (folder.path / yaml_path).exists():
        return ()
    return read_entry(folder.path / yaml_path).score_paths


def _inner_path(path: Path, folder: Folder) -> str | None:
    """Return a path relative to the leaderboard's folder, None for a file outside it."""
    inside, outside = path.resolve(), folder.path.resolve()
    return inside.relative_to(outside).as_posix() if inside.is_relative_to(outside) else None


def _check_length(path: Path, card: ScoreCard) -> None:
    length = path.stat().st_size
    if length > MAX_SCORE_BYTES:
        raise WorkFailedError(
            "the score file is too long",
            where=f"{card.header.split} {card.header.size}",
            expected=f"at most {MAX_SCORE_BYTES} bytes",
            got=f"{length} bytes",
            fix="uninstall packages that add metrics, and submit again",
        )
