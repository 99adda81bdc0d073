"""Imports: what comes back is what was there, and nothing in a file is run."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Result
from exchange_readers import read_gns, read_h5, straight_runs
from exchange_writers import SUBSETS, write_gns, write_h5
from numpy.testing import assert_array_equal

import lagbench
from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.exchange import export, import_split
from lagbench.make.generate import GenerationResult


def positions(folder: Path, subset: str = "train") -> np.ndarray:
    """Return the positions of a local split's subset."""
    with lagbench.open_split(str(folder), subset=subset) as data:
        return np.asarray(data["position"].values)


@pytest.mark.parametrize(
    "form", ["gns-npz", "lagrangebench-h5", "lagrangebench-h5 --from-walls"]
)
def test_an_export_comes_back(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    form: str,
) -> None:
    """Every subset has the stored bits again, and the task is the exported one.

    Only the effective viscosity, which was fitted to our data, is not in those formats.
    """
    name, _, walls = form.partition(" ")
    options: dict[str, Any] = {
        "root": generated.root,
        "registry": unmeasured,
        "from_walls": bool(walls),
    }
    export(
        "curl-noise",
        "tiny",
        format=name,
        output=tmp_path / "out",
        **options,
    )
    own_split = import_split(tmp_path / "out", format=name, output=tmp_path / "back")
    for subset in SUBSETS:
        with lagbench.open_split(
            "curl-noise",
            subset=subset,
            size="tiny",
            root=generated.root,
        ) as data:
            assert_array_equal(
                positions(own_split.folder, subset), data["position"].values
            )
            mass = data["particle_mass"].values[0]
    here = locate(str(own_split.folder)).size
    there = unmeasured.size("curl-noise", "tiny")
    expected_task = there.task.model_copy(update={"effective_viscosity": None})
    assert here.task == expected_task
    assert here.bounds == there.bounds
    assert here.frame_interval == there.frame_interval
    with lagbench.open_split(str(own_split.folder)) as data:
        assert data["particle_mass"].values[0] == pytest.approx(mass, rel=1e-12)


@pytest.mark.parametrize("form", ["gns-npz", "lagrangebench-h5"])
def test_imported_data_equal_the_source(tmp_path: Path, form: str) -> None:
    """Positions of the local split are those that a reader takes, and a force.py beside
    them is not run.
    """
    gns = form == "gns-npz"
    source = (write_gns if gns else write_h5)(tmp_path / "in", straight_runs(3))
    (source / "force.py").write_text(f"open({str(tmp_path / 'trace')!r}, 'w')")
    own_split = import_split(source, format=form, output=tmp_path / "own")
    assert not (tmp_path / "trace").exists()
    read = (read_gns if gns else read_h5)(source / ("train.npz" if gns else "train.h5"))
    assert_array_equal(positions(own_split.folder), [run for run, _ in read])
    interval = 0.01 if gns else 0.05
    assert locate(str(own_split.folder)).size.frame_interval == pytest.approx(interval)


def test_another_horizon_drops_the_frames_of_the_exported_task(tmp_path: Path) -> None:
    """With a horizon of the user's own the frame of interest is again the last
    predicted one.
    """
    hints = {"lagbench": {"horizon": 6, "frames_of_interest": [10]}}
    source = write_gns(tmp_path / "in", straight_runs(3), **hints)
    first_split = import_split(source, format="gns-npz", output=tmp_path / "a")
    # None says nothing: metadata do
    options: dict[str, Any] = {
        "horizon": 3,
        "radius": None,
        "bounds": None,
    }
    own = import_split(
        source,
        format="gns-npz",
        output=tmp_path / "b",
        **options,
    )
    interest = [
        locate(str(own_split.folder)).size.task.frames_of_interest
        for own_split in (first_split, own)
    ]
    assert interest == [(10,), (8,)]


@pytest.mark.parametrize("protocol", [3, 4])
def test_pickles_of_arrays_are_read(tmp_path: Path, protocol: int) -> None:
    """Pairs and triples, joint and single, as any NumPy saves them, doubles rounded to
    float32.
    """
    runs = [run.astype(np.float64) + 1e-9 for run in straight_runs(3)]
    source = write_gns(tmp_path / "in", runs)
    joint = np.empty(2, dtype=object)
    joint[:] = [(runs[0], np.full(40, 6), 0.3), (runs[1], 7, 0.3)]
    with (
        zipfile.ZipFile(source / "train.npz", "w") as archive,
        archive.open("gns_data.npy", "w") as stream,
    ):
        header = {
            "descr": "|O",
            "fortran_order": False,
            "shape": (2,),
        }
        np.lib.format.write_array_header_1_0(stream, header)
        pickle.dump(joint, stream, protocol=protocol)
    own_split = import_split(source, format="gns-npz", output=tmp_path / "own")
    assert own_split.scenarios["train"] == 2
    assert_array_equal(
        positions(own_split.folder), np.stack(runs[:2]).astype(np.float32)
    )
    with lagbench.open_split(str(own_split.folder), subset="train") as data:
        assert data["material"].values[:, 0].tolist() == [2, 1]
        assert data.attrs["material_property"] == 0.3


