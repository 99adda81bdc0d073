"""Files of safetensors: tensors by name, and the recipe as JSON text in the header.

The format holds numbers only: nothing in a file can run. What is left to attack are
lengths, so a file and its header are bounded before the library parses them.

Layout: https://huggingface.co/docs/safetensors (8 bytes with the length of the header,
JSON, numbers). The recipe stands under the key ``lagbench`` of ``__metadata__``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import safetensors
import safetensors.torch
from torch import Tensor

from lagbench.atomic import atomic_path
from lagbench.errors import UnreadableFileError, check_regular
from lagbench.models.formats import describe_format

SUFFIX = ".safetensors"
KEY = "lagbench"

MOST_BYTES = 40_000_000
"""Longest file [bytes]; so much all models of a leaderboard may have together."""

MOST_HEADER_BYTES = 1 << 20
"""Longest header [bytes]; ours take 20 kB, most of it the log of the training."""

EXPECTED = "a file of safetensors that lagbench wrote"


def read_tensors(path: Path) -> tuple[str, dict[str, Tensor]]:
    """Return the recipe, as JSON text that is not parsed yet, and the tensors by name.

    Raises:
        UnreadableFileError: the file is too long, damaged, of another format, or has no
            recipe.
    """
    length = check_regular(path, longest=MOST_BYTES, fix="use fewer parameters")
    _check_header(path, length)
    try:
        with safetensors.safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    # the library raises a type of its own, and others for types of numbers it lacks
    except Exception as error:
        one_line = " ".join(str(error).split())
        got = f"{type(error).__name__}: {one_line[:200]}"
        raise _refusal(path, got) from None
    if KEY not in metadata:
        raise _refusal(
            path,
            "tensors without a recipe",
            fix="write it with lagbench.models.registered.export_safetensors",
        )
    return metadata[KEY], weights


def _check_header(path: Path, length: int) -> None:
    """Refuse a file without a header of bounded length, by name where it is known.

    A pickle begins with two bytes that some lengths of headers have too. So the header
    decides, and the other formats are only asked about files without one.
    """
    with path.open("rb") as stream:
        beginning = stream.read(9)
    header_length = int.from_bytes(beginning[:8], "little")
    if header_length > length - 8 or not beginning.endswith(b"{"):
        other_format = describe_format(path)
        if other_format is not None:
            raise _refusal(
                path,
                other_format,
                fix="do not load it otherwise: such a file can run code",
            )
        raise _refusal(
            path, f"a header of {header_length} bytes in a file of {length} bytes"
        )
    if header_length > MOST_HEADER_BYTES:
        raise UnreadableFileError(
            "the header is too long",
            where=str(path),
            expected=f"at most {MOST_HEADER_BYTES} bytes",
            got=f"{header_length} bytes",
            fix="leave other metadata than the recipe out",
        )


def _refusal(path: Path, got: str, *, fix: str | None = None) -> UnreadableFileError:
    return UnreadableFileError(
        "not a file of safetensors that can be used",
        where=str(path),
        expected=EXPECTED,
        got=got,
        fix=fix,
    )


def write_tensors(path: Path, about: str, weights: Mapping[str, Tensor]) -> None:
    """Write tensors with their recipe as JSON text; the file appears whole or not.

    Raises:
        WorkFailedError: the disk is full, or nobody may write there.
    """
    copies = {}
    for name, tensor in weights.items():
        on_cpu = tensor.detach().cpu()
        # the format holds no two names for one memory
        copies[name] = on_cpu.contiguous().clone()
    data = safetensors.torch.save(copies, metadata={KEY: about})
    with atomic_path(path, option="--output") as temporary:
        Path(temporary).write_bytes(data)
