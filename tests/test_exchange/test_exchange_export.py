"""Exports, held against readers that know the formats only, and against the stored
data.
"""

from __future__ import annotations

import json
import pickle
import shutil
import tracemalloc
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np
import pytest
from command_line import Result
from exchange_readers import (
    Trajectory,
    frame_statistics,
    read_gns,
    read_h5,
    read_metadata,
    straight_runs,
)
from numpy.testing import assert_allclose, assert_array_equal

import lagbench
from lagbench.data.manifest import read_manifest, write_manifest
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.exchange import adopt, export, import_split
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult

GNS_KEYS = {
    *("bounds", "sequence_length", "default_connectivity_radius", "dim", "dt"),
    *("vel_mean", "vel_std", "acc_mean", "acc_std", "lagbench"),
}
H5_KEYS = GNS_KEYS - {"sequence_length"} | {
    *(
        "case",
        "solver",
        "density_evolution",
        "dx",
        "t_end",
        "viscosity",
        "p_bg_factor",
        "g_ext_magnitude",
    ),
    *(
        "artificial_alpha",
        "free_slip",
        "write_every",
        "is_bc_trick",
        "sequence_length_train",
    ),
    *("sequence_length_test", "num_trajs_train", "num_trajs_test", "num_particles_max"),
    "periodic_boundary_conditions",
}
SUBSETS = ("train", "valid", "test")
FORMS = pytest.mark.parametrize("form", ["gns-npz", "lagrangebench-h5"])


@pytest.fixture(scope="module")
def flow(generated: GenerationResult, unmeasured: Registry) -> Callable[..., object]:
    """A function that exports the generated tiny curl-noise data set."""
    return partial(
        export, "curl-noise", "tiny", root=generated.root, registry=unmeasured
    )


