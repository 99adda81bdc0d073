"""Recognise the format of a model by its bytes, so that it is refused by name."""

from __future__ import annotations

import zipfile
from pathlib import Path

from lagbench.errors import UnreadableFileError, check_regular

PICKLE_HEADS = tuple(bytes([0x80, protocol]) for protocol in range(2, 6))
"""First bytes of a pickle of each binary protocol."""

MOST_MEMBERS = 10_000  # names of an archive that are looked at


def describe_format(path: Path) -> str | None:
    """Return the name of a format that may carry code; None for any other file.

    Nothing is unpacked: the first bytes and the names in an archive decide.
    """
    with path.open("rb") as stream:
        head = stream.read(8)
    if head.startswith(PICKLE_HEADS):
        return "a pickle"
    if not head.startswith(b"PK"):
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()[:MOST_MEMBERS]
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return "a damaged archive"
    if any(name.endswith((".json", ".pt2")) for name in names) and any(
        "models/" in name or "exported_program" in name for name in names
    ):
        return "an archive of torch.export"
    if any("/code/" in f"/{name}" for name in names):
        return "an archive of TorchScript"
    if any(name.endswith(".pkl") for name in names):
        return "an archive of torch.save, which holds a pickle"
    return "an archive"


def require_onnx_bytes(path: Path, *, longest: int) -> None:
    """Refuse a file that cannot be ONNX: by its length, suffix or first bytes.

    Raises:
        UnreadableFileError: the file is missing, too long or of another format.
    """
    check_regular(
        path, longest=longest, fix="use fewer parameters, or float16 initialisers"
    )
    name = describe_format(path)
    if name is None and path.suffix.lower() == ".onnx":
        return
    raise UnreadableFileError(
        "not an ONNX file",
        where=str(path),
        expected="a model of torch.onnx.export, named .onnx",
        got=name or f"a file named {path.suffix or 'without a suffix'}",
        fix="export the model to ONNX: docs/submitting.md",
    )
