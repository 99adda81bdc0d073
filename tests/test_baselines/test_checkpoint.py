"""Checkpoints: what comes back; what is refused, larger models too; and that nothing in
a file is run.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import shutil
import struct
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import INFO, Drift, install

from lagbench.baselines import checkpoint
from lagbench.baselines.catalogue import find, list_names
from lagbench.baselines.checkpoint import (
    Checkpoint,
    check_data,
    load,
    load_weights,
    restore,
    round_weights,
    save,
)
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.data.manifest import read_or_empty, write_manifest
from lagbench.data.registry import Registry
from lagbench.data.registry import load as load_registry
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult


def example(**changes: Any) -> Checkpoint:
    """Return a checkpoint of a Drift whose parameter needs all bits of a float32."""
    options = {"start": 1 / 3}
    model = Drift.build(options, INFO)
    recipe = {"training": {"seed": 4}}
    fields = {
        "baseline": "drift",
        "options": options,
        "info": INFO,
        "weights": model.state_dict(),
        "training": {"step": 3, "recipe": recipe},
    }
    return Checkpoint(**{**fields, **changes})


def test_a_checkpoint_comes_back_as_it_was_stored(tmp_path: Path) -> None:
    """Everything comes back as it was stored, the optimiser's state too."""
    weight = torch.nn.Parameter(torch.ones(2))
    optimizer = torch.optim.AdamW([weight])
    weight.grad = torch.tensor([0.5, 2.0])
    optimizer.step()
    stored = example(optimizer=optimizer.state_dict())
    save(tmp_path / "a.pt", stored)
    loaded = load(tmp_path / "a.pt")
    assert loaded.baseline == stored.baseline
    assert loaded.options == stored.options
    assert loaded.info == INFO
    assert loaded.training == stored.training
    assert torch.equal(loaded.weights["a"], stored.weights["a"])
    # Adam's first moment after one step: (1 - 0.9) x gradient.
    state = loaded.optimizer["state"][0]
    first_moment = state["exp_avg"].tolist()
    assert first_moment == pytest.approx([0.05, 0.2])


def bits_of(tensor: torch.Tensor) -> NDArray[np.uint32]:
    """Return the bits of float32 numbers."""
    return tensor.detach().numpy().view(np.uint32)


def test_parameters_are_rounded_and_buffers_keep_every_bit() -> None:
    """Parameters are rounded to nearest-even in their upper 16 bits; buffers keep every
    bit.
    """
    model = torch.nn.BatchNorm1d(1000)
    generator = torch.Generator()
    generator.manual_seed(0)
    torch.nn.init.normal_(model.weight, generator=generator)
    generator.manual_seed(1)
    torch.nn.init.normal_(model.running_mean, generator=generator)
    bits = bits_of(model.weight)
    last_kept_bit = (bits >> 16) & 1
    upper = (bits + 0x7FFF + last_kept_bit) >> 16
    loaded = round_weights(model)
    assert loaded["weight"].dtype is torch.bfloat16
    rounded_bits = bits_of(loaded["weight"].float())
    assert np.array_equal(rounded_bits, upper << 16)
    assert torch.equal(loaded["running_mean"], model.running_mean)


class Bomb:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        """Name what unpickling runs."""
        return os.mkdir, (str(self.path),)


WRITERS = ["pickle", "torch", "torch, old layout", "inside"]


@pytest.mark.parametrize("writer", WRITERS)
def test_a_pickle_is_refused_and_not_run(tmp_path: Path, writer: str) -> None:
    """A file that would run code when unpickled is refused, and the code is not run."""
    file = tmp_path / "bomb.pt"
    target = tmp_path / "exploded"
    bomb = Bomb(target)
    if writer == "pickle":
        file.write_bytes(pickle.dumps(bomb))
    elif writer == "inside":
        content = {
            "lagbench_checkpoint": 1,
            "about": "{}",
            "weights": {},
            "optimizer": bomb,
        }
        torch.save(content, file)
    else:
        is_new = writer == "torch"
        torch.save(bomb, file, _use_new_zipfile_serialization=is_new)
    with pytest.raises(UnreadableFileError) as caught:
        load(file)
    assert caught.value.where.endswith("bomb.pt")
    # torch's own words advise to load it unsafely
    assert "weights_only" not in str(caught.value)
    assert not target.exists()
    pickle.loads(pickle.dumps(bomb))  # the bomb is a real one
    assert target.exists()


