"""Score predictions and write the entry: ``lagbench submit``.

What can be refused is refused before the work: together what needs no file, then
together what the files must be for. Then all files are written beside their places and
moved there, last the YAML file, which names them by SHA-256: what a kill between two
moves leaves behind, ``lagbench leaderboard check`` finds.
``lagbench leaderboard build`` draws the board's page anew.
"""

from __future__ import annotations

import datetime
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from lagbench.atomic import move_together, refuse_folders
from lagbench.data.hdf5 import check_file
from lagbench.data.registry import Registry, load
from lagbench.errors import ChecksFailedError, Mistakes, UsageError, WorkFailedError
from lagbench.references.table import REFERENCES as KNOWN_REFERENCES
from lagbench.scoring.card import SUBMISSION, ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.score_file import write_statistics
from lagbench.scoring.score_file_checks import MAX_SCORE_BYTES, read_score_file
from lagbench.submission.checks import outside_share
from lagbench.submission.findings import ValidationResult
from lagbench.submission.format import WRITE, Header
from lagbench.submission.predictions import open_predictions
from lagbench.submission.validation import validate
from lagbench.work.progress import Progress

from .entry import (
    LONGEST_TEXT,
    MOST_SEEDS,
    OUTSIDE,
    About,
    Cost,
    DataSet,
    Entry,
    EntryBudget,
    Meta,
    Prediction,
    ScoreBlock,
    last_day,
)
from .entry_file import (
    Model,
    active_beside,
    examine,
    listed,
    read_verified,
    readable,
    spell,
    unverified,
)
from .findings import print_of, prints_of, skeleton
from .folder import (
    REFERENCES,
    SUBMISSIONS,
    VERIFIED,
    Folder,
    Place,
    entry_path,
    score_paths,
)
from .ranking import combine, scored_file, summarise, write_references
from .seeds import extendable, require_new, seeds_of
from .weights import named_weights, require_weights, stage_weights

BOARD = Path("leaderboard")  # the leaderboard's folder, from the root of the repository

# begins the folder in which score files are prepared; a killed process leaves it behind
STAGE = ".submit-"


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
    board: Path
    # what was written; verified.yaml, where the entry before had a line there
    files: tuple[Path, ...]
    kept: tuple[Path, ...]  # weights of the entry before that are those of this one
    removed: tuple[Path, ...]  # what only the entry before had


def submit(
    predictions: Sequence[str | Path],
    meta: Meta,
    *,
    weights: Sequence[str | Path] = (),
    board: str | Path = BOARD,
    root: str | Path | None = None,
    replace: bool = False,
    add: bool = False,
    new_board: bool = False,
    workers: int | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
    examined: Callable[[ValidationResult], None] | None = None,
) -> SubmitResult:
    """Score predictions, a file per seed; write entry and score files, and those of
    floors beside them.

    ``weights`` made the predictions and are kept beside the entry: at most one file per
    seed. With ``add`` the files are further seeds of the entry of that name, whose
    other predictions need not be at hand; what it says of the method stays, but for
    what ``meta`` says. ``examined`` is told what each validation found.

    Raises:
        UsageError: a key is missing, the entry is there already or, with ``add``, is
            not or has changed meanwhile, the files do not belong together, name or
            predictions are another's, or no leaderboard.
        UnreadableFileError: predictions or weights cannot be read.
        ChecksFailedError: they are not valid; with ``add``, what lies beside the entry
            is not what it names.
        DataError: the test subset is missing, or they were made from another data set.
        WorkFailedError: the disk is full or not writable, or a score file became too
            long.
    """
    folder = Folder(board)
    paths = [Path(path) for path in predictions]
    mistakes = Mistakes()
    with mistakes:
        if add and replace:
            raise UsageError(
                "an entry is added to or replaced",
                where="--add, --replace",
                fix="give one",
            )
        if not add:
            # what readers need
            needed = {
                "authors": "--author NAME",
                "command": "--command 'what makes the predictions again'",
            }
            if missing := [
                option for key, option in needed.items() if not getattr(meta, key)
            ]:
                fix = "give them as options, or authors and command in a file: --from meta.yaml"
                raise UsageError(
                    "the entry lacks what readers need",
                    expected=" and ".join(missing),
                    fix=fix,
                )
    with mistakes:
        if new_board:
            folder.require_room()
        else:
            folder.require(
                "run it from the root of a clone, name it with --board, or begin one: "
                "--new-board"
            )
    with mistakes:
        for path in paths:
            check_file(path, fix=WRITE)
        if not 1 <= len(paths) <= MOST_SEEDS:
            if paths:
                what = "too many files"
            else:
                what = "no predictions"
            raise UsageError(
                what, expected=f"1 to {MOST_SEEDS}, one per seed", got=len(paths)
            )
    mistakes.tell()
    plan = _planned(
        folder,
        paths,
        meta,
        weights,
        replace=replace,
        add=add,
        examined=examined,
        root=root,
        registry=registry,
    )
    scored = partial(
        score,
        root=root,
        workers=workers,
        registry=registry,
        progress=progress,
        write=False,
    )
    cards = [
        scored(path, validated=result)
        for path, result in zip(paths, plan.results, strict=True)
    ]
    prints = [print_of(card.tallies[SUBMISSION]) for card in cards]
    require_new(prints, paths, prints_of(folder, plan.rivals))
    try:
        return _publish(plan, cards, folder)
    except OSError as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(error.filename or folder.path),
            got=error.strerror or error,
            fix="free disk space, or name a folder that you may write to: --board",
        ) from error


