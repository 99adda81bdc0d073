"""Score predictions and write the entry: ``lagbench submit``.

Everything that can be refused is refused before the scoring: first the arguments, all
mistakes together, then all that does not fit the files. `publish` then writes the
entry; ``lagbench leaderboard build`` draws the board's page anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from lagbench.data.hdf5 import check_file
from lagbench.data.registry import Registry, load
from lagbench.errors import UsageError, UsageErrorCollector, WorkFailedError
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import SUBMISSION
from lagbench.scoring.score import score
from lagbench.submission.checks import outside_share
from lagbench.submission.format import WRITE
from lagbench.submission.issues import ValidationResult
from lagbench.submission.other_files import refuse_other_files
from lagbench.submission.predictions import open_predictions
from lagbench.submission.validation import validate
from lagbench.work.run import Progress

from .describe import draft_entry
from .draft import Draft, PredictionsFile
from .entry import OUTSIDE, Meta
from .fields import MOST_SEEDS
from .folder import Folder
from .identity import fingerprint_of, fingerprints_of_entries
from .lock import board_lock
from .publish import SubmitResult, complete_interrupted, publish
from .seeds import require_new

BOARD = Path("leaderboard")  # the leaderboard's folder, from the root of the repository

NEEDED_KEYS = {
    "authors": "--author NAME",
    "command": "--command 'what makes the predictions again'",
}
"""Keys that readers of the board need, and the options that give them."""


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
    """Score predictions and write their entry and score files.

    Score files of reference predictors that the board lacks are written, too.

    Args:
        predictions: files of predictions, one per seed.
        meta: description of the method.
        weights: weights that made the predictions, at most one file per seed; they are
            kept beside the entry.
        board: the leaderboard's folder.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        replace: whether the entry replaces the one of that name.
        add: whether the files are further seeds of the entry of that name. Its other
            predictions need not be at hand; its description stays, except for the keys
            in ``meta``.
        new_board: whether the folder may be a new one.
        workers: worker processes; by default one per core where the work is worth it.
        registry: where splits are described; ours when None.
        progress: called as the work advances.
        examined: called with the result of each validation.

    Raises:
        UsageError: a key is missing, the entry is there already or, with ``add``, is
            not or has changed meanwhile, the files do not belong together, name or
            predictions are another's, or no leaderboard.
        UnreadableFileError: predictions or weights cannot be read.
        ChecksFailedError: predictions are not valid; with ``add``, a file beside the
            entry is not the one that it names.
        DataError: the test subset is missing, or the predictions were made from another
            data set.
        WorkFailedError: the disk is full or not writable, or a score file became too
            long.
    """
    folder = Folder(board)
    paths = [Path(path) for path in predictions]
    _require_fit_arguments(
        folder, paths, meta, replace=replace, add=add, new_board=new_board
    )

    full_registry = registry or load()
    files = []
    for path in paths:
        result = validate(path, root=root, require_truth=True, registry=registry)
        if examined is not None:
            examined(result)
        result.check()
        files.append(_read_predictions(path, result, full_registry))

    def draft() -> Draft:
        return draft_entry(
            files, meta, folder=folder, weights=weights, replace=replace, add=add
        )

    if folder.staging_folders():
        with board_lock(folder):
            complete_interrupted(folder)
    draft()  # errors that need no scores come before the scoring
    cards: list[ScoreCard] = []
    for file in files:
        card = score(
            file.path,
            root=root,
            packages=False,  # an entry tells nothing of the submitter's packages
            workers=workers,
            registry=registry,
            progress=progress,
            write=False,
            validated=file.validation,
        )
        cards.append(card)
    fingerprints = [fingerprint_of(card.tallies[SUBMISSION]) for card in cards]
    try:
        # the leaderboard may have changed while the files were scored
        with board_lock(folder):
            complete_interrupted(folder)
            current = draft()
            known_fingerprints = fingerprints_of_entries(
                folder, current.entries_to_differ_from
            )
            require_new(fingerprints, paths, known_fingerprints)
            return publish(current, files, cards, folder)
    except OSError as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(error.filename or folder.path),
            expected="a folder that you may write to, on a disk with space",
            got=error.strerror or error,
            fix="free disk space, or name a folder that you may write to: --board",
        ) from error


def _require_fit_arguments(
    folder: Folder,
    paths: Sequence[Path],
    meta: Meta,
    *,
    replace: bool,
    add: bool,
    new_board: bool,
) -> None:
    """Refuse together all that is wrong before any file is read."""
    errors = UsageErrorCollector()
    with errors:
        if add and replace:
            raise UsageError(
                "--add and --replace exclude each other",
                where="--add, --replace",
                expected="one of the two",
                got="both",
                fix="--add for more seeds, --replace for new predictions of all",
            )
        if not add:
            _require_keys(meta)
    with errors:
        if new_board:
            folder.require_room()
        else:
            folder.require(
                "run it from the root of a clone, name it with --board, or begin one: "
                "--new-board"
            )
    with errors:
        _require_files(paths)
    errors.raise_errors()


def _require_keys(meta: Meta) -> None:
    missing_options = []
    for key, option in NEEDED_KEYS.items():
        if not getattr(meta, key):
            missing_options.append(option)
    if missing_options:
        raise UsageError(
            "the entry lacks what readers need",
            where=", ".join(missing_options),
            expected="a text for each",
            got="nothing",
            fix="give them as options, or authors and command in a file: "
            "--from meta.yaml",
        )


def _require_files(paths: Sequence[Path]) -> None:
    for path in paths:
        refuse_other_files(path)
        check_file(path, fix=WRITE)
    if not paths:
        what = "no predictions"
        fix = "name the predictions: lagbench submit predictions.nc"
    elif len(paths) > MOST_SEEDS:
        what = "too many files"
        fix = "leave some out: further seeds of a method can be added later, with --add"
    else:
        return
    raise UsageError(
        what,
        where="FILE ...",
        expected=f"1 to {MOST_SEEDS}, one per seed",
        got=len(paths),
        fix=fix,
    )


def _read_predictions(
    path: Path, validation: ValidationResult, registry: Registry
) -> PredictionsFile:
    """Read header and content hash of valid predictions."""
    with open_predictions(path) as opened:
        header = opened.header
        if header.split not in registry.splits:
            raise UsageError(
                "no split of a leaderboard",
                where=str(path),
                expected=[*registry.splits],
                got=header.split,
                fix="a leaderboard takes the splits of lagbench; `lagbench score` and "
                "`lagbench compare` take a split of your own too",
            )
        if header.subset != "test":
            raise UsageError(
                "an entry needs predictions of the subset test",
                where=str(path),
                expected="test",
                got=header.subset,
                fix="submit the predictions of test; `lagbench score` scores these",
            )
        share = None
        if any(warning.check == OUTSIDE for warning in validation.warnings):
            share = outside_share(opened, registry.size(header.split, header.size))
        return PredictionsFile(
            path=path,
            header=header,
            sha256=validation.sha256 or opened.content_sha256(),
            validation=validation,
            outside_share=share,
        )
