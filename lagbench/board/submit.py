"""Score predictions and write the entry: ``lagbench submit``.

All files are written to a temporary folder of the leaderboard and then moved to their
places, the YAML file last. ``lagbench leaderboard build`` draws the page anew.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.data.hdf5 import check_file
from lagbench.data.registry import Registry, load
from lagbench.errors import UsageError, WorkFailedError, check_installed
from lagbench.models.onnx_model import check_onnx
from lagbench.references.table import REFERENCES
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.score_file import MAX_SCORE_BYTES, write_statistics
from lagbench.scoring.task import SUBMISSION
from lagbench.submission.format import WRITE, Header
from lagbench.submission.issues import ValidationResult
from lagbench.submission.predictions import open_predictions
from lagbench.submission.validation import validate as validate_predictions
from lagbench.work.run import Progress

from .entry import (
    LONGEST_TEXT,
    MOST_SEEDS,
    About,
    DataSet,
    Entry,
    EntryBudget,
    Meta,
    Prediction,
    ScoreBlock,
    Weights,
    entry_bytes,
    mean_cost,
    read_entry,
    today,
    validate,
)
from .folder import (
    Folder,
    Place,
    entry_path,
    score_paths,
    weights_path,
)
from .ranking import combine, scored_file, summarise
from .shift import SHIFT_SCORES
from .verified import VERIFICATIONS

BOARD = Path("leaderboard")  # the leaderboard's folder, from the root of the repository

TRAINING_LOG = "training.json"

LONGEST_NAME = 100

SHARED_LABELS = ("split", "size", "dataset_sha256", "method")
"""Labels of predictions that all seeds of a method share."""


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
    files: tuple[Path, ...]  # files that were written
    removed: tuple[Path, ...]  # files that only the entry before had


def submit(
    predictions: Sequence[str | Path],
    meta: Meta,
    *,
    weights: Sequence[str | Path] = (),
    board: str | Path = BOARD,
    root: str | Path | None = None,
    replace: bool = False,
    new_board: bool = False,
    workers: int | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
    examined: Callable[[ValidationResult], None] | None = None,
) -> SubmitResult:
    """Score predictions and write their entry and score files.

    Args:
        predictions: files of predictions, one per seed.
        meta: description of the method.
        weights: weights that made the predictions, at most one file per seed; they are
            copied to the leaderboard.
        board: the leaderboard's folder.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        replace: whether the entry replaces the one of that name.
        new_board: whether the folder may be a new one.
        workers: worker processes; by default one per core where the work is worth it.
        registry: where splits are described; ours when None.
        progress: called as the work advances.
        examined: called with the result of each validation.

    Raises:
        UsageError: authors or command are missing, the entry is there already, the
            files do not belong together, or no leaderboard.
        UnreadableFileError: predictions or weights cannot be read.
        ChecksFailedError: predictions are not valid, or the description does not fit.
        DataError: the test subset is missing, or the predictions were made from another
            data set.
        WorkFailedError: the disk is full or not writable, or a score file became too
            long.
    """
    folder = Folder(board)
    if not meta.authors or not meta.command:
        raise UsageError("an entry needs authors and command; write them to meta.yaml")
    if not 1 <= len(predictions) <= MOST_SEEDS:
        raise UsageError(f"submit takes 1 to {MOST_SEEDS} files, one per seed")
    if new_board:
        folder.require_room()
    else:
        folder.require()

    known = registry or load()
    paths = [Path(path) for path in predictions]
    headers = []
    validations = []
    for path in paths:
        check_file(path, fix=WRITE)
        validation = validate_predictions(
            path, root=root, require_truth=True, registry=registry
        )
        if examined is not None:
            examined(validation)
        validation.check()
        with open_predictions(path) as opened:
            header = opened.header
        if header.split not in known.splits:
            raise UsageError(
                f"{path}: {header.split} is a split of your own; a leaderboard takes "
                "those of lagbench, `lagbench score` takes yours too"
            )
        if header.subset != "test":
            raise UsageError(
                f"{path}: predictions of the subset {header.subset}; submit those of "
                "test"
            )
        provenance = header.provenance
        if provenance is not None and {"test", "shift"} & set(provenance.subsets):
            raise UsageError(f"{path}: the model was trained on scored scenarios")
        headers.append(header)
        validations.append(validation)
    for name in SHARED_LABELS:
        labels = {str(getattr(header, name)) for header in headers}
        if len(labels) > 1:
            raise UsageError(
                f"the files differ in {name}: {', '.join(sorted(map(ascii, labels)))}; "
                "submit each method on its own"
            )
    seeds = [header.seed for header in headers]
    if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
        raise UsageError(
            f"several files need different seeds, got {seeds}; write them with "
            "submission.write(..., seed=0), seed=1 and so on"
        )
    weights_by_seed = _pair_weights(headers, [Path(path) for path in weights])
    method = meta.method or headers[0].method
    if re.fullmatch("[a-z0-9]+(-[a-z0-9]+)*", method) is None or len(method) > 60:
        suggestion = re.sub("[^a-z0-9]+", "-", method.lower()).strip("-")[:60]
        raise UsageError(
            f"{method!a} cannot name an entry; name it: --method "
            f"{suggestion or 'my-model'}"
        )
    if method in REFERENCES:
        raise UsageError(
            f"{method} is the name of a reference predictor; name another: --method"
        )
    place = headers[0].split, headers[0].size, method
    if (folder.path / entry_path(place)).exists() and not replace:
        raise UsageError(
            f"the leaderboard has an entry {'/'.join(place)}; --replace replaces it, "
            "or name another --method"
        )
    # keys of meta, else of the predictions
    header = headers[0]
    keys = {name: getattr(meta, name) for name in About.model_fields}
    keys["name"] = meta.name or header.method[:LONGEST_NAME]
    keys["date"] = meta.date or today()
    keys["training"] = meta.training or (header.training or "")[:LONGEST_TEXT]
    if meta.parameters is None:
        keys["parameters"] = header.parameters
    if meta.cost is None:
        keys["cost"] = mean_cost(headers, meta.solver_seconds_per_frame)
    budgets = [header.budget for header in headers]
    mean_budget = EntryBudget.mean_over_seeds(header.size, budgets)
    if mean_budget is not None:
        keys["budget"] = mean_budget
    about = validate(About, keys, "the description")

    cards = []
    for path, validation in zip(paths, validations, strict=True):
        card = score(
            path,
            root=root,
            packages=False,  # an entry tells nothing of the submitter's packages
            workers=workers,
            registry=registry,
            progress=progress,
            write=False,
            validated=validation,
        )
        cards.append(card)
    try:
        with folder.lock():
            return _publish(
                folder, place, about, meta.urls, paths, cards, weights_by_seed
            )
    except OSError as error:
        raise WorkFailedError(
            f"cannot write {error.filename or folder.path}: {error.strerror}; free "
            "disk space, or name another folder: --board"
        ) from error


def _pair_weights(headers: Sequence[Header], paths: Sequence[Path]) -> dict[int, Path]:
    """Return files of weights by the seed that they hold; ONNX files in their order."""
    if len(paths) > len(headers):
        raise UsageError("more files of weights than predictions; give one per seed")
    weights = {}
    seeds = [header.seed or 0 for header in headers]
    for seed, path in zip(seeds, paths, strict=False):
        split = headers[0].split
        if path.suffix == ".onnx":
            found = check_onnx(path).split or split
        else:
            check_installed("torch", extra="baselines")
            from lagbench.baselines.checkpoint import load as load_weights

            checkpoint = load_weights(path)
            found = checkpoint.info.split
            seed = checkpoint.seed
        if found != split or seed not in seeds:
            raise UsageError(
                f"{path} holds weights of {found}, seed {seed}; the predictions are of "
                f"{split}, seeds {seeds}"
            )
        weights[seed] = path
    return weights


def _publish(
    folder: Folder,
    place: Place,
    about: About,
    urls: Sequence[str | None],
    predictions: Sequence[Path],
    cards: Sequence[ScoreCard],
    weights: Mapping[int, Path],
) -> SubmitResult:
    """Write the entry with its files; remove files that it no longer has."""
    previous = None
    if (folder.path / entry_path(place)).exists():
        previous = read_entry(folder.path / entry_path(place))
    with tempfile.TemporaryDirectory(prefix=".submit-", dir=folder.path) as scratch:
        copies: dict[Path, Path] = {}  # files that are moved to their places

        def stage(path: Path) -> Path:
            copies[path] = Path(scratch) / f"{len(copies)}{path.suffix}"
            return copies[path]

        submitted = []
        scored_files = []
        seeds = [card.header.seed for card in cards]
        score_files = score_paths(place, seeds)
        urls = urls or [None] * len(cards)
        for path, card, score_file, url in zip(
            predictions, cards, score_files, urls, strict=True
        ):
            copy = stage(score_file)
            write_statistics(card, copy, option="--board")
            if copy.stat().st_size > MAX_SCORE_BYTES:
                raise WorkFailedError(
                    f"the scores take more than {MAX_SCORE_BYTES} bytes; no "
                    "leaderboard takes a data set of so many scenarios"
                )
            scored_files.append(scored_file(card, copy))

            header = card.header
            source = weights.get(header.seed or 0)
            named_weights = None
            if source is not None:
                inner = source.resolve()
                board = folder.path.resolve()
                if inner.is_relative_to(board):
                    inner = inner.relative_to(board)
                else:
                    inner = weights_path(place, header.seed, source)
                    shutil.copyfile(source, stage(inner))
                    for log in (
                        source.with_suffix(".json"),
                        source.with_name(TRAINING_LOG),
                    ):
                        # the JSON file of `lagbench predict` about costs has no step
                        if log.is_file() and "step" in json.loads(log.read_bytes()):
                            shutil.copyfile(log, stage(inner.with_suffix(".json")))
                            break
                named_weights = Weights(
                    path=inner.as_posix(), sha256=file_sha256(source)
                )
            submitted.append(
                Prediction(
                    seed=header.seed,
                    sha256=card.predictions_sha256,
                    url=url,
                    bytes=path.stat().st_size,
                    budget=header.budget,
                    provenance=header.provenance,
                    weights=named_weights,
                )
            )
        tallies = [card.tallies[SUBMISSION] for card in cards]
        split, size, method = place
        header = cards[0].header
        entry = validate(
            Entry,
            {
                **dict(about),
                "format": 2,
                "split": split,
                "size": size,
                "method": method,
                "dataset": DataSet(
                    version=header.dataset_version, sha256=header.dataset_sha256
                ),
                "predictions": tuple(submitted),
                "score": ScoreBlock(
                    lagbench=version("lagbench"),
                    dataset_sha256=header.dataset_sha256,
                    ranking_metric=cards[0].ranking,
                    files=tuple(scored_files),
                    metrics=summarise(combine(tallies)),
                ),
            },
            "the entry",
        )
        stage(entry.yaml_path).write_bytes(entry_bytes(entry))
        for path, copy in copies.items():
            target = folder.path / path
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(copy, target)

    written = [folder.path / path for path in copies]
    for records in (VERIFICATIONS, SHIFT_SCORES):
        if records.remove_stale(folder, entry):
            written.append(folder.path / records.name)

    # scores and weights of the entry before that nothing names any more
    stale: set[Path] = set()
    if previous is not None:
        stale = set(previous.score_paths) - set(entry.score_paths)
        stale |= previous.weight_paths
        for path in folder.entries():
            stale -= read_entry(folder.path / path).weight_paths
    removed = []
    for path in sorted(stale):
        if (folder.path / path).is_file():
            (folder.path / path).unlink()
            removed.append(folder.path / path)
    summary = entry.score.metrics[entry.score.ranking_metric]
    return SubmitResult(
        split=split,
        size=size,
        method=method,
        ranking=entry.score.ranking_metric,
        mean=summary.mean,
        std=summary.std,
        flags=entry.flags,
        has_cost=entry.cost is not None,
        board=folder.path,
        # the entry first, although it is moved last
        files=tuple(reversed(written)),
        removed=tuple(removed),
    )