@pytest.fixture(scope="module")
def flows(
    flow: Callable[..., object], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """That data set in both formats."""
    made = {
        form: tmp_path_factory.mktemp(form) for form in ("gns-npz", "lagrangebench-h5")
    }
    for form, output in made.items():
        flow(format=form, output=output)
    return made


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A local split of all four materials whose scenarios differ in length."""
    folder = tmp_path_factory.mktemp("mixed")
    for number, frames in enumerate((12, 30, 12, 25)):
        run = straight_runs(1, frames=frames, seed=number)[0]
        np.savez(folder / f"{number}.npz", position=run, material=np.arange(40) % 4)
    box = ((0.1, 0.9), (0.1, 0.9))
    return adopt(
        folder,
        output=folder / "mixed",
        radius=0.1,
        frame_interval=0.1,
        bounds=box,
    )


def stored(split: str, root: Path, size: str) -> dict[str, list[np.ndarray]]:
    """Return the stored positions of every scenario, by subset."""
    found = {}
    for subset in SUBSETS:
        with lagbench.open_split(
            split,
            subset=subset,
            size=size,
            root=root,
        ) as data:
            frames = data["frame_count"].values
            found[subset] = [
                data["position"].values[i, :count] for i, count in enumerate(frames)
            ]
    return found


def files_of(folder: Path) -> dict[str, list[Trajectory]]:
    """Read an export with the reader of its format."""
    paths = [next(folder.glob(f"{subset}.*")) for subset in SUBSETS]
    return {
        path.stem: (read_gns if path.suffix == ".npz" else read_h5)(path)
        for path in paths
    }


@FORMS
def test_positions_are_those_stored(
    flows: dict[str, Path], generated: GenerationResult, form: str
) -> None:
    """Every trajectory has the stored bits, as float32, in the order of ids, once the
    origin is added.
    """
    expected = stored(generated.split, generated.root, "tiny")
    metadata = read_metadata(flows[form])
    files = files_of(flows[form])
    origin = np.array(metadata["lagbench"]["origin"], np.float32)
    for subset, trajectories in files.items():
        assert len(trajectories) == len(expected[subset])
        for (position, kinds), truth in zip(
            trajectories, expected[subset], strict=True
        ):
            assert position.dtype == np.float32
            assert_array_equal(position + origin, truth)
            assert kinds.shape == (position.shape[1],)
    # Means and deviations are those computed in one go from the exported train file.
    for name, value in frame_statistics(files["train"]).items():
        assert_allclose(
            metadata[name],
            value,
            rtol=2e-8,
            atol=1e-14,
            err_msg=name,
        )


def test_gns_metadata(flows: dict[str, Path]) -> None:
    """Every key is there; the number of frames is that of the positions; the box is the
    walls.
    """
    metadata = read_metadata(flows["gns-npz"])
    assert metadata.keys() == GNS_KEYS
    assert metadata["sequence_length"] == 26
    assert metadata["dim"] == 2
    assert metadata["dt"] == 0.1
    assert metadata["bounds"] == [[0.05, 0.95], [0.05, 0.95]]
    assert metadata["default_connectivity_radius"] == 0.062


def test_lagrangebench_metadata(flows: dict[str, Path]) -> None:
    """Every key is there; dt is the solver's, and dt times write_every the frame
    interval.
    """
    metadata = read_metadata(flows["lagrangebench-h5"])
    assert metadata.keys() == H5_KEYS
    assert metadata["dt"] * metadata["write_every"] == pytest.approx(0.1)
    assert metadata["write_every"] == 12
    assert metadata["sequence_length_train"] == 25
    assert metadata["num_trajs_train"] == 2
    assert metadata["sequence_length_test"] == 25
    assert metadata["num_trajs_test"] == 2
    assert metadata["num_particles_max"] == 506
    assert metadata["free_slip"]
    assert metadata["periodic_boundary_conditions"] == [False, False]
    # The area of the box over the particles is the square of their distance.
    assert metadata["dx"] == pytest.approx(np.sqrt(0.9**2 / 506))


@pytest.mark.parametrize("from_walls", [None, True, False])
def test_lagrangebench_bounds(
    flow: Callable[..., object],
    generated: GenerationResult,
    tmp_path: Path,
    from_walls: bool | None,
) -> None:
    """Cells counted from 0 hold every particle, no bit is lost; a closed box has its
    walls as bounds.
    """
    flow(
        format="lagrangebench-h5",
        output=tmp_path,
        from_walls=from_walls,
    )
    metadata = read_metadata(tmp_path)
    bounds = np.array(metadata["bounds"])
    assert_allclose(bounds, [[0.0, 1.0 if from_walls is False else 0.9]] * 2, atol=1e-6)
    truth = stored(generated.split, generated.root, "tiny")["test"]
    origin = np.array(metadata["lagbench"]["origin"])
    for (position, _), run in zip(read_h5(tmp_path / "test.h5"), truth, strict=True):
        assert (position >= 0).all()
        assert (position < bounds[:, 1] - bounds[:, 0]).all()
        assert_array_equal(position.astype(np.float64) + origin, run.astype(np.float64))


@pytest.mark.parametrize("full_box", [False, True])
def test_walls_at_0_are_the_bounds_too(
    mixed: LocalSplit, tmp_path: Path, full_box: bool
) -> None:
    """Measured from walls that lie at 0 nothing is taken off, and the bounds are still
    the walls; so they are by default where matter fills the box.
    """
    bounds = ((0.0, 0.95), (0.0, 0.95))
    paths = sorted(mixed.folder.parent.glob("[0-9].npz"))
    own = adopt(
        paths,
        output=tmp_path / "corner",
        radius=0.1,
        frame_interval=0.1,
        bounds=bounds,
        full_box=full_box,
    )
    by_default = 0.95 if full_box else 1.0
    for from_walls, high in ((True, 0.95), (False, 1.0), (None, by_default)):
        folder = tmp_path / f"{from_walls}"
        export(
            str(own.folder),
            format="lagrangebench-h5",
            output=folder,
            from_walls=from_walls,
        )
        assert read_metadata(folder)["bounds"] == [[0.0, high]] * 2


def test_lagrangebench_layout(flows: dict[str, Path]) -> None:
    """Groups count from 00000; chunks are one frame, with gzip and shuffle; no program
    is written.
    """
    with h5py.File(flows["lagrangebench-h5"] / "test.h5") as file:
        assert list(file) == ["00000", "00001"]
        position = file["00000/position"]
        assert position.chunks == (1, 506, 2)
        assert position.compression == "gzip"
        assert position.shuffle
        assert file["00000/particle_type"].dtype.kind == "i"
    names = {path.name for path in flows["lagrangebench-h5"].iterdir()}
    assert names == {"train.h5", "valid.h5", "test.h5", "metadata.json"}


@pytest.mark.parametrize(
    ("form", "numbers"),
    [
        (
            "gns-npz",
            [5, 7, 6, 8],
        ),
        (
            "lagrangebench-h5",
            [0, 4, 5, 6],
        ),
    ],
)
def test_each_material_has_its_number(
    mixed: LocalSplit, tmp_path: Path, form: str, numbers: list[int]
) -> None:
    """Liquid, jelly, snow, rope: four numbers below 9, none of which means padding or a
    boundary.
    """
    export(str(mixed.folder), format=form, output=tmp_path)
    assert files_of(tmp_path)["train"][0][1].tolist() == numbers * 10


def test_unequal_lengths(mixed: LocalSplit, tmp_path: Path) -> None:
    """GNS keeps them; lagrangebench-h5 cuts 30 frames into two runs of 12 and says that
    6 are left out.
    """
    gns = export(str(mixed.folder), format="gns-npz", output=tmp_path / "a")
    h5 = export(str(mixed.folder), format="lagrangebench-h5", output=tmp_path / "b")
    assert [len(run) for run, _ in read_gns(tmp_path / "a" / "train.npz")] == [12, 30]
    assert gns.left_out == 0
    assert read_metadata(tmp_path / "a")["sequence_length"] == 12
    runs = read_h5(tmp_path / "b" / "train.h5")
    whole = read_gns(tmp_path / "a" / "train.npz")[1][0]
    assert [len(run) for run, _ in runs] == [12, 12, 12]
    assert_array_equal(runs[2][0], whole[12:24])
    assert h5.left_out == 6


def test_an_export_that_breaks_off_is_not_whole(
    mixed: LocalSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written over by one that fails, an export has no metadata.json, which comes
    last.
    """
    export(str(mixed.folder), format="gns-npz", output=tmp_path)
    monkeypatch.setattr(
        pickle, "dump", lambda *_, **__: (_ for _ in ()).throw(OSError(28, "full"))
    )
    with pytest.raises(WorkFailedError):
        export(
            str(mixed.folder),
            format="gns-npz",
            output=tmp_path,
            overwrite=True,
        )
    assert not (tmp_path / "metadata.json").exists()
    assert not list(tmp_path.glob(".*"))


@FORMS
def test_the_same_data_give_the_same_bytes(
    mixed: LocalSplit, tmp_path: Path, form: str
) -> None:
    """Two exports are equal byte for byte; a second one needs --overwrite where
    the first is.
    """
    one, two = (
        export(str(mixed.folder), format=form, output=tmp_path / name) for name in "ab"
    )
    assert [path.read_bytes() for path in one.files] == [
        path.read_bytes() for path in two.files
    ]
    with pytest.raises(UsageError) as caught:
        export(str(mixed.folder), format=form, output=tmp_path / "a")
    assert caught.value.where.endswith("/a")
    export(
        str(mixed.folder),
        format=form,
        output=tmp_path / "a",
        overwrite=True,
    )


def test_an_export_mixes_with_other_files_only_on_request(
    mixed: LocalSplit, tmp_path: Path
) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(UsageError) as caught:
        export(str(mixed.folder), format="gns-npz", output=folder)
    assert caught.value.where == str(folder)
    assert "notes.txt" in str(caught.value.got)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    export(str(mixed.folder), format="gns-npz", output=folder, overwrite=True)
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "metadata.json").is_file()