class _Plan(NamedTuple):
    """What is known of an entry before its predictions are scored."""

    place: Place
    about: About
    made: Sequence[Prediction]  # what it says of each file
    results: Sequence[ValidationResult]
    # share of positions beyond the box, where the validation warns
    outside: Sequence[float | None]
    sources: Sequence[Path | None]  # weights of each file
    others: Mapping[Path, Entry]  # active entries of the same data set
    # entries whose predictions it cannot have: others, and added_to
    rivals: Mapping[Path, Entry]
    added_to: Entry | None


def _planned(
    folder: Folder,
    paths: Sequence[Path],
    meta: Meta,
    weights: Sequence[str | Path],
    *,
    root: str | Path | None,
    registry: Registry | None,
    replace: bool,
    add: bool,
    examined: Callable[[ValidationResult], None] | None,
) -> _Plan:
    """Refuse invalid files, then together what they must be for; return what the entry
    will say of them.
    """
    headers = []
    hashes = []
    outside = []
    results = []
    described = registry or load()
    for path in paths:
        result = validate(path, root=root, require_truth=True, registry=registry)
        if examined is not None:
            examined(result)
        result.check()
        results.append(result)
        with open_predictions(path) as opened:
            if (got := opened.header.split) not in (known := described.splits):
                raise UsageError(
                    "no split of a leaderboard",
                    where=str(path),
                    expected=[*known],
                    got=got,
                )
            headers.append(opened.header)
            hashes.append(result.sha256 or opened.content_sha256())
            size = described.size(opened.header.split, opened.header.size)
            warned = any(found.check == OUTSIDE for found in result.warnings)
            outside.append(outside_share(opened, size) if warned else None)
    others = dict[Path, Entry]()
    before = None
    mistakes = Mistakes()
    with mistakes:
        seeds = seeds_of(headers)
    with mistakes:
        if meta.urls and len(meta.urls) != len(headers):
            fix = f"give {len(headers)}, one per file in their order, or none"
            raise UsageError(
                "addresses do not match the files",
                where="--url",
                got=len(meta.urls),
                fix=fix,
            )
        urls = meta.urls or (None,) * len(headers)
    with mistakes:
        place = (headers[0].split, headers[0].size, _method(headers[0], meta))
        others = active_beside(folder, place)
        if add:
            before = extendable(folder, place, headers, meta)
        label = meta.name or (before.name if before else headers[0].method[:100])
        own = folder.path / entry_path(place)
        if own.exists() and not replace and not add:
            name = "another --method, and name: in meta.yaml"
            fix = f"a further seed: --add; instead of it: --replace; else {name}"
            raise UsageError("there is such an entry already", where=str(own), fix=fix)
        names = {floor: f"the floor {floor}" for floor in KNOWN_REFERENCES}
        names |= {entry.name: str(path) for path, entry in others.items()}
        for name, holder in names.items():
            if skeleton(name) == skeleton(label):
                fix = "choose another, or say what differs, in meta.yaml: `name: GNS, six terms`"
                raise UsageError(
                    "the name looks like another's",
                    where=holder,
                    got=ascii(label),
                    fix=fix,
                )
        read_verified(folder)  # a line of it may have to go
    with mistakes:
        about = _about(headers, meta, before)
    with mistakes:
        sources = require_weights(weights, headers, others)
    mistakes.tell()
    rivals = others | ({} if before is None else {before.yaml_path: before})
    taken = {
        made.sha256: str(where)
        for where, entry in rivals.items()
        for made in entry.predictions
    }
    require_new(hashes, paths, taken)
    made = []
    whole = folder.path.resolve()
    for path, sha256, header, seed, url in zip(
        paths, hashes, headers, seeds, urls, strict=True
    ):
        inside = path.resolve()
        if inside.is_relative_to(whole):
            kept = inside.relative_to(whole).as_posix()
        else:
            kept = None
        said: dict[str, object] = {
            "seed": seed,
            "sha256": sha256,
            "url": url,
            "path": kept,
        }
        said |= {"bytes": path.stat().st_size, "budget": header.budget}
        made.append(
            _fitting(
                Prediction, said, where=path, fix="name the file otherwise, or move it"
            )
        )
    return _Plan(place, about, made, results, outside, sources, others, rivals, before)