def test_text_is_no_pickle(tmp_path: Path) -> None:
    """The error says that another file is no checkpoint, and which file of a folder to
    name.
    """
    (tmp_path / "notes.md").write_text("# hello\n")
    with pytest.raises(UnreadableFileError) as caught:
        load(tmp_path / "notes.md")
    assert caught.value.where.endswith("notes.md")
    with pytest.raises(UnreadableFileError) as caught:
        load(tmp_path)
    assert "weights.pt" not in str(caught.value)
    (tmp_path / "weights.pt").touch()
    with pytest.raises(UnreadableFileError):
        load(tmp_path)


def test_predictions_in_the_place_of_weights_are_named(tmp_path: Path) -> None:
    path = tmp_path / "predictions.nc"
    with netCDF4.Dataset(path, "w"):
        pass
    with pytest.raises(UnreadableFileError) as caught:
        load(path)
    assert "HDF5" in str(caught.value.got)


def test_scripts_are_refused(tmp_path: Path) -> None:
    """A TorchScript archive, which holds code too, is refused."""
    module = torch.nn.ReLU()
    file = tmp_path / "script.pt"
    with pytest.warns(DeprecationWarning, match="torch.jit"):
        torch.jit.save(torch.jit.script(module), file)
    with pytest.raises(UnreadableFileError):
        load(file)


def plain_content(
    *,
    number: int = 1,
    about: object = "{}",
) -> dict[str, object]:
    """Return a file's content without weights."""
    return {
        "lagbench_checkpoint": number,
        "about": about,
        "weights": {},
    }


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a checkpoint at all",
        b"PK\x03\x04 broken",
        {"weights": {}},
        torch.zeros(3),
        plain_content(number=2),
        plain_content(about="{"),
        plain_content(),
        plain_content(about=5),
    ],
)
def test_other_files_are_unreadable(tmp_path: Path, content: object) -> None:
    """The error for a file that is no checkpoint of ours names the file."""
    file = tmp_path / "other.pt"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        torch.save(content, file)
    with pytest.raises(UnreadableFileError) as caught:
        load(file)
    assert caught.value.where.endswith("other.pt")


ONE = torch.ones(1)


@pytest.mark.parametrize(
    "change",
    [
        ("training", "recipe", []),
        ("training", "recipe", "training", []),
        ("training", "recipe", "training", "seed", "three"),
        ("training", "recipe", "training", "seed", 10**30),
        ("training", "recipe", "training", "windows", [1]),
        ("training", "recipe", "name", "x" * 10**6),
        ("training", "step", "last"),
        ("facts", "split", "../curl-noise"),
        ("facts", "size", "../tiny"),
        ("facts", "particles", -3),
        ("facts", "radius", math.inf),
        ("facts", "statistics", "velocity_std", [math.nan, 1.0]),
        ("facts", "statistics", "velocity_std", [1.0, 1.0, 1.0]),
        ("facts", "statistics", "velocity_std", [1.0]),
        ("facts", "statistics", "velocity_std", []),
        ("facts", "bounds", [[1.0, 0.0], [0.0, 1.0]]),
        ("facts", "periodic", ["z"]),
        {"optimizer": 5},
        {"about": "[" * 10**5},
        {"lagbench_checkpoint": torch.ones(2)},
        {"lagbench_checkpoint": True},
        {"weights": {"a": ONE.expand(10**12)}},
        {"weights": {"a": ONE.to_sparse()}},
        {"weights": {"a": ONE.to(torch.complex64)}},
        {"weights": {"a": ONE.to("meta")}},
    ],
)
def test_strange_words_and_tensors_are_refused(
    tmp_path: Path,
    change: tuple[Any, ...] | dict[str, Any],
) -> None:
    """A stranger's words are what they should be, or nothing; weights are numbers that
    the file holds.
    """
    file = tmp_path / "strange.pt"
    save(file, example())
    content = torch.load(file, weights_only=True)
    if isinstance(change, tuple):  # keys, and the value where they lead
        about = place = json.loads(content["about"])
        *path, key, value = change
        for step in path:
            place = place[step]
        place[key] = value
        change = {"about": json.dumps(about)}
    torch.save({**content, **change}, file)
    with pytest.raises(UnreadableFileError) as caught:
        load(file)
    assert caught.value.where.endswith("strange.pt")


