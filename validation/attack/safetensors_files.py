"""Files of safetensors of the attack: a valid one, and its mutations."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .mutations import Mutation

Header = dict[str, Any]

LENGTH_BYTES = 8
"""The file begins with the length of its header, a little-endian integer."""

METADATA = "__metadata__"
RECIPE = "lagbench"
"""Key of the recipe within the metadata."""


def write_small_network(path: Path, root: Path) -> None:
    """Write an untrained graph network for the tiny curl noise."""
    import torch

    from lagbench.models.registered import build_registered, export_safetensors

    torch.manual_seed(7)
    options = {"latent": 16, "layers": 2, "noise_std": 0.0}
    model = build_registered(
        "gns", split="curl-noise", size="tiny", options=options, root=root
    )
    export_safetensors(model, path, baseline="gns")


def _edit_header(path: Path, edit: Callable[[Header], None]) -> None:
    """Change the header; the numbers stay."""
    data = path.read_bytes()
    end = LENGTH_BYTES + int.from_bytes(data[:LENGTH_BYTES], "little")
    header = json.loads(data[LENGTH_BYTES:end])
    edit(header)
    text = json.dumps(header).encode()
    length = len(text).to_bytes(LENGTH_BYTES, "little")
    path.write_bytes(length + text + data[end:])


def _edit_recipe(path: Path, edit: Callable[[Header], None]) -> None:
    def edit_header(header: Header) -> None:
        recipe = json.loads(header[METADATA][RECIPE])
        edit(recipe)
        header[METADATA][RECIPE] = json.dumps(recipe)

    _edit_header(path, edit_header)


def _choose_tensor(rng: np.random.Generator, header: Header) -> str:
    names = sorted(set(header) - {METADATA})
    return names[rng.integers(len(names))]


def other_length(path: Path, rng: np.random.Generator) -> None:
    """Claim a header of another length."""
    lengths = (0, 1, 7, 10**6, 2**40, 2**63, 2**64 - 1)
    length = lengths[rng.integers(len(lengths))]
    data = path.read_bytes()
    path.write_bytes(length.to_bytes(LENGTH_BYTES, "little") + data[LENGTH_BYTES:])


def other_dtype(path: Path, rng: np.random.Generator) -> None:
    """Claim that a tensor has another type."""
    dtypes = ("F64", "I8", "BOOL", "BF16", "F8_E4M3", "object", "", 5)
    dtype = dtypes[rng.integers(len(dtypes))]

    def edit(header: Header) -> None:
        header[_choose_tensor(rng, header)]["dtype"] = dtype

    _edit_header(path, edit)


def other_shape(path: Path, rng: np.random.Generator) -> None:
    """Claim that a tensor has another shape."""
    shapes: tuple[Any, ...] = ([], [0], [-1], [2**31, 2**31], [1.5], "16", None)
    shape = shapes[rng.integers(len(shapes))]

    def edit(header: Header) -> None:
        header[_choose_tensor(rng, header)]["shape"] = shape

    _edit_header(path, edit)


def other_offsets(path: Path, rng: np.random.Generator) -> None:
    """Claim that a tensor lies elsewhere."""
    offsets: tuple[Any, ...] = ([0, 4], [-8, 8], [0, 2**62], [9, 3], [0], "0", None)
    chosen = offsets[rng.integers(len(offsets))]

    def edit(header: Header) -> None:
        header[_choose_tensor(rng, header)]["data_offsets"] = chosen

    _edit_header(path, edit)


def other_tensor_name(path: Path, rng: np.random.Generator) -> None:
    """Give a tensor another name."""
    names = ("", "x" * 100_000, "../../evil", "\u202e", METADATA + "_")
    name = names[rng.integers(len(names))]

    def edit(header: Header) -> None:
        header[name] = header.pop(_choose_tensor(rng, header))

    _edit_header(path, edit)


def missing_tensor(path: Path, rng: np.random.Generator) -> None:
    """Leave a tensor out."""
    _edit_header(path, lambda header: header.pop(_choose_tensor(rng, header)))


def other_metadata(path: Path, rng: np.random.Generator) -> None:
    """Put something else where the recipe stands."""
    texts: tuple[Any, ...] = ("", "{}", "[" * 100_000, "null", 3, ["x"], "{" * 10)
    text = texts[rng.integers(len(texts))]

    def edit(header: Header) -> None:
        header[METADATA][RECIPE] = text

    _edit_header(path, edit)


def other_fact(path: Path, rng: np.random.Generator) -> None:
    """Give an option of the model, or a fact of its data, another value."""
    values: tuple[Any, ...] = (-1, 0, 10**9, 1e300, "", [], None, True, "../x", {})
    value = values[rng.integers(len(values))]

    def edit(recipe: Header) -> None:
        holders = [recipe]
        for content in recipe.values():
            if isinstance(content, dict) and content:
                holders.append(content)
        holder = holders[rng.integers(len(holders))]
        names = sorted(holder)
        holder[names[rng.integers(len(names))]] = value

    _edit_recipe(path, edit)


def hostile_number(path: Path, rng: np.random.Generator) -> None:
    """Write a number that is not finite, or huge, among the weights."""
    numbers = (np.nan, np.inf, -np.inf, 3e38)
    number = np.float32(numbers[rng.integers(len(numbers))]).tobytes()
    data = path.read_bytes()
    path.write_bytes(data[: -len(number)] + number)


SAFETENSORS: tuple[Mutation, ...] = (
    other_length,
    other_dtype,
    other_shape,
    other_offsets,
    other_tensor_name,
    missing_tensor,
    other_metadata,
    other_fact,
    other_fact,
    other_fact,
    hostile_number,
)
