"""Models in the safetensors format: of registered architectures, with their recipe."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import SIZE, SPLIT
from hostile_safetensors import (
    HOSTILE,
    not_a_number,
    rewrite_recipe,
    small_model,
    sound_file,
)

from lagbench.baselines.checkpoint import load, restore
from lagbench.baselines.predict import predict
from lagbench.baselines.weights_check import check_in_child, examine
from lagbench.board.check import check_board
from lagbench.board.entry import Level, Meta
from lagbench.board.reproduce import reproduce
from lagbench.board.submit import submit
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.models.registered import build_registered, export_safetensors

MOST_SECONDS = 5.0  # until a hostile file is refused [s]


@pytest.fixture
def sound(tmp_path: Path, generated: GenerationResult) -> Path:
    """A file that can be used; the test may change it."""
    return sound_file(tmp_path / "model.safetensors", generated)


def test_weights_and_recipe_come_back(sound: Path, generated: GenerationResult) -> None:
    """To the bit, and with the options that have defaults."""
    model = small_model(generated)
    checkpoint = load(sound)
    restored = restore(checkpoint)
    assert checkpoint.baseline == "gns"
    assert restored.options == model.options
    for name, value in model.state_dict().items():
        assert torch.equal(restored.state_dict()[name], value), name
    assert examine(str(sound)) == {"refused": None, "fix": None}


def test_an_export_touches_no_other_file(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Another process may export to the same file. The folder is made."""
    folder = tmp_path / "new"
    path = sound_file(folder / "model.safetensors", generated)
    another_export = folder / ".model.exporting.safetensors"
    another_export.write_text("of another process")
    sound_file(path, generated)
    assert {another_export, path} == {*folder.iterdir()}


@pytest.mark.parametrize("spoil", HOSTILE, ids=lambda spoil: spoil.__name__)
def test_a_hostile_file_is_refused(spoil: Callable[[Path], None], sound: Path) -> None:
    """With a reason, and soon.

    The checks run in this process here, for speed; the child is tested below.
    """
    spoil(sound)
    started = time.process_time()
    assert examine(str(sound))["refused"]
    assert time.process_time() - started < MOST_SECONDS


def test_a_header_may_be_as_long_as_a_pickle_begins(sound: Path) -> None:
    """A file that begins with the bytes 80 02 is a pickle, or has such a header."""
    data = sound.read_bytes()
    length = int.from_bytes(data[:8], "little")
    longer = (length // 2**16 + 1) * 2**16 + 0x0280
    header = data[8 : 8 + length].ljust(longer)
    sound.write_bytes(longer.to_bytes(8, "little") + header + data[8 + length :])
    assert sound.read_bytes().startswith(b"\x80\x02")
    assert load(sound).baseline == "gns"


@pytest.mark.slow
def test_the_checks_run_in_a_child(sound: Path) -> None:
    """What it refuses is an error of an unreadable file here."""
    check_in_child(sound)
    not_a_number(sound)
    with pytest.raises(UnreadableFileError) as caught:
        check_in_child(sound)
    assert caught.value.where == str(sound)


@pytest.mark.parametrize(
    "options",
    [{"latent": None}, {"latent": 0}, {"lattent": 8}, {3: 8}, {"noise_std": "much"}],
)
def test_options_that_do_not_fit_have_an_error_of_all_parts(
    options: dict[Any, Any], generated: GenerationResult
) -> None:
    """With all parts of a message, as those of a recipe."""
    with pytest.raises(UsageError) as caught:
        build_registered(
            "gns", split=SPLIT, size=SIZE, options=options, root=generated.root
        )
    error = caught.value
    assert error.where == "build_registered"
    assert None not in (error.expected, error.got, error.fix)


def test_what_cannot_be_exported_is_refused(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Another suffix, another architecture, a negative or a huge seed or step, weights
    that are not finite.
    """
    model = small_model(generated)
    with pytest.raises(UsageError):
        export_safetensors(model, tmp_path / "model.pt", baseline="gns")
    with pytest.raises(UnreadableFileError):
        export_safetensors(model, tmp_path / "a.safetensors", baseline="neuralmpm")
    for name, number in itertools.product(("seed", "step"), (-1, 2**63)):
        with pytest.raises(UsageError) as caught:
            export_safetensors(
                model, tmp_path / "a.safetensors", baseline="gns", **{name: number}
            )
        assert caught.value.where == name
    next(model.parameters()).data[:] = torch.nan
    with pytest.raises(UnreadableFileError):
        export_safetensors(model, tmp_path / "a.safetensors", baseline="gns")
    assert list(tmp_path.iterdir()) == []


def test_seed_and_step_may_be_integers_of_numpy(
    tmp_path: Path, generated: GenerationResult
) -> None:
    path = export_safetensors(
        small_model(generated),
        tmp_path / "a.safetensors",
        baseline="gns",
        seed=np.int64(3),
        step=np.int32(5),
    )
    training = load(path).training
    assert training["step"] == 5
    assert training["recipe"]["training"]["seed"] == 3


@pytest.mark.slow
def test_an_entry_carries_a_file_of_safetensors(
    tmp_path: Path, sound: Path, generated: GenerationResult
) -> None:
    """It is submitted, checked, and predicts the scores of its entry again."""
    board = tmp_path / "board"
    root = generated.root
    predictions = tmp_path / "predictions.nc"
    predict(sound, predictions, root=root, device="cpu", threads=1, method="own")
    meta = Meta(authors=("A. Author",), command="make")
    submit([predictions], meta, board=board, root=root, new_board=True, weights=[sound])
    weights = board / "weights/curl-noise/tiny/own_0.safetensors"
    assert weights.read_bytes() == sound.read_bytes()
    assert check_board(board, root=root, isolated=False).findings == ()

    result = reproduce(board, ["curl-noise/tiny/own"], root=root, costs=False)
    (line,) = result.lines.values()
    assert line.level is Level.REPRODUCED
    assert line.reproduced[0].difference == 0.0

    rewrite_recipe(sound, lambda recipe: recipe["options"].update(layers=3))
    assert examine(str(sound))["refused"]