def test_missing_truncated_files_and_pipes_are_unreadable(tmp_path: Path) -> None:
    """A pipe without a writer would otherwise block the reader."""
    os.mkfifo(tmp_path / "pipe.pt")
    save(tmp_path / "cut.pt", example())
    whole = (tmp_path / "cut.pt").read_bytes()
    half = len(whole) // 2
    (tmp_path / "cut.pt").write_bytes(whole[:half])
    longer_than_a_name = "x" * 300
    for name, words in (
        ("none.pt", "no such file"),
        ("cut.pt", None),
        ("pipe.pt", None),
        (longer_than_a_name, None),
    ):
        with pytest.raises(UnreadableFileError, match=words) as caught:
            load(tmp_path / name)
        assert caught.value.where == str(tmp_path / name)


def test_what_is_saved_can_be_loaded_or_is_refused(tmp_path: Path) -> None:
    """A tensor may be a view of more memory, or of less, than it has numbers."""
    file = tmp_path / "views.pt"
    long_row = torch.arange(10**6, dtype=torch.float32)
    views = {"repeated": ONE.expand(5), "short": long_row[3:6]}
    save(file, example(weights=views))
    loaded = load(file)
    for name, value in views.items():
        assert torch.equal(loaded.weights[name], value)
    assert file.stat().st_size < 10**5

    others: tuple[Any, ...] = (
        ONE.to_sparse(),
        ONE.to(torch.complex64),
        ONE.to("meta"),
        {"a": 1},
    )
    for value in others:
        for suffix in (".pt", ".safetensors"):
            path = tmp_path / f"other{suffix}"
            with pytest.raises(UsageError) as caught:
                save(path, example(weights={"a": value}))
            assert caught.value.where.startswith(str(path))
            assert not path.exists()


