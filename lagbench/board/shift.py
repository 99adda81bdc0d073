"""Scores on the subset ``shift``, leaderboard/shift.yaml.

``shift`` lies outside train on purpose. ``lagbench leaderboard shift`` predicts it with
the models of entries and writes the ranking metric of every scenario. A line holds
while the entry has the very models that the line names and the data are the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Annotated

import numpy as np
from pydantic import Field, RootModel

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry, Size
from lagbench.errors import ChecksFailedError, LagbenchError
from lagbench.metrics.aggregate import Score
from lagbench.metrics.table import METRICS
from lagbench.submission.issues import ValidationIssue

from .entry import Entry, Strict
from .entry_file import examine, format_issues, load_plain, yaml_bytes
from .fields import Hash, Label, RankingValue, Seed
from .folder import SHIFT, Folder, Place, entry_path
from .issues import issue_from_error, make_issue
from .lock import board_lock

SUBSET = "shift"

MOST_SHIFT_BYTES = 4_000_000
"""Longest file [bytes]; a model takes about 500."""


class ShiftModel(Strict):
    """The ranking metric of one model in each scenario of ``shift``."""

    seed: Seed | None = None
    model: Hash
    values: Annotated[dict[int, RankingValue], Field(min_length=1, max_length=1000)]


class ShiftScores(Strict):
    """The scores of an entry on ``shift``."""

    metric: Label
    dataset_sha256: Hash
    subset_sha256: Hash
    models: Annotated[
        tuple[ShiftModel, ...], Field(min_length=1, max_length=100, strict=False)
    ]


class ShiftFile(RootModel[dict[str, ShiftScores]]):
    """Entries by path, relative to the leaderboard's folder."""


def read_shift(folder: Folder) -> Mapping[str, ShiftScores]:
    """Return the scores on ``shift`` by path of the entry; empty without the file.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it holds something else.
    """
    path = folder.path / SHIFT
    if not path.exists() and not path.is_symlink():
        return {}
    content = load_plain(path, longest=MOST_SHIFT_BYTES)
    if content is None:
        content = {}
    shift, issues = examine(ShiftFile, content)
    if shift is None:
        raise ChecksFailedError(
            "the scores on shift do not fit",
            where=str(path),
            expected="what `lagbench leaderboard shift` writes",
            got=format_issues(issues),
            fix="restore the file, or write it anew: lagbench leaderboard shift",
        )
    return shift.root


def shift_of(
    entry: Entry, size: Size, shift: Mapping[str, ShiftScores]
) -> ShiftScores | None:
    """Return the scores of an entry on ``shift``.

    None without any, and where they belong to other data or models.
    """
    scores = shift.get(entry.yaml_path.as_posix())
    if scores is None or find_mismatch(entry, size, scores) is not None:
        return None
    return scores


def find_mismatch(entry: Entry, size: Size, scores: ShiftScores) -> str | None:
    """Return what of the scores does not belong to an entry, None where all does."""
    if scores.metric != entry.score.ranking_metric:
        return f"metric {scores.metric}"
    if size.measured is not None:
        subset_sha256 = size.measured.subset_sha256.get(SUBSET)
        is_current = scores.dataset_sha256 == size.measured.dataset_sha256
        if not is_current or scores.subset_sha256 != subset_sha256:
            return "scores of other data"
    hashes = {}  # of the entry's models, by seed
    for prediction in entry.predictions:
        if prediction.weights is not None:
            hashes[prediction.seed] = prediction.weights.sha256
    seeds = set()
    scenarios = sorted(size.subsets.get(SUBSET, ()))
    for model in scores.models:
        if hashes.get(model.seed) != model.model:
            return f"a model with SHA-256 {model.model[:16]}"
        if model.seed in seeds:
            return f"seed {model.seed} twice"
        if sorted(model.values) != scenarios:
            return f"seed {model.seed}: other scenarios"
        seeds.add(model.seed)
    return None


def scores_of_seeds(scores: ShiftScores) -> list[Score]:
    """Return the score of each seed, without values per frame."""
    seeds = []
    for model in scores.models:
        scenarios = tuple(sorted(model.values))
        values = [model.values[scenario] for scenario in scenarios]
        score = Score(
            metric=METRICS[scores.metric],
            scenarios=scenarios,
            frames=(),
            per_frame=np.empty((len(scenarios), 0)),
            values=np.array(values),
            undefined=(0,) * len(scenarios),
        )
        seeds.append(score)
    return seeds


def record_shift(
    folder: Folder,
    entry: Entry,
    size: Size,
    written: ShiftModel,
    *,
    subset_sha256: str,
) -> None:
    """Write the scores of one model; those of earlier models and data are let go.

    The file is read again under the lock, so that a record of somebody else stays.

    Args:
        folder: the leaderboard's folder.
        entry: the entry that has the model.
        size: the data set.
        written: the scores of the model.
        subset_sha256: hash of the files of ``shift``.
    """
    name = entry.yaml_path.as_posix()
    with board_lock(folder):
        shift = dict(read_shift(folder))
        present = shift_of(entry, size, shift)
        models = [written]
        if present is not None:
            for one in present.models:
                if one.seed != written.seed:
                    models.append(one)
        models.sort(key=lambda one: one.seed or 0)
        shift[name] = ShiftScores(
            metric=entry.score.ranking_metric,
            dataset_sha256=entry.dataset.sha256,
            subset_sha256=subset_sha256,
            models=tuple(models),
        )
        data = _file_bytes(shift)
        write_atomically(folder.path / SHIFT, data, option="--board")


def shift_without_stale_line(folder: Folder, entry: Entry) -> bytes | None:
    """Return shift.yaml without an entry's line for other models.

    None where the file has no such line.
    """
    shift = dict(read_shift(folder))
    name = entry.yaml_path.as_posix()
    scores = shift.get(name)
    if scores is None:
        return None
    models = set()
    for prediction in entry.predictions:
        if prediction.weights is not None:
            models.add((prediction.seed, prediction.weights.sha256))
    if all((one.seed, one.model) in models for one in scores.models):
        return None
    del shift[name]
    return _file_bytes(shift)


def check_shift(
    folder: Folder,
    entries: Sequence[Entry],
    registry: Registry,
    *,
    unreadable_places: Set[Place] = frozenset(),
) -> Iterator[ValidationIssue]:
    """Yield lines that belong to no entry, or to other models, data or scenarios.

    Lines of entries that cannot be read are passed over.
    """
    try:
        shift = read_shift(folder)
    except LagbenchError as error:
        yield issue_from_error("shift", error, SHIFT)
        return
    by_path = {entry.yaml_path.as_posix(): entry for entry in entries}
    unreadable_names = {entry_path(place).as_posix() for place in unreadable_places}
    for name, scores in shift.items():
        if name in unreadable_names:
            continue
        where = f"{SHIFT}, {ascii(name)[1:-1][:120]}"
        entry = by_path.get(name)
        if entry is None:
            yield make_issue("shift", where, "no such entry")
            continue
        mismatch = find_mismatch(entry, registry.size(entry.split, entry.size), scores)
        if mismatch is not None:
            yield make_issue("shift", where, mismatch)


def _file_bytes(shift: Mapping[str, ShiftScores]) -> bytes:
    lines = {}
    for name, scores in sorted(shift.items()):
        lines[name] = scores.model_dump()
    return yaml_bytes(lines)