def test_an_export_ignores_hidden_files(mixed: LocalSplit, tmp_path: Path) -> None:
    """File browsers leave such files in folders that a user sees as empty."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / ".DS_Store").write_text("icons")
    export(str(mixed.folder), format="gns-npz", output=folder)
    assert (folder / "metadata.json").is_file()


class _Names(pickle.Unpickler):
    """Notes what a pickle names."""

    named: ClassVar[set[str]] = set()

    def find_class(self, module: str, name: str) -> Any:
        """Note a name."""
        self.named.add(name)
        return super().find_class(module, name)


def test_a_gns_member_only_rebuilds_arrays(mixed: LocalSplit, tmp_path: Path) -> None:
    """The pickle names NumPy's own three constructors."""
    export(str(mixed.folder), format="gns-npz", output=tmp_path)
    with zipfile.ZipFile(tmp_path / "train.npz") as archive:
        assert archive.namelist() == ["simulation_0.npy", "simulation_1.npy"]
        assert {info.date_time for info in archive.infolist()} == {
            (1980, 1, 1, 0, 0, 0)
        }
        with archive.open("simulation_0.npy") as stream:
            np.lib.format.read_magic(stream)
            np.lib.format.read_array_header_1_0(stream)
            _Names(stream).load()
    assert _Names.named == {"_reconstruct", "ndarray", "dtype"}