NO_CALLS = torch.tensor(0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"weights": {"a": math.nan * ONE, "calls": NO_CALLS}},
            "not finite",
        ),
        (
            {"weights": {"a": torch.zeros(2), "calls": NO_CALLS}},
            "do not fit",
        ),
        (
            {"weights": {"a": torch.zeros(1)}},
            "do not fit",
        ),
        (
            {"options": {"sart": 1}},
            "sart",
        ),
        (
            {
                "baseline": "mlp",
                "options": {},
                "info": replace(INFO, statistics={}),
            },
            "position_mean",
        ),
        (
            {
                "baseline": "gns",
                "options": {},
                "info": replace(INFO, score_placement="edges"),
            },
            "statistics|edges|acceleration",
        ),
    ],
)
def test_weights_that_do_not_fit_the_model_are_refused(
    changes: dict[str, Any],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Weights that are not finite or belong to another model are refused."""
    install(monkeypatch, drift=Drift)
    with pytest.raises(UnreadableFileError, match=message):
        restore(example(**changes))


def test_an_error_tells_how_many_more_weights_are_not_finite() -> None:
    """It names the first ones alone."""
    weights = {f"layer_{letter}": math.nan * ONE for letter in "abcdefghijk"}
    with pytest.raises(UnreadableFileError) as caught:
        load_weights(torch.nn.Linear(1, 1), weights, where="a.pt")
    got = str(caught.value.got)
    shown = sum(name in got for name in weights)
    assert 0 < shown < len(weights)
    assert str(len(weights) - shown) in got


def test_the_error_for_an_unknown_baseline_names_the_file() -> None:
    """A checkpoint of a baseline that is not installed says so, and which file it
    is.
    """
    with pytest.raises(UsageError) as caught:
        restore(example(), where="a.pt")
    assert caught.value.where == "a.pt"


def test_incomplete_data_of_other_bits_have_no_hash(
    generated: GenerationResult, tmp_path: Path
) -> None:
    """Those of a machine that promises equal bits have the hash of datasets.yaml."""
    size = load_registry().size("curl-noise", "tiny")
    shutil.copytree(size.folder(generated.root), size.folder(tmp_path))
    whole = read_or_empty(size, generated.root)
    files = [entry for entry in whole.files if entry.subset != "test"]
    hashes = {name: whole.subset_sha256[name] for name in ("train", "valid")}
    incomplete = whole.model_copy(
        update={
            "complete": False,
            "dataset_sha256": None,
            "subset_sha256": hashes,
            "files": tuple(files),
        }
    )
    write_manifest(tmp_path, incomplete)
    info = read_dataset_info("curl-noise", "tiny", root=tmp_path)
    assert info.dataset_sha256 == size.measured.dataset_sha256

    other_bits = incomplete.model_copy(update={"identity": "tolerance"})
    write_manifest(tmp_path, other_bits)
    with pytest.raises(DataError) as caught:
        read_dataset_info("curl-noise", "tiny", root=tmp_path)
    assert str(tmp_path) in str(caught.value.where)


def test_data_of_another_version(
    generated: GenerationResult, unmeasured: Registry
) -> None:
    """The data at hand must have the hash of the data that the model was trained on."""
    root = generated.root
    for split, there, words in (
        ("curl-noise", root, "another version"),
        ("curl-noise", root / "nowhere", "lagbench generate"),
        ("my-river", root, "where: a.pt"),  # a local split of another root
    ):
        info = replace(INFO, split=split)
        loaded = example(info=info)
        with pytest.raises(DataError, match=words):
            check_data(loaded, root=there, registry=unmeasured, where="a.pt")


def test_an_archive_that_unpacks_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 MB of zeros in 100 kB: refused by its directory, before they are unpacked."""
    monkeypatch.setattr(checkpoint, "MOST_BYTES", 10**7)
    save(tmp_path / "a.pt", example())
    bomb = tmp_path / "bomb.pt"
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as old,
        zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for member in old.infolist():
            new.writestr(member.filename, old.read(member))
        new.writestr("big", bytes(10**8))
    assert bomb.stat().st_size < 10**6
    tracemalloc.start()
    with pytest.raises(UnreadableFileError) as caught:
        load(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert caught.value.where == str(bomb)
    assert peak < 10**7


def test_a_flipped_byte_is_unreadable(tmp_path: Path) -> None:
    """Any byte of any member: its checksum is another. Bytes between members are
    padding.
    """
    save(tmp_path / "a.pt", example())
    data = (tmp_path / "a.pt").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.pt") as archive:
        for member in archive.infolist():
            if not member.file_size:
                continue
            start = member.header_offset
            lengths = struct.unpack_from("<HH", data, start + 26)
            content = start + 30 + sum(lengths)
            flipped = bytearray(data)
            flipped[content + member.file_size // 2] ^= 1
            (tmp_path / "b.pt").write_bytes(flipped)
            with pytest.raises(UnreadableFileError):
                load(tmp_path / "b.pt")


KINDS = [
    f"{name}_{of}"
    for name in ("position", "velocity", "acceleration")
    for of in ("mean", "std")
]
WHOLE = replace(INFO, statistics=dict.fromkeys(KINDS, (0.5, 0.5)))

Options = dict[str, Any]

GRAPH_NETWORK: Options = {
    "latent": 4,
    "layers": 2,
}
SMALL_MODELS: dict[str, Options] = {
    "neuralmpm": {
        "cells": 8,
        "width": 4,
        "materials": [0, 1, 2, 3],
    },
    "mlp": {"widths": [4]},
    "lstm": {"latent": 4, "decoder": [4]},
    "lstm-mlp": {"latent": 4, "decoder": [4]},
    "var": {"lags": 1},
    "var-stable": {"rank": 2},
    "hybrid-projection": {"resolution": 1.0},
    "hybrid-coarse": {},
}
"""Options of small models; all others are graph networks."""


def stored(baseline: str) -> Checkpoint:
    """Return the checkpoint of a small model."""
    options = SMALL_MODELS.get(baseline, GRAPH_NETWORK)
    figures = WHOLE
    if baseline == "hybrid-coarse":  # knows free surfaces only
        figures = replace(WHOLE, split="multimaterial", size="tiny")
    model = find(baseline).model.build(options, figures)
    return Checkpoint(
        baseline=baseline,
        options=options,
        info=figures,
        weights=model.state_dict(),
    )


@pytest.mark.parametrize("baseline", list_names())
def test_what_the_weights_fill_is_built(baseline: str) -> None:
    """Every baseline comes back with the numbers of its weights."""
    loaded = stored(baseline)
    state = restore(loaded).state_dict()
    for name, value in loaded.weights.items():
        assert torch.equal(state[name], value), name


def test_a_model_beyond_all_memory_is_refused() -> None:
    """Options for 10^12 numbers and more are those of an unreadable file."""
    checkpoint_of_var = stored("var")
    too_many = {"lags": 10**13}
    larger = replace(checkpoint_of_var, options=too_many)
    with pytest.raises(UnreadableFileError) as caught:
        restore(larger, where="theirs.pt")
    assert caught.value.where == "theirs.pt"


@pytest.mark.slow
def test_weights_of_the_board_can_be_run() -> None:
    """Every file that stands beside an entry is one that today's models are built
    from.
    """
    root = Path(__file__).parents[2]
    weights = root / "leaderboard" / "weights"
    files = sorted(weights.rglob("*.pt"))
    assert len(files) > 30
    for file in files:
        model = restore(load(file), where=str(file))
        assert model.method