def _method(header: Header, meta: Meta) -> str:
    """Return the id of the method: the one given, else the label of the predictions if
    it can be one.
    """
    name = meta.method or header.method
    if examine(Meta, {"method": name})[1]:
        raise UsageError(
            "the label of the predictions cannot name an entry",
            expected="small letters, digits and single hyphens",
            got=ascii(name),
            fix=f"name it: --method "
            f"{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-') or 'my-model'}",
        )
    if name in KNOWN_REFERENCES:
        fix = "name your method otherwise; the floors are added by themselves"
        raise UsageError(f"{name!r} is the name of a floor", where="--method", fix=fix)
    return name


def _about(headers: Sequence[Header], meta: Meta, before: Entry | None) -> About:
    """Return what is said of the method: by ``meta``, else by the entry before, else by
    the predictions.
    """
    first = headers[0]
    budgets = [header.budget for header in headers]
    if before is not None:
        budgets = [*(made.budget for made in before.predictions), *budgets]
        said = {name: getattr(meta, name) for name in meta.model_fields_set}
        stays = {
            name: getattr(before, name)
            for name in About.model_fields
            if name not in ("budget", "date")
        }
        meta = meta.model_copy(update=stays | said)
    held = {name: getattr(meta, name) for name in About.model_fields}
    held["name"] = meta.name or first.method[:100]
    held["date"] = meta.date or datetime.datetime.now(datetime.UTC).date()
    if held["date"] > (last := last_day()):
        raise UsageError(
            "a day to come", where="date", expected=f"at most {last}", got=meta.date
        )
    held["training"] = meta.training or (first.training or "")[:LONGEST_TEXT]
    if meta.parameters is None:
        held["parameters"] = first.parameters
    if before is None:
        held["cost"] = meta.cost or Cost.told(headers, meta.solver_seconds_per_frame)
    elif meta.cost is not None and meta.solver_seconds_per_frame is not None:
        timed = {"solver_seconds_per_frame": meta.solver_seconds_per_frame}
        held["cost"] = meta.cost.model_copy(update=timed)
    if meta.budget is not None and meta.budget.track is not None:
        raise UsageError(
            "a track is not stated",
            where="budget.track",
            fix="leave it out: it follows from the budget that `lagbench predict` "
            "writes into predictions.nc",
        )
    held["budget"] = EntryBudget.of(first.size, budgets) or meta.budget
    if held["budget"] is None and before is not None and before.budget is not None:
        # a track follows from all budgets
        held["budget"] = before.budget.model_copy(update={"track": None})
    return _fitting(About, held)


def _fitting(
    kind: type[Model],
    held: Mapping[str, object],
    *,
    where: object = None,
    fix: str = "say it otherwise in --from meta.yaml; docs/submitting.md describes "
    "the keys",
) -> Model:
    """Return what an entry says, or what of it its schema refuses."""
    found, mistakes = examine(kind, held)
    if found is None:
        what = "the entry does not fit the schema"
        if where is None:
            place = None
        else:
            place = str(where)
        raise ChecksFailedError(what, where=place, got=listed(mistakes), fix=fix)
    return found


