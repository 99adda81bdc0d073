"""Entries whose models can be run again: by name, or all active ones."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePath

from lagbench.data.layout import major_of
from lagbench.data.registry import Registry, Size
from lagbench.errors import UsageError, suggest_name
from lagbench.scoring.boards import DEFAULT_BOARDS, suggest_board

from .entry import DataSet, Entry, Status
from .entry_file import read_entry
from .folder import Folder


def choose_data_sets(
    known: Collection[tuple[str, str]],
    split: str | None,
    size: str | None,
    *,
    board: Path,
) -> tuple[tuple[str, str], ...]:
    """Return the data sets with entries; only those of a split or size, if given.

    A data set is a pair (split, size). ``board`` is for the message.

    Raises:
        UsageError: a split or size is given that has no entries.
    """
    chosen = []
    for known_split, known_size in known:
        if split in (None, known_split) and size in (None, known_size):
            chosen.append((known_split, known_size))
    if chosen or (split is None and size is None):
        return tuple(chosen)

    request = " ".join(name for name in (split, size) if name)
    fix: str | None = "submit something: lagbench submit"
    if known:
        fix = suggest_name(request, [" ".join(data_set) for data_set in known])
    raise UsageError(
        "no entries there",
        where="--split, --size",
        expected=f"a data set with entries in {board}",
        got=ascii(request),
        fix=fix,
    )


def _suggest_entry(name: str, known: Iterable[str]) -> str:
    """Return a hint that names entries of a method, or the nearest entry.

    >>> _suggest_entry("gns", ["cavity/mini/gns", "cavity/mini/gat"])
    'name its data set too: cavity/mini/gns'
    """
    names = sorted(known)
    of_method = [entry for entry in names if entry.rpartition("/")[2] == name]
    if of_method:
        return f"name its data set too: {', '.join(of_method)}"
    return suggest_name(name, names)


def choose_entries(
    folder: Folder,
    names: Sequence[str],
    registry: Registry,
    *,
    split: str | None = None,
    size: str | None = None,
) -> list[Entry]:
    """Return entries by name, or all active ones of the present data with models.

    Raises:
        UsageError: no such entry, or one that has no model; or no entries of the split
            or size.
    """
    known = {}
    for path in folder.entries():
        name = "/".join(path.with_suffix("").parts[1:])
        known[name] = path
    if names:
        chosen = []
        for name in names:
            key = name.removesuffix(".yaml").rpartition("submissions/")[2]
            if key not in known:
                in_other_board = suggest_board(key, searched=folder.path)
                raise UsageError(
                    "no such entry",
                    where=str(folder.path),
                    expected="SPLIT/SIZE/METHOD, as in cavity/mini/gns",
                    got=name,
                    fix=in_other_board or _suggest_entry(key, known),
                )
            entry = read_entry(folder.path / known[key])
            if not has_models(entry):
                raise UsageError(
                    "the entry has no model to run",
                    where=key,
                    expected="a .safetensors or .onnx file of each seed",
                    got="predictions only",
                    fix="its submitter may add one: "
                    f"{name_submit_command(entry.yaml_path, folder.path)}",
                )
            chosen.append(entry)
        return chosen

    choose_data_sets(folder.data_sets(), split, size, board=folder.path)
    chosen = []
    for path in known.values():
        _, entry_split, entry_size, _ = path.parts
        if split not in (None, entry_split) or size not in (None, entry_size):
            continue
        entry = read_entry(folder.path / path)
        is_present = is_current(entry.dataset, registry.size(entry_split, entry_size))
        if entry.status is Status.ACTIVE and has_models(entry) and is_present:
            chosen.append(entry)
    return chosen


def name_submit_command(entry_path: PurePath, board: Path) -> str:
    """Return the command that replaces an entry by one with a model.

    Args:
        entry_path: YAML file of the entry in the folder of the leaderboard.
        board: that folder.

    >>> path = PurePath("submissions/cavity/mini/gns.yaml")
    >>> name_submit_command(path, Path("trial"))  # doctest: +NORMALIZE_WHITESPACE
    'lagbench submit PREDICTIONS.nc --from meta.yaml --method gns --weights FILE
    --replace --board trial'
    """
    board_option = ""
    if board.resolve() != DEFAULT_BOARDS[0].resolve():
        board_option = f" --board {shlex.quote(str(board))}"
    return (
        f"lagbench submit PREDICTIONS.nc --from meta.yaml --method {entry_path.stem} "
        f"--weights FILE --replace{board_option}"
    )


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today.

    It has the same MAJOR version, and the same hash where one is recorded.
    """
    if major_of(dataset.version) != size.major:
        return False
    return size.measured is None or dataset.sha256 == size.measured.dataset_sha256


def has_models(entry: Entry) -> bool:
    """Return whether a model lies beside an entry."""
    return any(prediction.weights is not None for prediction in entry.predictions)
