"""Files of safetensors for tests: a sound one, and hostile ones made of it."""

from __future__ import annotations

import json
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
    torch.nn.init.normal_(model.network.decoder[-1].weight, std=0.1)
    return model


def sound_file(path: Path, generated: GenerationResult) -> Path:
    """Write the small model."""
    return export_safetensors(small_model(generated), path, baseline="gns")


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the header; the numbers stay."""
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    change(header)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[end:])


def rewrite_recipe(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the recipe."""

    def change_header(header: dict[str, Any]) -> None:
        recipe = json.loads(header["__metadata__"]["lagbench"])
        change(recipe)
        header["__metadata__"]["lagbench"] = json.dumps(recipe)

    rewrite(path, change_header)


def first_name(header: dict[str, Any]) -> str:
    """Return the name of the first tensor."""
    return min(name for name in header if name != "__metadata__")


def a_pickle(path: Path) -> None:
    """A pickle under that suffix."""
    path.write_bytes(pickle.dumps({"weights": [1.0]}))


def an_archive(path: Path) -> None:
    """What torch.save writes."""
    torch.save({"weights": torch.ones(3)}, path)


def cut_short(path: Path) -> None:
    """The last numbers are missing."""
    path.write_bytes(path.read_bytes()[:-100])


def an_empty_file(path: Path) -> None:
    """Nothing at all."""
    path.write_bytes(b"")


def header_beyond_the_file(path: Path) -> None:
    """A header of 2^62 bytes."""
    path.write_bytes((2**62).to_bytes(8, "little") + path.read_bytes()[8:])


def header_of_megabytes(path: Path) -> None:
    """A header that holds three million blanks."""
    rewrite(path, lambda header: header["__metadata__"].update(more=" " * 3_000_000))


def header_without_end(path: Path) -> None:
    """A header of nothing but opened lists, after one brace."""
    text = b'{"a":' + b"[" * 500_000
    path.write_bytes(len(text).to_bytes(8, "little") + text)


def file_without_end(path: Path) -> None:
    """Four gigabytes of holes."""
    with path.open("r+b") as stream:
        stream.truncate(4 << 30)


def overlapping_tensors(path: Path) -> None:
    """Two names for the same bytes."""

    def change(header: dict[str, Any]) -> None:
        header["twin"] = header[first_name(header)]

    rewrite(path, change)


def numbers_beyond_the_file(path: Path) -> None:
    """A tensor of 2^60 numbers."""

    def change(header: dict[str, Any]) -> None:
        header[first_name(header)]["shape"] = [2**30, 2**30]

    rewrite(path, change)


def without_a_recipe(path: Path) -> None:
    """Tensors alone."""
    rewrite(path, lambda header: header.pop("__metadata__"))


def recipe_that_is_no_json(path: Path) -> None:
    """Words where JSON should stand."""
    rewrite(path, lambda header: header["__metadata__"].update(lagbench="gns"))


def nested_recipe(path: Path) -> None:
    """JSON that is nested deeper than a parser goes."""
    deep = "[" * 100_000
    rewrite(path, lambda header: header["__metadata__"].update(lagbench=deep))


def another_name(path: Path) -> None:
    """A tensor that the architecture does not have, instead of one that it has."""

    def change(header: dict[str, Any]) -> None:
        header["other"] = header.pop(first_name(header))

    rewrite(path, change)


def another_shape(path: Path) -> None:
    """A tensor with its axes merged."""

    def change(header: dict[str, Any]) -> None:
        tensor = next(
            value
            for name, value in header.items()
            if name != "__metadata__" and len(value["shape"]) == 2
        )
        tensor["shape"] = [tensor["shape"][0] * tensor["shape"][1]]

    rewrite(path, change)


def _last_number(path: Path, value: float) -> None:
    number = torch.tensor(value, dtype=torch.float32).numpy().tobytes()
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    for name, tensor in header.items():
        if name != "__metadata__" and tensor["dtype"] == "F32":
            start = end + tensor["data_offsets"][0]
            path.write_bytes(data[:start] + number + data[start + len(number) :])
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
)
