"""The truth is hashed before it is used: changed files are refused, unchanged ones cost little."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from submission_data import Bench, make_bench

from lagbench.data.layout import NOTES_NAME
from lagbench.data.registry import Registry
from lagbench.errors import DataError
from lagbench.make.generate import GenerationResult
from lagbench.make.verify import verify
from lagbench.scoring.score import score
from lagbench.submission import template
from lagbench.submission import truth as module
from lagbench.submission.truth import Truth


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """A small data set whose hashes are recorded, and a valid submission."""
    return make_bench(tmp_path)


def truth_of(bench: Bench) -> Truth:
    """The test subset."""
    return Truth(bench.registry.size("cavity", "tiny"), bench.root)


def change(path: Path, *, keep_times: bool = False) -> None:
    """Change one value of a file and nothing else."""
    before = path.stat()
    with h5py.File(path, "r+") as file:
        file["position"][1, 2, 0] += 0.001
    if keep_times:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Files whose values are hashed during a test."""
    found: list[Path] = []
    check = module.check_scenario

    def listen(path: Path) -> str:
        found.append(path)
        return check(path)

    monkeypatch.setattr(module, "check_scenario", listen)
    return found


def test_a_changed_value_is_refused(bench: Bench) -> None:
    """One value, all attributes kept: exit code 4, naming the file and the command that mends it."""
    path = truth_of(bench).path(4)
    change(path)
    result = bench.validate(bench.valid)
    assert (result.exit_code, {f.check for f in result.errors}) == (4, {"dataset"})
    assert str(path) in result.errors[0].where
    assert "lagbench generate --split cavity --size tiny --subset test" in result.errors[0].fix
    assert set(result.skipped) == {"start", "discontinuous_start", "max_displacement"}


def test_a_change_after_the_check_is_seen(bench: Bench, hashed: list[Path]) -> None:
    """What was noted counts for the bytes that were hashed, also where the times were put back."""
    assert bench.validate(bench.valid).valid
    path = truth_of(bench).path(4)
    change(path, keep_times=True)
    hashed.clear()
    with pytest.raises(DataError) as caught:
        truth_of(bench).check()
    assert (caught.value.exit_code, hashed) == (4, [path])


def test_values_are_hashed_once(bench: Bench, hashed: list[Path]) -> None:
    """The second check reads notes."""
    truth_of(bench).check()
    assert len(hashed) == 3
    truth_of(bench).check()
    assert len(hashed) == 3


def test_notes_of_another_machine_count_for_nothing(bench: Bench, tmp_path: Path, hashed: list[Path]) -> None:
    """A folder is copied with its notes: its files are hashed again."""
    truth_of(bench).check()
    root = tmp_path / "copy"
    shutil.copytree(bench.root, root)
    Truth(bench.registry.size("cavity", "tiny"), root).check()
    assert len(hashed) == 6


@pytest.mark.parametrize("text", ["", "[]", "{", '{"test/0004.nc": 1}', '{"test/0004.nc": [1]}', "[" * 10**5])
def test_damaged_notes_are_no_notes(bench: Bench, text: str) -> None:
    """The files are hashed, and the notes written anew."""
    notes = truth_of(bench).folder / NOTES_NAME
    notes.write_text(text)
    truth_of(bench).check()
    assert set(json.loads(notes.read_text())) == {f"test/{i:04d}.nc" for i in (3, 4, 5)}


def test_another_data_set_of_its_own_right_is_refused(bench: Bench) -> None:
    """A file that agrees with itself, but not with datasets.yaml."""
    held = truth_of(bench)
    size = held.size
    assert size.measured is not None
    other = size.measured.model_copy(update={"scenario_sha256": {3: "0" * 16, 4: "0" * 16, 5: "0" * 16}})
    with pytest.raises(DataError) as caught:
        Truth(size.model_copy(update={"measured": other}), bench.root).check()
    assert caught.value.expected == "0" * 16


def test_the_scorer_refuses_a_changed_truth(
    copied: Callable[[], Path], unmeasured: Registry, tmp_path: Path, generated: GenerationResult
) -> None:
    """Of a data set that only its manifest records; generate and verify have noted what they hashed."""
    assert (generated.folder / NOTES_NAME).is_file()
    root = copied()
    verify("curl-noise", "tiny", root=root, registry=unmeasured)
    made = template("curl-noise", "tiny", output=tmp_path / "p.nc", root=root, registry=unmeasured)
    score(made.path, root=root, registry=unmeasured, write=False)
    change(Truth(unmeasured.size("curl-noise", "tiny"), root).path(4), keep_times=True)
    with pytest.raises(DataError) as caught:
        score(made.path, root=root, registry=unmeasured, write=False)
    assert caught.value.exit_code == 4
