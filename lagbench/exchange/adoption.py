"""Trajectories from elsewhere in, a hashed local split out: a user's own, or another
code base's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Unpack

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import HASHED_SUBSETS, file_sha256
from lagbench.data.hdf5 import hdf5_errors, open_hdf5
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.work.progress import Progress

from . import gns_npz
from .array_files import Row, natural, open_row, rows_of
from .local_split import LocalSplit, make_local_split, output_name
from .metadata import (
    DROP,
    ENDINGS,
    Format,
    Source,
    materials_of,
    parse_format,
    read_source,
)
from .trajectory import (
    Description,
    Frame,
    Trajectory,
    Wishes,
    check_array,
    check_wishes,
)

MOST_TRAJECTORIES = 100_000  # most trajectories of an HDF5 file that are looked at


def adopt(
    sources: str | Path | Sequence[str | Path],
    *,
    output: str | Path,
    valid: int | None = None,
    test: int | None = None,
    as_is: bool = False,
    progress: Callable[[Progress], None] | None = None,
    **wishes: Unpack[Wishes],
) -> LocalSplit:
    """Make a local split of trajectories in .npy, .npz or netCDF files.

    A .npy file holds positions [frame, particle, 2], or several trajectories
    [trajectory, frame, particle, 2]; .npz and netCDF files hold ``position`` and, if
    they like, ``velocity`` of the same shape, ``material`` [particle] (0 liquid, 1
    jelly, 2 snow, 3 rope; liquid when absent) and ``wall_velocity`` [4, 2] or [frame,
    4, 2] (left, right, bottom, top). Nothing is unpickled.

    Args:
        sources: a folder with subfolders ``train``, ``valid`` and ``test``; or files,
            or a folder of files, which are sorted by name and of which the last are
            taken for test, those before for valid.
        output: folder to make; its last part is the name of the split.
        valid: trajectories for valid; a tenth, at least one, when None.
        test: trajectories for test; a tenth, at least one, when None.
        as_is: whether to take arrays that look transposed, and velocities of another
            frame, axis or unit.
        progress: called as the work advances.
        **wishes: ``radius`` and ``frame_interval``, which must be given, and what else
            is known, see :class:`lagbench.exchange.trajectory.Description`.

    Raises:
        UsageError: no radius or frame interval, too few trajectories or one named
            twice, a folder that is there, a task that does not fit the data.
        UnreadableFileError: a file is damaged, pickled, or holds no positions.
        DataError: positions are not plane, not finite, or outside the unit box; another
            reading explains the axes or the velocities far better.
        WorkFailedError: the disk is full or not writable.
    """
    wishes = check_wishes(wishes)
    for name in ("radius", "frame_interval"):
        if name not in wishes:
            raise UsageError(
                f"the {name.replace('_', ' ')} is not known",
                fix=f"--{name.replace('_', '-')}",
            )
    if isinstance(sources, str | Path):
        given = [Path(sources)]
    else:
        given = [Path(source) for source in sources]
    files = _by_subset(given, valid=valid, test=test)
    known: dict[Row, Path] = {}
    for path, row in chain(*files.values()):
        place = path.resolve(), row  # by links too: it could be trained on and tested
        if place in known:
            raise UsageError(
                "a file is named twice",
                where=str(path),
                expected="each once",
                got=f"{known[place]} before",
            )
        known[place] = path
    counts = {subset: len(rows) for subset, rows in files.items()}
    source = f"{sum(counts.values())} trajectories of the user's own"
    about = Description(name=output_name(output), source=source, **wishes)
    if as_is:
        interval = None
    else:
        interval = about.frame_interval
    subsets = {
        subset: (open_row(row, interval) for row in rows)
        for subset, rows in files.items()
    }
    return make_local_split(
        about, subsets, output, command="adopt", counts=counts, progress=progress
    )


def import_split(
    source: str | Path,
    *,
    format: str,
    output: str | Path,
    allow_pickle: bool = False,
    kinds: Mapping[int, str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    **wishes: Unpack[Wishes],
) -> LocalSplit:
    """Make a local split of train, valid and test in another code base's format.

    Positions are taken over as they are, as float32; velocities are their differences
    over the frame interval. A ``force.py`` beside the data is left alone.

    Args:
        source: folder of the three files and metadata.json.
        format: "gns-npz" or "lagrangebench-h5".
        output: folder to make; its last part is the name of the split.
        allow_pickle: whether arrays that are stored as pickled objects (all of gns-npz)
            may be rebuilt; whatever else a pickle calls is refused even then.
        kinds: number of a kind of particles to the material that it stands for, or to
            "drop".
        progress: called as the work advances.
        **wishes: what shall hold instead of what the metadata say, see
            :class:`lagbench.exchange.trajectory.Description`.

    Raises:
        UsageError: unknown format, pickled objects that may not be rebuilt, a folder
            that is there, a task that does not fit the data.
        UnreadableFileError: a file is missing, damaged or laid out otherwise, or holds
            particles of a kind that no material is known for.
        DataError: positions are not plane, not finite, outside the unit box, or cross a
            periodic one.
        WorkFailedError: the disk is full or not writable.
    """
    said = check_wishes(wishes)
    form = parse_format(format)
    folder = Path(source)
    files = {subset: folder / f"{subset}{ENDINGS[form]}" for subset in HASHED_SUBSETS}
    missing = [path.name for path in files.values() if not path.is_file()]
    if missing:
        there = (
            f"the folder holds {HASHED_SUBSETS[0]}{ending}: --format {other.value}"
            for other, ending in ENDINGS.items()
            if all(
                (folder / f"{subset}{ending}").is_file() for subset in HASHED_SUBSETS
            )
        )
        raise UnreadableFileError(
            "files are missing",
            where=str(folder),
            expected=", ".join(p.name for p in files.values()),
            got=f"no {', no '.join(missing)}",
            fix=next(there, None),
        )
    if form is Format.GNS_NPZ and not allow_pickle:
        raise UsageError(
            "the trajectories in this format are pickled objects",
            where=str(files["train"]),
            expected="leave to rebuild them",
            fix="add --allow-pickle: arrays are rebuilt, any other call in the file "
            "is refused",
        )
    stated = read_source(folder, form)
    hints = stated.hints
    if wishes.keys() & {
        "input_frames",
        "horizon",
    }:  # the frames belong to the exported task
        hints = hints.model_copy(update={"frames_of_interest": None})
    # What the metadata say, over it what our own exports add, over both what the user
    # says.
    facts = {
        **stated.model_dump(exclude={"periodic", "hints"}, exclude_none=True),
        **hints.model_dump(
            exclude={"origin", "placement", "wall_particle_type"}, exclude_none=True
        ),
        "full_box": hints.placement == "cell_centres",
        **said,
    }
    if "frame_interval" not in facts:
        raise UsageError(
            "the metadata state no time between frames",
            fix="say it: --frame-interval SECONDS",
        )
    about = Description(
        name=output_name(output),
        source=f"{form.value}: "
        + ", ".join(f"{p.name} {file_sha256(p)[:16]}" for p in files.values()),
        **facts,
    )
    given = {**dict.fromkeys(hints.wall_particle_type, DROP), **(kinds or {})}
    if form is Format.GNS_NPZ:
        read = gns_npz.trajectories
    else:
        read = partial(_h5_trajectories, stated=stated)
    subsets = {subset: read(path, given) for subset, path in files.items()}
    return make_local_split(about, subsets, output, command="import", progress=progress)


def _by_subset(
    given: Sequence[Path], *, valid: int | None, test: int | None
) -> Mapping[str, list[Row]]:
    """Return the trajectories of each subset."""
    if len(given) == 1 and (given[0] / HASHED_SUBSETS[0]).is_dir():
        if valid is not None or test is not None:
            raise UsageError(
                "the folders say what is valid and test", where="--valid and --test"
            )
        return {subset: rows_of(given[0] / subset) for subset in HASHED_SUBSETS}
    # A shell lists run10 before run2; an order that is not the shell's is the user's
    # own.
    in_order = natural(given) if list(given) == sorted(given) else given
    rows = [row for path in in_order for row in rows_of(path)]
    tenth = max(1, len(rows) // 10)
    for_valid, for_test = (tenth if n is None else n for n in (valid, test))
    for_train = len(rows) - for_valid - for_test
    if min(for_train, for_valid, for_test) < 1:
        raise UsageError(
            "each subset needs a trajectory",
            where="--valid and --test",
            expected="at least one each, and one left for train",
            got=f"{len(rows)} trajectories, {for_valid} for valid, {for_test} for test",
        )
    end = for_train + for_valid
    return {"train": rows[:for_train], "valid": rows[for_train:end], "test": rows[end:]}


def _h5_trajectories(
    path: Path, kinds: Mapping[int, str], stated: Source
) -> Iterator[Trajectory]:
    """Yield a file's trajectories; a ``force.py`` beside it, which LagrangeBench would
    run, is left alone.
    """
    with open_hdf5(path) as file:
        # A stranger's file shall read none of ours, and hold no more than it shows.
        check_structure(file, path, Structure(members=MOST_TRAJECTORIES, groups=None))
        for key in sorted(file):
            with hdf5_errors(path):
                found = _h5_trajectory(
                    path, file[key], f"{path}, group {key!r}", kinds, stated
                )
            yield found


def _h5_trajectory(
    path: Path, group: h5py.Group, name: str, given: Mapping[int, str], stated: Source
) -> Trajectory:
    if isinstance(group, h5py.Dataset):
        parts = set()
    else:
        parts = set(group)
    if not {"position", "particle_type"} <= parts:
        raise UnreadableFileError(
            "this is no trajectory", where=name, expected="position and particle_type"
        )
    position = group["position"]
    kinds = group["particle_type"]
    shape = position.shape
    check_array(name, shape, position.dtype)
    form = Format.LAGRANGEBENCH_H5
    numbers = np.asarray(kinds)
    material, kept = materials_of(form, numbers, shape[1], given=given, where=name)
    origin = np.asarray(stated.hints.origin, np.float32)
    sides = np.array([high - low for low, high in stated.bounds])
    half = np.where(stated.periodic, sides / 2.0, np.inf)

    def read() -> Iterator[Frame]:
        before: NDArray[np.floating] | None = None
        for number in range(shape[0]):
            with hdf5_errors(path, f"{position.name}, frame {number}"):
                frame = position[number]
            if origin.any():
                place = frame[kept] + origin
            else:
                place = frame[kept]
            if (
                any(stated.periodic)
                and before is not None
                and (np.abs(place - before) > half).any()
            ):
                raise DataError(
                    "particles cross a periodic boundary",
                    where=f"{name}, frame {number}",
                    expected="positions that move on: velocities are their differences",
                    got="a jump of more than half the box",
                    fix="lagbench has no periodic boxes: leave such data out",
                )
            before = place
            yield place, None

    return Trajectory(name=name, frames=shape[0], material=material, read=read)
