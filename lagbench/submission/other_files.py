"""Refuse what a user gives in place of predictions: a model, or a folder."""

from __future__ import annotations

import shlex
from pathlib import Path

from lagbench.errors import UnreadableFileError

BOARD_ENTRIES = "submissions"
"""Folder by which a leaderboard is known; see `lagbench.scoring.boards`."""

MODEL_ENDINGS = (".onnx", ".safetensors")
"""Endings of the models that `lagbench predict` runs."""

HEAD_BYTES = 256
"""Bytes by which a model is known; more of a stranger's file is not read."""

MOST_NAMES = 3
"""Files of a folder that a message names."""


def refuse_other_files(path: Path) -> None:
    """Refuse a model or a folder; other faults are left to the reader of the file.

    Raises:
        UnreadableFileError: the path is a folder or a model.
    """
    try:
        is_folder = path.is_dir()
        ending = find_model_ending(path)
    except (OSError, ValueError):  # no file, or a name that no file has
        return
    if is_folder:
        raise UnreadableFileError(
            "not a file",
            where=str(path),
            expected="a file of predictions",
            got="a folder",
            fix=_name_predictions_in(path),
        )
    if ending is not None:
        raise UnreadableFileError(
            "this is a model, not predictions",
            where=str(path),
            expected="predictions, which the model makes",
            got=f"a model, as {ending} files are",
            fix=_name_predict_command(path, ending),
        )


def find_model_ending(path: Path) -> str | None:
    """Return the ending of a model's format; None for a file of another kind.

    A file is known by its first bytes, else by its name. An HDF5 file is no model.

    Raises:
        OSError: the file cannot be read.
        ValueError: no file can have that name.
    """
    if not path.is_file():  # a pipe would never end
        return None
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if head.startswith(b"\x89HDF"):
        return None
    # the length of a JSON header, then the header
    header_length = int.from_bytes(head[:8], "little")
    if head[8:9] == b"{" and header_length < path.stat().st_size:
        return ".safetensors"
    # protobuf: field 1, the version of the format; then field 2, the producer
    if len(head) > 2 and head[0] == 0x08 and head[1] < 0x40 and head[2] == 0x12:
        return ".onnx"
    if path.suffix.lower() in MODEL_ENDINGS:
        return path.suffix.lower()
    return None


def _name_predict_command(path: Path, ending: str) -> str:
    """Return the command that predicts with a model, and how it must be named."""
    model = path
    renaming = ""
    if path.suffix != ending:
        model = path.with_suffix(ending)
        renaming = f"name it {ascii(model.name)[1:-1]}, then "
    data_set = ""
    if ending == ".onnx":  # it does not state its data set
        data_set = " --split SPLIT --size SIZE"
    output = model.with_suffix(".nc").name
    return (
        f"predict with it first: {renaming}lagbench predict {shlex.quote(str(model))}"
        f"{data_set} -o {shlex.quote(output)}"
    )


def _name_predictions_in(folder: Path) -> str:
    """Return a hint: that a folder is a leaderboard, or its netCDF files."""
    if (folder / BOARD_ENTRIES).is_dir():
        return (
            "it is a leaderboard: lagbench leaderboard show "
            f"--board {shlex.quote(str(folder))}"
        )
    names = []
    try:
        for file in sorted(folder.iterdir()):
            is_hidden = file.name.startswith(".")
            if file.suffix == ".nc" and not is_hidden and file.is_file():
                names.append(ascii(file.name)[1:-1])
    except OSError:
        return "name a file of predictions"
    if not names:
        return "name a file of predictions; this folder has no .nc file"
    return f"name a file in it: {', '.join(names[:MOST_NAMES])}"