def test_arrays_in_the_order_of_fortran_are_read(tmp_path: Path) -> None:
    """Of numbers and of objects: NumPy lists objects in the order of C all the same."""
    runs = straight_runs(3)
    source = write_gns(tmp_path / "in", runs)
    joint = np.empty((2, 2), dtype=object, order="F")
    for row, run in enumerate(runs[:2]):
        joint[row, 0] = np.asfortranarray(run)
        joint[row, 1] = np.full(40, 6)
    np.savez(source / "train.npz", gns_data=joint)
    own_split = import_split(source, format="gns-npz", output=tmp_path / "own")
    assert_array_equal(positions(own_split.folder), np.stack(runs[:2]))


def test_kinds_without_a_material(tmp_path: Path) -> None:
    """Walls are refused until the user says what they are; padding is left out by
    itself.
    """
    kinds = np.array([0] * 30 + [1] * 6 + [-1] * 4)
    source = write_h5(tmp_path / "in", straight_runs(3), kinds)
    with pytest.raises(UnreadableFileError) as caught:
        import_split(source, format="lagrangebench-h5", output=tmp_path / "own")
    assert caught.value.where.endswith("in/train.h5, group '00000'")
    named = import_split(
        source,
        format="lagrangebench-h5",
        output=tmp_path / "a",
        kinds={1: "rope"},
    )
    dropped = import_split(
        source,
        format="lagrangebench-h5",
        output=tmp_path / "b",
        kinds={1: "drop"},
    )
    assert named.particles == (36, 36)
    assert dropped.particles == (30, 30)
    assert_array_equal(positions(dropped.folder)[0], straight_runs(3)[0][:, :30])


def test_a_crossing_of_a_periodic_boundary_is_a_short_step(tmp_path: Path) -> None:
    """The metadata say that the box is periodic; the split says it too."""
    runs = straight_runs(3)
    runs[1][4:, 0] = [0.999, 0.5]
    runs[1][5:, 0] = [0.003, 0.5]
    periodic = {
        "periodic_boundary_conditions": [True, True],
        "bounds": [[0, 1], [0, 1]],
    }
    source = write_h5(tmp_path / "in", runs, **periodic)
    own_split = import_split(source, format="lagrangebench-h5", output=tmp_path / "own")
    size = locate(str(own_split.folder)).size
    assert size.box.periodic == (True, True)
    with lagbench.open_split(str(own_split.folder), subset="valid") as data:
        velocity = np.asarray(data["velocity"].values)[0, 5, 0]  # [length/s]
    assert velocity[0] * size.frame_interval == pytest.approx(0.004, rel=1e-3)


def test_what_the_user_says_goes_before_the_metadata(
    tmp_path: Path, run: Callable[..., Result]
) -> None:
    """`lagbench import` takes radius, task and box from its options where they are
    given.
    """
    source = write_h5(
        tmp_path / "in",
        straight_runs(3, box=3.0),
        bounds=[[0, 3], [0, 3]],
        dx=0.2,
    )
    arguments = [
        "import",
        source,
        "--format",
        "lagrangebench-h5",
        "-o",
        tmp_path / "own",
    ]
    refused = run(*arguments)
    assert refused.exit_code == 4
    assert "--rescale" in refused.output
    options = [
        "--rescale",
        "--radius",
        "0.4",
        "--horizon",
        "4",
        "--input-frames",
        "2",
        "--full-box",
    ]
    done = run(*arguments, *options)
    assert done.exit_code == 0, done.output
    size = locate(str(tmp_path / "own")).size
    assert size.task.radius == 0.1
    assert size.task.input_frames == 2
    assert size.task.horizon == 4
    assert size.task.score_grid.placement == "cell_centres"
    assert size.value("spacing") == 0.05


def test_the_other_format_is_recognised(tmp_path: Path) -> None:
    """Where the files are those of the other format, the message names it."""
    for subset in SUBSETS:
        (tmp_path / f"{subset}.h5").touch()
    with pytest.raises(UnreadableFileError) as caught:
        import_split(tmp_path, format="gns-npz", output=tmp_path / "own")
    assert "--format lagrangebench-h5" in str(caught.value)


@pytest.mark.parametrize("form", ["gns-npz", "lagrangebench-h5"])
def test_the_files_tell_their_format(tmp_path: Path, form: str) -> None:
    """Without a format the split is the same."""
    write = write_gns if form == "gns-npz" else write_h5
    source = write(tmp_path / "in", straight_runs(3))
    named = import_split(source, format=form, output=tmp_path / "named" / "own")
    unnamed = import_split(source, output=tmp_path / "unnamed" / "own")
    for subset in SUBSETS:
        assert_array_equal(
            positions(unnamed.folder, subset), positions(named.folder, subset)
        )
    assert (unnamed.folder / "split.yaml").read_text() == (
        named.folder / "split.yaml"
    ).read_text()


def test_a_folder_without_one_of_the_files_names_it(tmp_path: Path) -> None:
    source = write_gns(tmp_path / "in", straight_runs(3))
    (source / "valid.npz").unlink()
    with pytest.raises(UnreadableFileError) as caught:
        import_split(source, output=tmp_path / "own")
    assert caught.value.got == "no valid.npz"


def test_files_of_no_format_and_of_both_do_not_tell_it(tmp_path: Path) -> None:
    """The message of the first names the command for other files."""
    with pytest.raises(UsageError, match="adopt"):
        import_split(tmp_path, output=tmp_path / "own")
    for subset in SUBSETS:
        (tmp_path / f"{subset}.h5").touch()
        (tmp_path / f"{subset}.npz").touch()
    with pytest.raises(UsageError, match="--format gns-npz"):
        import_split(tmp_path, output=tmp_path / "own")
