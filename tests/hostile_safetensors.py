"""Files of safetensors for tests: a sound one, and hostile ones made of it."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from simple_models import SMALL

from lagbench.make.generate import GenerationResult
from lagbench.models.registered import build_registered, export_safetensors


def small_model(generated: GenerationResult) -> Any:
    """Return a small graph network for the tiny curl noise that moves particles."""
    torch.manual_seed(3)
    model: Any = build_registered(
        "gns",
        split="curl-noise",
        size="tiny",
        options=SMALL,
        root=generated.root,
    )
    last_layer = model.network.decoder[-1]
    torch.nn.init.normal_(last_layer.weight, std=0.1)
    return model


def sound_file(path: Path, generated: GenerationResult) -> Path:
    """Write the small model."""
    return export_safetensors(small_model(generated), path, baseline="gns")


Header = dict[str, Any]


def split_file(path: Path) -> tuple[Header, bytes]:
    """Return the header and the numbers of a file."""
    content = path.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    return json.loads(content[8:end]), content[end:]


def write_file(path: Path, header: bytes, numbers: bytes = b"") -> None:
    """Write a header, after its length, and numbers."""
    length = len(header).to_bytes(8, "little")
    path.write_bytes(length + header + numbers)


def rewrite(path: Path, change: Callable[[Header], object]) -> None:
    """Change the header; the numbers stay."""
    header, numbers = split_file(path)
    change(header)
    text = json.dumps(header)
    write_file(path, text.encode(), numbers)


def state(path: Path, **values: object) -> None:
    """Change what the file states beside its tensors."""
    rewrite(path, lambda header: header["__metadata__"].update(values))


def rewrite_recipe(path: Path, change: Callable[[Header], object]) -> None:
    """Change the recipe."""

    def change_header(header: Header) -> None:
        metadata = header["__metadata__"]
        recipe = json.loads(metadata["lagbench"])
        change(recipe)
        metadata["lagbench"] = json.dumps(recipe)

    rewrite(path, change_header)


def first_name(header: Header) -> str:
    """Return the name of the first tensor."""
    return min(tensors_of(header))


def tensors_of(header: Header) -> Header:
    """Return the tensors that a header describes, by name."""
    return {name: value for name, value in header.items() if name != "__metadata__"}


def a_pickle(path: Path) -> None:
    """A pickle under that suffix."""
    weights = pickle.dumps({"weights": [1.0]})
    path.write_bytes(weights)


def an_archive(path: Path) -> None:
    """What torch.save writes."""
    torch.save({"weights": torch.ones(3)}, path)


def cut_short(path: Path) -> None:
    """The last numbers are missing."""
    content = path.read_bytes()
    path.write_bytes(content[:-100])


def an_empty_file(path: Path) -> None:
    """Nothing at all."""
    path.write_bytes(b"")


def header_beyond_the_file(path: Path) -> None:
    """A header of 2^62 bytes."""
    content = path.read_bytes()
    length = (2**62).to_bytes(8, "little")
    path.write_bytes(length + content[8:])


def header_of_megabytes(path: Path) -> None:
    """A header that holds three million blanks."""
    state(path, more=" " * 3_000_000)


def header_without_end(path: Path) -> None:
    """A header of nothing but opened lists, after one brace."""
    lists = b"[" * 500_000
    write_file(path, b'{"a":' + lists)


def file_without_end(path: Path) -> None:
    """Four gigabytes of holes."""
    with path.open("r+b") as stream:
        stream.truncate(4 << 30)


def overlapping_tensors(path: Path) -> None:
    """Two names for the same bytes."""

    def change(header: Header) -> None:
        name = first_name(header)
        header["twin"] = header[name]

    rewrite(path, change)


def numbers_beyond_the_file(path: Path) -> None:
    """A tensor of 2^60 numbers."""

    def change(header: Header) -> None:
        name = first_name(header)
        header[name]["shape"] = [2**30, 2**30]

    rewrite(path, change)


def without_a_recipe(path: Path) -> None:
    """Tensors alone."""
    rewrite(path, lambda header: header.pop("__metadata__"))


def recipe_that_is_no_json(path: Path) -> None:
    """Words where JSON should stand."""
    state(path, lagbench="gns")


def nested_recipe(path: Path) -> None:
    """JSON that is nested deeper than a parser goes."""
    state(path, lagbench="[" * 100_000)


def another_name(path: Path) -> None:
    """A tensor that the architecture does not have, instead of one that it has."""

    def change(header: Header) -> None:
        name = first_name(header)
        header["other"] = header.pop(name)

    rewrite(path, change)


def another_shape(path: Path) -> None:
    """A tensor with its axes merged."""

    def change(header: Header) -> None:
        for tensor in tensors_of(header).values():
            if len(tensor["shape"]) == 2:
                rows, columns = tensor["shape"]
                tensor["shape"] = [rows * columns]
                return

    rewrite(path, change)


def _last_number(path: Path, value: float) -> None:
    number = torch.tensor(value, dtype=torch.float32).numpy().tobytes()
    header, numbers = split_file(path)
    for tensor in tensors_of(header).values():
        if tensor["dtype"] == "F32":
            start, _ = tensor["data_offsets"]
            with path.open("r+b") as stream:
                stream.seek(start - len(numbers), os.SEEK_END)
                stream.write(number)
            return


def not_a_number(path: Path) -> None:
    """A weight that is NaN."""
    _last_number(path, float("nan"))


def an_infinite_weight(path: Path) -> None:
    """A weight that is infinite."""
    _last_number(path, float("inf"))


def an_unknown_architecture(path: Path) -> None:
    """A baseline that nobody registered."""
    rewrite_recipe(path, lambda recipe: recipe.update(baseline="os.system"))


def options_beyond_all_memory(path: Path) -> None:
    """Layers of 10^7 channels."""
    rewrite_recipe(path, lambda recipe: recipe["options"].update(latent=10**7))


def options_of_layers_without_end(path: Path) -> None:
    """Small layers, 10^9 of them."""
    rewrite_recipe(path, lambda recipe: recipe["options"].update(layers=10**9))


HOSTILE = (
    a_pickle,
    an_archive,
    cut_short,
    an_empty_file,
    header_beyond_the_file,
    header_of_megabytes,
    header_without_end,
    file_without_end,
    overlapping_tensors,
    numbers_beyond_the_file,
    without_a_recipe,
    recipe_that_is_no_json,
    nested_recipe,
    another_name,
    another_shape,
    not_a_number,
    an_infinite_weight,
    an_unknown_architecture,
    options_beyond_all_memory,
    options_of_layers_without_end,
)