def _publish(plan: _Plan, cards: Sequence[ScoreCard], folder: Folder) -> SubmitResult:
    """Write all files beside their places, then move them there, the entry last; remove
    the old one's others.

    A full disk is met before anything of the old entry is touched. An entry that is
    added to keeps its score files, under new names where it had but one.
    """
    place = plan.place
    added_to = plan.added_to
    header = cards[0].header
    split, size, method = place
    staying, lying = (
        (added_to.predictions, added_to.score_paths) if added_to else ((), ())
    )
    made = [*staying, *plan.made]
    sources = [*(None for _ in staying), *plan.sources]
    names = score_paths(place, [one.seed for one in made])
    yaml_path = entry_path(place)
    before = readable(folder.path / yaml_path)
    if added_to is not None and before != added_to:
        fix = "submit again: what was added meanwhile stays"
        raise UsageError(
            "the entry changed while the files were scored",
            where=str(yaml_path),
            fix=fix,
        )
    (folder.path / SUBMISSIONS).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=STAGE, dir=folder.path) as stage:
        staged = [Path(stage) / name.name for name in names]
        for path, target in zip(lying, staged, strict=False):
            shutil.copyfile(folder.path / path, target)
        for card, target in zip(cards, staged[len(staying) :], strict=True):
            write_statistics(card, target, option="--board")
            if (length := target.stat().st_size) > MAX_SCORE_BYTES:
                raise WorkFailedError(
                    "the score file is too long",
                    where=f"{split} {size}",
                    expected=f"at most {MAX_SCORE_BYTES} bytes",
                    got=f"{length} bytes",
                    fix="uninstall packages that add metrics, and submit again",
                )
        if added_to:
            files = added_to.score.files
        else:
            files = ()
        files += tuple(map(scored_file, cards, staged[len(staying) :], plan.outside))
        kept = named_weights(folder, place, made, sources, before, plan.others)
        made = [
            one.model_copy(update={"weights": held})
            for one, held in zip(made, kept, strict=True)
        ]
        block = ScoreBlock(
            lagbench=version("lagbench"),
            dataset_sha256=header.dataset_sha256,
            ranking_metric=cards[0].ranking,
            files=files,
            metrics=summarise(
                combine([read_score_file(target).scores for target in staged])
            ),
        )
        said = dict(plan.about) | {
            "format": 2,
            "split": split,
            "size": size,
            "method": method,
        }
        said |= {
            "predictions": tuple(made),
            "score": block,
            "reason": added_to.reason if added_to else "",
        }
        said["dataset"] = DataSet(
            version=header.dataset_version, sha256=header.dataset_sha256
        )
        entry = _fitting(Entry, said)
        # score files that lie there are the same bytes as staged
        moves = {
            name: path
            for name, path in zip(names, staged, strict=True)
            if name not in lying
        }
        moves |= stage_weights(Path(stage), kept, sources)
        # the entry last
        texts = {
            Path(VERIFIED): unverified(folder, entry),
            yaml_path: spell(entry),
        }
        for number, (name, text) in enumerate(texts.items()):
            if text is not None:
                # a method may be called verified
                moves[name] = Path(stage) / f"{number}.yaml"
                moves[name].write_bytes(text)
        records = {name.with_suffix(".json") for name in moves if name.suffix == ".pt"}
        idle = sorted(
            (set(before.files if before else ()) - set(entry.files))
            | (records - set(moves))
        )
        folder.require_unlinked(
            [*moves, *(name.parent for name in idle), Path(REFERENCES, split, size)]
        )
        removed = [path for name in idle if os.path.lexists(path := folder.path / name)]
        refuse_folders(removed)
        floors = write_references(cards[0], folder)
        move_together([(source, folder.path / name) for name, source in moves.items()])
    for path in removed:
        path.unlink()
    summary = block.metrics[block.ranking_metric]
    return SubmitResult(
        split=split,
        size=size,
        method=method,
        ranking=block.ranking_metric,
        mean=summary.mean,
        std=summary.std,
        flags=tuple(dict.fromkeys(flag.name for file in files for flag in file.flags)),
        board=folder.path,
        files=(*(folder.path / name for name in reversed(moves)), *floors),
        kept=tuple(
            folder.path / held.path
            for held in kept
            if held and Path(held.path) not in moves
        ),
        removed=tuple(removed),
    )
