"""What people handed over and what went wrong without a word, as small inputs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
from trajectories import vortex

from lagbench.data.box import UNIT_SQUARE
from lagbench.data.judgement import find_shift
from lagbench.errors import DataError, LagbenchError, UnreadableFileError, UsageError
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit

Save = Callable[[Path, int], object]

NAMES = ("frame", "particle", "space")
CUBE = ((0, 1), (0, 1), (0, 1))


def adopt_runs(
    folder: Path, save: Save, *, runs: int = 4, **options: Any
) -> LocalSplit:
    """Adopt what ``save(path, number)`` writes."""
    source = folder / "runs"
    source.mkdir()
    for number in range(runs):
        save(source / str(number), number)
    all_options = {"radius": 0.1, "frame_interval": 0.1, **options}
    return adopt(source, output=folder / "own", **all_options)


def saved(change: Callable[[np.ndarray], np.ndarray]) -> Save:
    """Return what writes changed positions of a vortex to an npz file."""
    return lambda path, number: np.savez(path, position=change(vortex(number)))


def save_netcdf(
    path: Path, position: np.ndarray, fill: float | None = None, **arrays: Any
) -> None:
    with netCDF4.Dataset(f"{path}.nc", "w") as file:
        for name, length in zip(NAMES, position.shape, strict=True):
            file.createDimension(name, length)
        file.createVariable("position", "f4", NAMES, fill_value=fill)[:] = position
        for name, (kind, dims, values, attributes) in arrays.items():
            variable = file.createVariable(name, kind, dims)
            variable[:] = values
            variable.setncatts(attributes)


def permuted(position: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.stack([frame[rng.permutation(len(frame))] for frame in position])


def permuted_from_frame_8(position: np.ndarray) -> np.ndarray:
    changed = position.copy()
    changed[8:] = changed[8:, np.random.default_rng(0).permutation(changed.shape[1])]
    return changed


def sorted_by_cell(position: np.ndarray) -> np.ndarray:
    frames = []
    for frame in position:
        cell = np.floor(frame / 0.05)
        frames.append(frame[np.lexsort((cell[:, 1], cell[:, 0]))])
    return np.stack(frames)


@pytest.mark.parametrize(
    ("change", "periodic"),
    [
        (permuted, ()),
        (permuted_from_frame_8, ()),
        (sorted_by_cell, ()),
        (sorted_by_cell, ("x",)),
        (sorted_by_cell, ("x", "y")),
    ],
)
def test_rows_that_change_their_order_are_refused(
    tmp_path: Path,
    change: Callable[[np.ndarray], np.ndarray],
    periodic: tuple[str, ...],
) -> None:
    """Also with the periods that would explain the jumps."""
    with pytest.raises(DataError, match=r"frame \d.*rows change their order"):
        adopt_runs(
            tmp_path,
            saved(change),
            periodic=periodic,
            bounds=((0, 1), (0, 1)) if periodic else None,
        )


def test_times_of_the_file_are_read(tmp_path: Path) -> None:
    """Uneven ones and another interval are refused; units count."""

    def save_uneven(path: Path, number: int) -> None:
        times = np.cumsum(np.linspace(0.001, 0.01, 16))
        np.savez(path, position=vortex(number), time=times, dt=0.002)

    def save_squares(path: Path, number: int) -> None:
        squares = np.arange(16.0) ** 2
        save_netcdf(path, vortex(number), time=("f8", ("frame",), squares, {}))

    def save_milliseconds(path: Path, number: int) -> None:
        times = 20.0 * np.arange(16)
        save_netcdf(
            path, vortex(number), time=("f8", ("frame",), times, {"units": "ms"})
        )

    for number, save in enumerate((save_uneven, save_squares)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with pytest.raises(DataError, match=r"frame 1.*even times"):
            adopt_runs(folder, save)
    (tmp_path / "other").mkdir()
    with pytest.raises(UsageError, match=r"0.02 s.*--frame-interval"):
        adopt_runs(tmp_path / "other", save_milliseconds)
    (tmp_path / "right").mkdir()
    own = adopt_runs(tmp_path / "right", save_milliseconds, frame_interval=None)
    with xr.open_dataset(own.folder / "full/v1/test/0003.nc") as file:
        assert file.frame_rate == 50.0


def test_kinds_under_other_names_need_a_material(tmp_path: Path) -> None:
    def save(path: Path, number: int) -> None:
        kinds = np.arange(144) % 3
        np.savez(path, position=vortex(number), particle_type=kinds, force=kinds)

    with pytest.raises(UsageError, match=r"particle_type.*0, 1, 2.*--kinds 0="):
        adopt_runs(tmp_path, save)
    (tmp_path / "again").mkdir()
    own = adopt_runs(tmp_path / "again", save, kinds="0=liquid,1=jelly,2=drop")
    assert own.materials == (0, 1)
    assert own.particles == (96, 96)
    assert any("not used are force" in note for note in own.notes)


@pytest.mark.parametrize(("frames", "kinds"), [(16, 5), (144, np.full(144, 5))])
def test_exchanged_frames_and_particles_are_refused(
    tmp_path: Path, frames: int, kinds: Any
) -> None:
    """In a format that states their order, too."""
    for seed, subset in enumerate(("train", "valid", "test")):
        pair = np.empty(2, object)
        pair[0] = np.ascontiguousarray(vortex(seed, frames).transpose(1, 0, 2))
        pair[1] = kinds
        np.savez(tmp_path / f"{subset}.npz", simulation_0=pair)
    metadata = {"bounds": [[0, 1], [0, 1]], "default_connectivity_radius": 0.1}
    (tmp_path / "metadata.json").write_text(json.dumps({**metadata, "dt": 0.1}))
    with pytest.raises(DataError, match=r"exchanged|axes have another order"):
        adopt(tmp_path, output=tmp_path / "own")


def test_a_trajectory_in_two_subsets_is_refused(tmp_path: Path) -> None:
    """By its content: copies in another order of rows, and pieces of one run."""

    def save_copies(path: Path, number: int) -> None:
        order = np.random.default_rng(number).permutation(144)
        np.savez(path, position=vortex(0)[:, order])

    def save_pieces(path: Path, number: int) -> None:
        np.savez(path, position=vortex(0, frames=40)[4 * number :][:16])

    for save, runs in ((save_copies, 4), (save_pieces, 6)):
        folder = tmp_path / str(runs)
        folder.mkdir()
        with pytest.raises(DataError, match=r"share \d+ frames"):
            adopt_runs(folder, save, runs=runs)


def test_a_constant_component_is_left_out(tmp_path: Path) -> None:
    """The data have two dimensions, with bounds of three pairs, too."""

    def in_a_plane(position: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(position, -1, 0)
        return np.stack([x, 0.5 + 0 * x, y], -1)

    own = adopt_runs(tmp_path, saved(in_a_plane), bounds=CUBE)
    assert own.bounds == ((0.0, 1.0), (0.0, 1.0))
    assert own.spacing == pytest.approx(0.05, rel=0.02)
    assert any("y is 0.5" in note for note in own.notes)


@pytest.mark.parametrize("fill", [0.0, None, -9999.0])
def test_missing_values_of_netcdf_are_no_positions(
    tmp_path: Path, fill: float | None
) -> None:
    def save(path: Path, number: int) -> None:
        position = np.ma.array(vortex(number))
        position[:, 3:12] = np.ma.masked
        save_netcdf(path, position, fill)

    with pytest.raises(DataError, match=r"frame 0: particle 3 has no position.*9 of"):
        adopt_runs(tmp_path, save)


def test_packed_and_missing_materials_are_decoded(tmp_path: Path) -> None:
    def writer(**attributes: Any) -> Save:
        ones = np.ones(144)
        material = ("i1", ("particle",), ones, attributes)
        return lambda path, number: save_netcdf(path, vortex(number), material=material)

    own = adopt_runs(tmp_path, writer(scale_factor=2.0))
    assert own.materials == (2,)
    (tmp_path / "missing").mkdir()
    with pytest.raises(DataError, match="material of particle 0 is missing"):
        adopt_runs(tmp_path / "missing", writer(missing_value=np.int8(1)))


def test_named_components_are_ordered(tmp_path: Path) -> None:
    """Components named y, x make the same box as x, y; other names are refused."""

    def writer(names: list[str]) -> Save:
        def save(path: Path, number: int) -> None:
            data = xr.Dataset({"position": (NAMES, vortex(number) * [1, 0.5])})
            data = data.assign_coords(space=["x", "y"]).sel(space=names)
            data.astype("f4").to_netcdf(f"{path}.nc")

        return save

    splits = []
    for names in (["x", "y"], ["y", "x"]):
        folder = tmp_path / names[0]
        folder.mkdir()
        splits.append(adopt_runs(folder, writer(names)))
    assert splits[0].bounds == splits[1].bounds


def padded(position: np.ndarray) -> np.ndarray:
    padding = np.zeros((len(position), 20, 2), np.float32)
    return np.concatenate([position, padding], axis=1)


def parked(position: np.ndarray) -> np.ndarray:
    changed = position.copy()
    for particle in range(60):
        changed[3 + particle // 6 :, particle] = position[3, 0]
    return changed


@pytest.mark.parametrize(
    ("change", "text"), [(padded, "frame 0: 20 of 164"), (parked, "frame 3: 6 of 144")]
)
def test_padding_and_parked_particles_are_refused(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], text: str
) -> None:
    with pytest.raises(DataError, match=f"{text} particles lie at one place"):
        adopt_runs(tmp_path, saved(change), bounds=((0, 1), (0, 1)), periodic=["x"])


@pytest.mark.parametrize(("growth", "first"), [(1e4, 13), (5.0, 14)])
def test_a_blown_up_end_is_refused(tmp_path: Path, growth: float, first: int) -> None:
    factor = growth ** np.maximum(np.arange(16.0) - 12, 0)

    def blown_up(position: np.ndarray) -> np.ndarray:
        return 0.5 + (position - 0.5) * factor[:, None, None]

    with pytest.raises(DataError, match=f"frames {first} to 15.*blew up"):
        adopt_runs(tmp_path, saved(blown_up))


def test_a_stated_spacing_is_compared(tmp_path: Path) -> None:
    """A ratio of ten is refused; a box 100 times too wide is noted."""
    for number, spacing in enumerate((0.5, 0.005)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with pytest.raises(UsageError, match=r"stated spacing.*0\.049"):
            adopt_runs(folder, saved(np.asarray), spacing=spacing)
    own = adopt_runs(
        tmp_path, saved(np.asarray), spacing=0.05, bounds=((0, 100), (0, 100))
    )
    assert any("of the box along each axis" in note for note in own.notes)


@pytest.mark.parametrize("name", ["kind", "id"])
def test_an_array_of_each_particle_tells_of_exchanged_axes(
    tmp_path: Path, name: str
) -> None:
    def save(path: Path, number: int) -> None:
        position = vortex(number).transpose(1, 0, 2)
        np.savez(path, position=position, **{name: np.arange(144)})

    with pytest.raises(UsageError, match=rf"{name} has the shape.*--axes"):
        adopt_runs(tmp_path, save)


def test_kinds_without_an_array_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no array of kinds.*--kinds out"):
        adopt_runs(tmp_path, saved(np.asarray), kinds="0=liquid,1=jelly")
    (tmp_path / "again").mkdir()
    own = adopt_runs(tmp_path / "again", saved(np.asarray))
    assert own.materials == (0,)
    assert any("all particles are liquid" in note for note in own.notes)


def test_four_axes_need_their_order(tmp_path: Path) -> None:
    def save(path: Path, number: int) -> None:
        rng = np.random.default_rng(0)
        runs = [rng.permutation(vortex(seed, 20), axis=1) for seed in range(10)]
        np.save(path, np.stack(runs, axis=1))

    with pytest.raises(UsageError, match=r"4 axes.*--axes"):
        adopt_runs(tmp_path, save, runs=1)
    source = tmp_path / "runs"
    with pytest.raises(DataError, match="rows change their order"):
        adopt(
            source,
            output=tmp_path / "own",
            frame_interval=0.1,
            axes="trajectory,frame,particle,space",
        )
    own = adopt(
        source,
        output=tmp_path / "own",
        frame_interval=0.1,
        axes="frame,trajectory,particle,space",
    )
    assert (sum(own.scenarios.values()), own.frames) == (10, 200)


def test_files_that_are_left_out_are_named(tmp_path: Path) -> None:
    """A suffix in capitals is read; an empty file is refused."""

    def save(path: Path, number: int) -> None:
        with open(f"{path}.NPZ", "wb") as file:
            np.savez(file, position=vortex(number))
        if number == 0:
            path.with_name("readme.txt").touch()
            path.with_name("more").mkdir()

    own = adopt_runs(tmp_path, save)
    assert any("readme.txt, more/" in note for note in own.notes)
    (tmp_path / "runs/6.h5").touch()
    with pytest.raises(UnreadableFileError, match=r"6\.h5"):
        adopt(tmp_path / "runs", output=tmp_path / "again", frame_interval=0.1)


@pytest.mark.parametrize("sides", [(6, 18, 18, 18), (18, 18, 18, 6)])
def test_each_trajectory_has_its_own_spacing(
    tmp_path: Path, sides: tuple[int, ...]
) -> None:
    """The particles of each cover the same area."""

    def save(path: Path, number: int) -> None:
        np.savez(path, position=vortex(number, side=sides[number]))

    own = adopt_runs(tmp_path, save, radius=0.2)
    assert any("spacings of trajectories differ" in note for note in own.notes)
    for path in own.folder.rglob("0*.nc"):
        with xr.open_dataset(path) as file:
            area = float(file.particle_mass) * file.sizes["particle"]
        assert area == pytest.approx(0.36, rel=0.05)


@pytest.mark.parametrize("shift", [-2, -1, 0, 1, 2])
def test_a_prediction_that_is_late_or_early_is_seen(shift: int) -> None:
    truth = vortex(0, frames=14).astype(np.float64)
    frames = np.arange(6, 11) + shift
    noise = np.random.default_rng(0).normal(0, 1e-4, (5, 144, 2))
    assert find_shift(truth[frames] + noise, truth[4:13], UNIT_SQUARE) == shift


def test_a_radius_of_many_neighbours_is_noted(tmp_path: Path) -> None:
    """The note has their number, that of the edges and a radius that suits."""
    own = adopt_runs(
        tmp_path,
        lambda path, number: np.savez(path, position=vortex(number, side=40)),
        radius=0.15,
    )
    note = next(note for note in own.notes if "neighbours" in note)
    assert "edges" in note
    assert "two spacings are 0.03" in note


def dataset_of(position: np.ndarray, **arrays: Any) -> xr.Dataset:
    return xr.Dataset({"position": (("time", "particle", "space"), position), **arrays})


def adopt_datasets(
    folder: Path, make: Callable[[int], xr.Dataset], **options: Any
) -> LocalSplit:
    """Adopt four datasets; the last is for test."""
    all_options = {"radius": 0.1, "frame_interval": 0.1, **options}
    datasets = [make(number) for number in range(4)]
    return adopt(datasets, output=folder / "own", **all_options)


def changed_from_frame_8(change: Callable[[np.ndarray], np.ndarray]) -> Any:
    def change_end(position: np.ndarray) -> np.ndarray:
        return np.concatenate([position[:8], change(position[8:])])

    return change_end


def park_three(position: np.ndarray) -> np.ndarray:
    return np.concatenate([0 * position[:, :3] + [[0, 0], [1, 0], [0, 1]], position], 1)


FRAMES = np.arange(16)

REFUSED_MOTIONS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "halves of the rows exchanged": (
        changed_from_frame_8(lambda end: np.roll(end, 72, axis=1)),
        "frame 8",
    ),
    "rows rolled by one": (
        changed_from_frame_8(lambda end: np.roll(end, 1, axis=1)),
        "frame 8",
    ),
    "x and y exchanged": (changed_from_frame_8(lambda end: end[..., ::-1]), "frame 8"),
    "last frame reversed": (
        lambda run: np.concatenate([run[:-1], run[-1:, ::-1]]),
        "frame 15",
    ),
    "frames sorted as text": (lambda run: run[sorted(FRAMES, key=str)], "frame 2"),
    "first frame twice": (lambda run: run[[0, *range(15)]], "frame 1.*twice"),
    "frame twice": (lambda run: run[[*range(9), *range(8, 15)]], "frame 9.*twice"),
    "frame missing": (lambda run: np.delete(run, 8, axis=0), "frame 8.*missing"),
    "second frame missing": (lambda run: np.delete(run, 1, axis=0), "frame 1.*missing"),
    "restarted": (lambda run: run[[*range(8), *range(6, 14)]], "out of order"),
}


@pytest.mark.parametrize("name", REFUSED_MOTIONS)
def test_a_wrong_motion_is_refused_at_its_frame(tmp_path: Path, name: str) -> None:
    change, text = REFUSED_MOTIONS[name]
    with pytest.raises(DataError, match=text):
        adopt_datasets(tmp_path, lambda number: dataset_of(change(vortex(number))))


def test_another_pace_is_noted(tmp_path: Path) -> None:
    """Every second frame is given from frame 8 on."""
    frames = [*range(8), *range(9, 24, 2)]
    own = adopt_datasets(
        tmp_path, lambda number: dataset_of(vortex(number, frames=24)[frames])
    )
    assert any("frame 8" in note and "uneven?" in note for note in own.notes)


def test_a_body_that_flies_fast_is_no_exchange_of_axes(tmp_path: Path) -> None:
    """Its step is two spacings in each frame, alike for all particles."""
    flight = 0.1 * FRAMES[:, None, None] * np.array([1, 0])
    adopt_datasets(tmp_path, lambda number: dataset_of(vortex(number) + flight))


COPIES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "mirrored": lambda run: [1, 0] + run * [-1, 1],
    "moved": lambda run: run + np.float32(0.05),
    "x and y exchanged": lambda run: run[..., ::-1],
    "turned": lambda run: np.stack([1 - run[..., 1], run[..., 0]], axis=-1),
    "scaled": lambda run: 3 * run,
    "in half precision": lambda run: run.astype(np.float16).astype(np.float32),
}


@pytest.mark.parametrize("name", COPIES)
def test_a_changed_copy_in_another_subset_is_noted(tmp_path: Path, name: str) -> None:
    own = adopt_datasets(
        tmp_path,
        lambda number: dataset_of(
            vortex(number) if number < 3 else COPIES[name](vortex(0))
        ),
    )
    assert any("are they one run" in note for note in own.notes)


def test_a_run_that_goes_on_in_another_subset_is_noted(tmp_path: Path) -> None:
    """Also where motion is not steady, so that no frame of it comes again."""
    rng = np.random.default_rng(0)
    fall = (
        rng.uniform(0, 1, (4, 144, 2))
        - [0, 0.001] * np.arange(40)[:, None, None, None] ** 2
    )

    def make(number: int) -> xr.Dataset:
        run = fall[:, 0] if number in (0, 3) else fall[:, number]
        return dataset_of(run[24:] if number == 3 else run[8:24])

    own = adopt_datasets(tmp_path, make)
    assert any("goes on where the other ends" in note for note in own.notes)


def test_runs_from_one_lattice_are_no_copies(tmp_path: Path) -> None:
    """Their particles differ by a thousandth of the box at most."""
    own = adopt_datasets(
        tmp_path,
        lambda number: dataset_of(
            vortex(0, side=60)
            + np.random.default_rng(number).uniform(-1e-3, 1e-3, (3600, 2))
        ),
    )
    assert own.scenarios["test"] == 1


@pytest.mark.parametrize(
    ("dataset", "text"),
    [
        (lambda run: dataset_of(run).assign_attrs(dt=0.02), "0.02 s apart"),
        (
            lambda run: dataset_of(
                run, time=("time", 1.0 * FRAMES, {"units": "fortnight"})
            ),
            "fortnight",
        ),
        (
            lambda run: dataset_of(run, time=("time", 0.1 * FRAMES**1.01)),
            r"frame \d+: its time",
        ),
        (
            lambda run: dataset_of(
                run,
                velocity=(
                    ("time", "particle", "space"),
                    np.roll(np.gradient(run, 0.1, axis=0), 1, axis=0),
                ),
            ),
            "velocities are those one frame before",
        ),
    ],
)
def test_what_a_dataset_says_of_itself_is_compared(
    tmp_path: Path, dataset: Callable[[np.ndarray], xr.Dataset], text: str
) -> None:
    with pytest.raises(LagbenchError, match=text):
        adopt_datasets(tmp_path, lambda number: dataset(vortex(number)))


def test_one_trajectory_does_not_stand_for_all(tmp_path: Path) -> None:
    """Materials in one, velocities in one, a short one and one far away are named."""

    def in_run_1(name: str, dims: tuple[str, ...]) -> Callable[[int], xr.Dataset]:
        def make(number: int) -> xr.Dataset:
            dataset = dataset_of(vortex(number))
            if number == 1:
                dataset[name] = (dims, np.gradient(dataset.position, 0.1, axis=0))
            return dataset

        return make

    def with_material(number: int) -> xr.Dataset:
        material = {} if number else {"material": ("particle", np.ones(144, int))}
        return dataset_of(vortex(number), **material)

    with pytest.raises(UsageError, match="materials in one of them only"):
        adopt_datasets(tmp_path, with_material)
    makers = (
        in_run_1("velocity", ("time", "particle", "space")),
        lambda number: dataset_of(vortex(number, frames=16 - 4 * (number == 3))),
        lambda number: dataset_of(vortex(number) + 10 * (number == 3)),
    )
    texts = ("1 of 4 trajectories", "has 12 frames, others more", "away from the other")
    for number, (make, text) in enumerate(zip(makers, texts, strict=True)):
        folder = tmp_path / str(number)
        folder.mkdir()
        assert any(text in note for note in adopt_datasets(folder, make).notes)


def test_particles_that_never_move_are_noted(tmp_path: Path) -> None:
    own = adopt_datasets(
        tmp_path, lambda number: dataset_of(park_three(vortex(number)))
    )
    assert any("3 of 147 particles never move, as particle 0" in n for n in own.notes)


def test_what_lies_beside_the_subsets_is_named(tmp_path: Path) -> None:
    for number, name in enumerate(("train", "valid", "test", "extra")):
        np.savez(tmp_path / f"{name}.npz", position=vortex(number))
    own = adopt(tmp_path, output=tmp_path / "own", frame_interval=0.1)
    assert "not read: extra.npz" in own.notes


def test_every_refusal_is_an_error_of_ours(tmp_path: Path) -> None:
    """Damaged bytes of any format end in one line, without a traceback."""
    for suffix in (
        ".npy",
        ".npz",
        ".nc",
        ".h5",
        ".csv",
        ".parquet",
        ".vtkhdf",
        ".dump",
    ):
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(b"\x00damaged" * 20)
        with pytest.raises(LagbenchError, match="damaged"):
            adopt([path] * 3, output=tmp_path / "own", frame_interval=0.1)
