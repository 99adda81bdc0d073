"""Describe a submission: draft its entry, and refuse what does not fit the files."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lagbench.errors import UsageError, UsageErrorCollector
from lagbench.references.predictor import Kind
from lagbench.references.table import REFERENCES as KNOWN_REFERENCES
from lagbench.submission.budget import Budget
from lagbench.submission.format import Header
from lagbench.submission.provenance import TrainingProvenance

from .draft import Draft, PredictionsFile, find_entries_to_differ_from, require_valid
from .entry import About, Entry, EntryBudget, Meta, Prediction, mean_cost
from .entry_checks import find_contradiction, find_training_fault
from .entry_file import examine, read_rivals
from .fields import LONGEST_TEXT, latest_date
from .folder import Folder, Place, entry_path
from .identity import confusable_key
from .seeds import require_extendable, require_new, seeds_of
from .verified import read_verified
from .weights import require_weights

LONGEST_LABEL = 100  # letters of the label of predictions that become a name

DESCRIBED_KEYS = tuple(
    name for name in About.model_fields if name not in ("budget", "date")
)
"""Keys of the description of a method that stay when seeds are added."""


def draft_entry(
    files: Sequence[PredictionsFile],
    meta: Meta,
    *,
    folder: Folder,
    weights: Sequence[str | Path],
    replace: bool,
    add: bool,
) -> Draft:
    """Return the draft of an entry.

    Usage errors are raised together. Any other error, and that of predictions that are
    submitted already, is raised alone.
    """
    headers = [file.header for file in files]
    rivals: dict[Path, Entry] = {}
    extended = None
    place = (headers[0].split, headers[0].size, "")  # until the method is known

    errors = UsageErrorCollector()
    with errors:
        seeds = seeds_of(headers)
    with errors:
        urls = _urls_of(meta, len(files))
    with errors:
        place = _place_of(headers[0], meta)
        rivals = read_rivals(folder, place)
        if add:
            extended = require_extendable(folder, place, headers, meta)
        elif not replace:
            _require_no_entry(folder, place)
        _require_distinct_name(_name_of(headers[0], meta, extended), rivals)
        read_verified(folder)  # publishing may have to write it
    with errors:
        about = _describe(headers, meta, extended)
    kind: Kind | None = meta.kind
    if extended is not None:
        kind = _fill_from_entry(meta, extended).kind
    elif add:
        kind = None  # that of an entry which is not known, for it was refused
    with errors:
        weight_paths = require_weights(
            weights, headers, rivals, folder=folder, place=place, kind=kind
        )
    errors.raise_errors()

    hashes = [file.sha256 for file in files]
    paths = [file.path for file in files]
    owners = _owners_of_predictions(find_entries_to_differ_from(rivals, extended))
    require_new(hashes, paths, owners)
    predictions = []
    for file, seed, url in zip(files, seeds, urls, strict=True):
        predictions.append(_describe_predictions(folder, file, seed=seed, url=url))
    return Draft(
        place=place,
        about=about,
        predictions=predictions,
        weight_paths=weight_paths,
        rivals=rivals,
        extended=extended,
    )


def _urls_of(meta: Meta, count: int) -> Sequence[str | None]:
    if not meta.urls:
        return (None,) * count
    if len(meta.urls) != count:
        raise UsageError(
            "addresses do not match the files",
            where="urls in --from meta.yaml",
            expected=f"{count}, one for each file, or none",
            got=len(meta.urls),
            fix="give the addresses in the order of the files, or leave urls out",
        )
    return meta.urls


def _place_of(header: Header, meta: Meta) -> Place:
    """Return split, size and method; the label of predictions may name the method."""
    method = meta.method or header.method
    _, issues = examine(Meta, {"method": method})
    if issues:
        suggestion = re.sub("[^a-z0-9]+", "-", method.lower()).strip("-")
        raise UsageError(
            "the label of the predictions cannot name an entry",
            where="attribute method of the predictions, or --method",
            expected="small letters, digits and single hyphens",
            got=ascii(method),
            fix=f"name it: --method {suggestion or 'my-model'}",
        )
    if method in KNOWN_REFERENCES:
        raise UsageError(
            f"{method!r} is the name of a reference predictor",
            where="--method",
            expected="a name of your own",
            got=ascii(method),
            fix="choose another name; lagbench adds the reference predictors itself",
        )
    return header.split, header.size, method


def _require_no_entry(folder: Folder, place: Place) -> None:
    """Refuse a method that has an entry already."""
    path = folder.path / entry_path(place)
    if path.exists():
        raise UsageError(
            "the leaderboard has an entry of this method already",
            where=str(path),
            expected="a method without an entry on this data set",
            got=place[2],
            fix="to add a seed, --add; to replace the entry, --replace; for another "
            "method, another --method, and another name in meta.yaml",
        )


def _require_possible_training(headers: Sequence[Header], meta: Meta) -> None:
    """Refuse a training that the board would refuse."""
    provenances = [TrainingProvenance.from_sentence(meta.training)]
    budgets: list[Budget | None] = [meta.budget]
    for header in headers:
        provenances.append(header.provenance)
        budgets.append(header.budget)
    fault = find_training_fault(meta.kind, provenances, budgets)
    if fault is not None:
        raise UsageError(
            "the predictions state a training that cannot be",
            where="kind, training and budget in --from meta.yaml, and training of the "
            "predictions",
            expected="a training on train; kind: learned or hybrid where something is "
            "learned",
            got=fault,
            fix="correct kind in meta.yaml, or predict with a model that was not "
            "trained on scored scenarios",
        )
    for budget in budgets:
        if budget is None:
            continue
        contradiction = find_contradiction(budget)
        if contradiction is not None:
            raise UsageError(
                "a budget contradicts itself",
                where="budget of the predictions, or in --from meta.yaml",
                expected="steps up to the last one, and the least validation as best",
                got=contradiction,
                fix="state it as training.json does, or leave it out",
            )


def _name_of(header: Header, meta: Meta, extended: Entry | None) -> str:
    if meta.name:
        return meta.name
    if extended is not None:
        return extended.name
    return header.method[:LONGEST_LABEL]


def _require_distinct_name(name: str, rivals: Mapping[Path, Entry]) -> None:
    owners = {}
    for reference in KNOWN_REFERENCES:
        owners[reference] = f"the reference predictor {reference}"
    for path, entry in rivals.items():
        owners[entry.name] = str(path)

    key = confusable_key(name)
    for other_name, owner in owners.items():
        if confusable_key(other_name) == key:
            raise UsageError(
                "the name looks like that of another entry",
                where="name in --from meta.yaml",
                expected=f"a name that cannot be taken for {other_name!a} of {owner}",
                got=ascii(name),
                fix="choose another, or say what differs, in meta.yaml: "
                "`name: GNS, six terms`",
            )


def _describe(headers: Sequence[Header], meta: Meta, extended: Entry | None) -> About:
    """Return the description of the method.

    Keys come from ``meta``, else from the entry that gets more seeds, else from the
    predictions.
    """
    _refuse_two_solver_times(meta)
    if extended is not None:
        meta = _fill_from_entry(meta, extended)
    _require_possible_training(headers, meta)
    header = headers[0]
    keys: dict[str, Any] = {}
    for name in About.model_fields:
        keys[name] = getattr(meta, name)
    keys["name"] = meta.name or header.method[:LONGEST_LABEL]
    keys["date"] = _date_of(meta)
    keys["training"] = meta.training or (header.training or "")[:LONGEST_TEXT]
    if meta.parameters is None:
        keys["parameters"] = header.parameters
    keys["cost"] = _cost_of(headers, meta, extended)
    keys["budget"] = _budget_of(headers, meta, extended)
    return require_valid(About, keys)


def _fill_from_entry(meta: Meta, entry: Entry) -> Meta:
    keys = {}
    for name in DESCRIBED_KEYS:
        keys[name] = getattr(entry, name)
    for name in meta.model_fields_set:
        keys[name] = getattr(meta, name)
    return meta.model_copy(update=keys)


def _date_of(meta: Meta) -> datetime.date:
    """Return the date of a description, or today.

    Raises:
        UsageError: the date lies in the future.
    """
    date = meta.date or datetime.datetime.now(datetime.UTC).date()
    latest = latest_date()
    if date > latest:
        raise UsageError(
            "the date lies in the future",
            where="date",
            expected=f"at most {latest}",
            got=date,
            fix="give the day of the submission, or leave date out: it is today then",
        )
    return date


def _cost_of(
    headers: Sequence[Header], meta: Meta, extended: Entry | None
) -> object | None:
    solver_seconds = meta.solver_seconds_per_frame
    if meta.cost is not None and solver_seconds is not None:
        return meta.cost.model_copy(update={"solver_seconds_per_frame": solver_seconds})
    if meta.cost is None and extended is None:
        return mean_cost(headers, solver_seconds)
    return meta.cost


def _refuse_two_solver_times(meta: Meta) -> None:
    """Refuse a description whose cost and short form state two times of the solver."""
    if meta.cost is None or meta.solver_seconds_per_frame is None:
        return
    times = {meta.cost.solver_seconds_per_frame, meta.solver_seconds_per_frame}
    if len(times - {None}) > 1:
        raise UsageError(
            "the description states two times of the solver",
            where="solver_seconds_per_frame and cost.solver_seconds_per_frame in "
            "--from meta.yaml",
            expected="one time, or the same in both keys",
            got=f"{meta.solver_seconds_per_frame} and "
            f"{meta.cost.solver_seconds_per_frame}",
            fix="leave one of the two keys out",
        )


def _budget_of(
    headers: Sequence[Header], meta: Meta, extended: Entry | None
) -> EntryBudget | None:
    if meta.budget is not None and meta.budget.track is not None:
        raise UsageError(
            "an entry cannot state its track",
            where="budget.track",
            expected="no track: it follows from the budget of the predictions",
            got=ascii(meta.budget.track),
            fix="leave it out; `lagbench predict` writes the budget into "
            "predictions.nc",
        )
    budgets = []
    if extended is not None:
        budgets += [prediction.budget for prediction in extended.predictions]
    budgets += [header.budget for header in headers]
    mean_budget = EntryBudget.mean_over_seeds(headers[0].size, budgets)
    if mean_budget is not None:
        return mean_budget
    if meta.budget is not None:
        return meta.budget
    if extended is not None and extended.budget is not None:
        # a track follows from the budgets of all seeds, which are not known
        return extended.budget.model_copy(update={"track": None})
    return None


def _owners_of_predictions(entries: Mapping[Path, Entry]) -> dict[str, str]:
    owners = {}
    for path, entry in entries.items():
        for prediction in entry.predictions:
            owners[prediction.sha256] = str(path)
    return owners


def _describe_predictions(
    folder: Folder, file: PredictionsFile, *, seed: int | None, url: str | None
) -> Prediction:
    path = file.path.resolve()
    board = folder.path.resolve()
    inner_path = None
    if path.is_relative_to(board):
        inner_path = path.relative_to(board).as_posix()
    keys = {
        "seed": seed,
        "sha256": file.sha256,
        "url": url,
        "path": inner_path,
        "bytes": file.path.stat().st_size,
        "budget": file.header.budget,
        "provenance": file.header.provenance,
    }
    fix = "name the file otherwise, or move it"
    return require_valid(Prediction, keys, where=file.path, fix=fix)