@pytest.fixture(scope="module")
def big(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """Ten trajectories of 1.6 MB in train."""
    folder = tmp_path_factory.mktemp("big")
    np.save(
        folder / "runs.npy", np.stack(straight_runs(12, frames=40, particles=5_000))
    )
    return adopt(
        folder / "runs.npy",
        output=folder / "big",
        radius=0.02,
        frame_interval=0.1,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "most"),
    [
        ("gns-npz", 4.5e6),
        (
            "lagrangebench-h5",
            1.5e6,
        ),
    ],
)
def test_memory_is_a_trajectory_or_a_few_frames(
    mixed: LocalSplit, big: LocalSplit, tmp_path: Path, form: str, most: float
) -> None:
    """Trajectories take less than three of them, or a few frames, at any time."""
    export(str(mixed.folder), format=form, output=tmp_path / "warm")
    tracemalloc.start()
    export(str(big.folder), format=form, output=tmp_path / "out")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < most


@pytest.fixture(scope="module")
def lid(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A closed box of 0.8 whose lid goes 0.07 a frame, then back; its other walls are
    at rest.
    """
    folder = tmp_path_factory.mktemp("lid")
    walls = np.zeros((20, 4, 2))
    walls[:10, 3, 0] = 0.7
    walls[10:, 3, 0] = -0.35
    for number, run in enumerate(straight_runs(3, frames=20)):
        np.savez(folder / f"{number}.npz", position=run, wall_velocity=walls)
    options: dict[str, Any] = {
        "radius": 0.1,
        "frame_interval": 0.1,
        "spacing": 0.04,
        "full_box": True,
    }
    return adopt(
        folder,
        output=folder / "lid",
        bounds=((0.1, 0.9), (0.1, 0.9)),
        **options,
    )


@pytest.mark.parametrize(
    ("form", "still", "moving"),
    [
        ("gns-npz", 3, 3),
        (
            "lagrangebench-h5",
            1,
            2,
        ),
    ],
)
def test_readers_see_the_lid_move(
    lid: LocalSplit, tmp_path: Path, form: str, still: int, moving: int
) -> None:
    """Differences of lid particles are the wall's velocity, but for the one that comes
    in again.
    """
    written = export(
        str(lid.folder),
        format=form,
        output=tmp_path / "out",
        wall_particles=True,
    )
    assert not written.loses_wall_motion
    metadata = read_metadata(tmp_path / "out")
    truth = stored("lid", lid.folder.parent, "full")
    raw, kinds = files_of(tmp_path / "out")["test"][0]
    position = raw + np.array(metadata["lagbench"]["origin"], np.float32)
    # 0.8 / 0.04 = 20 particles to a layer, three layers to a wall, four walls.
    assert kinds[40:].tolist() == [still] * 180 + [moving] * 60
    assert_allclose(position[:, :40], truth["test"][0], atol=1e-7)
    walls = position[:, 40:220]
    top = position[:, 220:]
    assert (walls == walls[0]).all()
    assert_allclose(np.unique(top[..., 1].round(5)), [0.92, 0.96, 1.0])
    assert (top[..., 0] >= 0.1 - 1e-6).all()
    assert (top[..., 0] <= 0.9 + 1e-6).all()
    steps = np.diff(top, axis=0)
    assert (steps[..., 1] == 0).all()
    again = np.abs(steps[..., 0]) > 0.4
    for frame, expected in enumerate([0.07] * 9 + [-0.035] * 10):
        # At most 0.07 / 0.04 of a layer's particles, rounded up, come in again in one
        # frame.
        assert again[frame].sum() <= 6
        within = steps[frame, ~again[frame], 0]
        across = steps[frame, again[frame], 0]
        jump = expected - np.copysign(0.8, expected)
        assert_allclose(within, expected, atol=1e-6)
        assert_allclose(across, jump, atol=1e-6)
    assert again.any()
    if form == "lagrangebench-h5":
        assert ((raw >= 0) & (raw < np.array(metadata["bounds"])[:, 1])).all()
    # An import of our own export leaves them out: they are no material.
    back = import_split(tmp_path / "out", format=form, output=tmp_path / "back")
    assert back.particles == (40, 40)
    came = stored("back", tmp_path, "full")
    assert_allclose(came["train"][0], truth["train"][0], atol=1e-7)


def test_an_export_says_that_it_loses_the_motion_of_walls(
    lid: LocalSplit, tmp_path: Path
) -> None:
    array = tmp_path / "runs.npy"
    np.save(array, np.stack(straight_runs(4)))
    still = adopt(array, output=tmp_path / "still", radius=0.1, frame_interval=0.1)
    for local_split, moves in ((lid, True), (still, False)):
        folder = tmp_path / f"export-{local_split.name}"
        written = export(str(local_split.folder), format="gns-npz", output=folder)
        assert written.loses_wall_motion is moves


def test_walls_at_rest_are_solid(flow: Callable[..., object], tmp_path: Path) -> None:
    """A simulated box with slip walls gets particles of the kind that does not move."""
    flow(
        format="lagrangebench-h5",
        output=tmp_path,
        wall_particles=True,
    )
    position, kinds = read_h5(tmp_path / "test.h5")[0]
    assert {*kinds[506:].tolist()} == {1}
    assert (position[:, 506:] == position[0, 506:]).all()
    assert read_metadata(tmp_path)["num_particles_max"] == len(kinds) > 506


def test_wall_particles_need_walls(
    mixed: LocalSplit, lid: LocalSplit, tmp_path: Path
) -> None:
    """Data without walls have none to export, and bounds of the unit box hold none."""
    for made, form, options in (
        (mixed, "gns-npz", {"wall_particles": True}),
        (lid, "lagrangebench-h5", {"wall_particles": True, "from_walls": False}),
        (lid, "gns-npz", {"from_walls": True}),
    ):
        with pytest.raises(UsageError):
            export(
                str(made.folder),
                format=form,
                output=tmp_path,
                **options,
            )


def test_a_program_beside_the_data_is_refused(
    mixed: LocalSplit, tmp_path: Path
) -> None:
    """The folder of an export must not hold a force.py: its readers would run it."""
    (tmp_path / "force.py").write_text("raise SystemExit")
    with pytest.raises(UsageError) as caught:
        export(
            str(mixed.folder),
            format="lagrangebench-h5",
            output=tmp_path,
            overwrite=True,
        )
    assert caught.value.where.endswith("force.py")
    assert [path.name for path in tmp_path.iterdir()] == ["force.py"]


def test_missing_and_exchanged_scenarios_stop_the_export(tmp_path: Path) -> None:
    """A scenario that is not there, and one put in another's place, stop the export
    with their ids.
    """
    np.save(tmp_path / "runs.npy", np.stack(straight_runs(4)))
    made = adopt(
        tmp_path / "runs.npy",
        output=tmp_path / "own",
        radius=0.1,
        frame_interval=0.1,
    )
    train = made.folder / "full" / "v1" / "train"
    (train / "0000.nc").write_bytes((train / "0001.nc").read_bytes())
    with pytest.raises(DataError) as caught:
        export(str(made.folder), format="gns-npz", output=tmp_path / "out")
    assert caught.value.where.endswith("own/full/v1/train/0000.nc")
    (train / "0000.nc").unlink()
    with pytest.raises(DataError) as caught:
        export(str(made.folder), format="gns-npz", output=tmp_path / "out")
    assert caught.value.got == "missing: 0 of train"
    assert not (tmp_path / "out").exists()


def test_the_export_command_counts_trajectories_by_subset(
    mixed: LocalSplit, tmp_path: Path, run: Callable[..., Result]
) -> None:
    """`lagbench export` writes into the folder of its option and prints a summary; an
    unknown format names the nearest.
    """
    done = run(
        "export",
        mixed.folder,
        "--format",
        "lagrangebench-h5",
        "-o",
        tmp_path / "out",
        "--json",
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["trajectories"] == {
        "train": 3,
        "valid": 1,
        "test": 1,
    }
    wrong = run("export", mixed.folder, "--format", "gns-npy")
    assert wrong.exit_code == 2
    assert "did you mean 'gns-npz'" in wrong.output


@pytest.mark.parametrize(
    "row", [None, (0.1,), (0.1, 0.1, 0.1)], ids=["none", "short", "long"]
)
def test_statistics_of_another_form_stop_the_export(
    row: tuple[float, ...] | None,
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
) -> None:
    """Models divide by them: there is one number for each axis of the box."""
    root = tmp_path / "root"
    shutil.copytree(generated.root, root)
    manifest = read_manifest(root, "curl-noise", "tiny", 2)
    assert manifest is not None
    rows = dict(manifest.statistics)
    del rows["velocity_std"]
    if row is not None:
        rows["velocity_std"] = row
    write_manifest(root, manifest.model_copy(update={"statistics": rows}))
    output = tmp_path / "out"
    with pytest.raises(DataError) as caught:
        export(
            "curl-noise",
            "tiny",
            format="gns-npz",
            output=output,
            root=root,
            registry=unmeasured,
        )
    assert "curl-noise tiny" in str(caught.value.where)
    assert not output.exists()


@pytest.mark.parametrize("file_format", ["gns-npz", "lagrangebench-h5"])
def test_train_without_accelerations_stops_the_export(
    tmp_path: Path, file_format: str
) -> None:
    """Two frames have one velocity, so that statistics of accelerations are missing."""
    source = tmp_path / "source"
    for subset, frame_count in (("train", 2), ("valid", 8), ("test", 8)):
        folder = source / subset
        folder.mkdir(parents=True)
        (run,) = straight_runs(1, frames=frame_count, particles=20)
        np.save(folder / "run.npy", run)
    own = adopt(
        source, output=tmp_path / "own", radius=0.1, frame_interval=0.1, spacing=0.05
    )
    output = tmp_path / "out"
    with pytest.raises(DataError) as caught:
        export(own.folder, format=file_format, output=output)
    error = caught.value
    assert None not in (error.where, error.expected, error.got, error.fix)
    assert not output.exists()


def test_a_folder_below_home_is_that_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No folder of the name ~ is made; the root folder may be named so too."""
    home = tmp_path / "home"
    (home / "export").mkdir(parents=True)
    (home / "export" / "notes.txt").touch()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as caught:
        export("cavity", "tiny", format="gns-npz", output="~/export", root="~/no-data")
    assert caught.value.where == str(home / "export")
    assert not (tmp_path / "~").exists()
