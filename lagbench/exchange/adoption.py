"""Trajectories from elsewhere in, a hashed local split out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Unpack

import h5py
import numpy as np

from lagbench.data.checksums import HASHED_SUBSETS, file_sha256
from lagbench.data.hdf5 import hdf5_errors, open_hdf5
from lagbench.data.layout import expand_home
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import (
    UnreadableFileError,
    UsageError,
    UsageErrorCollector,
    format_count,
)
from lagbench.metrics.significance import FEWEST_SCENARIOS
from lagbench.work.run import Progress

from . import gns_npz
from .array_files import Row, list_trajectories, open_trajectory, sort_naturally
from .axis_order import parse_order
from .local_split import (
    LocalSplit,
    check_output,
    find_bounds,
    format_bounds,
    make_local_split,
    output_name,
)
from .metadata import (
    DROP,
    ENDINGS,
    FORCE,
    Format,
    SourceMetadata,
    find_materials,
    parse_format,
    read_metadata,
)
from .trajectory import (
    DataOptions,
    Description,
    Frame,
    Trajectory,
    check_array,
    check_options,
)

NEEDED_OPTIONS = {
    "radius": "the connectivity radius of graph models, in the length of the data",
    "frame_interval": "the time between two frames [s]",
}
"""Options without which nothing is adopted, and their meanings."""

MOST_TRAJECTORIES = 100_000
"""Most trajectories of an HDF5 file that are looked at."""


def adopt(
    sources: str | Path | Sequence[str | Path],
    *,
    output: str | Path | None = None,
    valid: int | None = None,
    test: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    **options: Unpack[DataOptions],
) -> LocalSplit:
    """Make a local split of trajectories in .npy, .npz or netCDF files.

    A .npy file holds positions [frame, particle, axis], or several trajectories
    [trajectory, frame, particle, axis], in two or three dimensions; .npz and netCDF
    files hold ``position`` and, if they like, ``velocity`` of the same shape,
    ``material`` [particle] (0 liquid, 1 jelly, 2 snow, 3 rope; liquid when absent) and
    ``wall_velocity`` [wall, axis] or [frame, wall, axis] (left, right, bottom, top,
    and front, back in three dimensions). Trajectories may differ in their numbers of
    frames and of particles. Nothing is unpickled.

    Args:
        sources: a folder with subfolders ``train``, ``valid`` and ``test``; or files,
            or a folder of files, which are sorted by name and of which the last are
            taken for test, those before for valid.
        output: folder to make, which must be given; its last part is the name of the
            split.
        valid: trajectories for valid; a tenth, at least one, when None.
        test: trajectories for test; when None a tenth, at least six (with fewer no
            p-value can reach 5 %), at most a third.
        progress: called as the work advances.
        **options: ``radius`` and ``frame_interval``, which must be given; ``axes``, the
            order of the axes of arrays, as in ("particle", "frame", "space"); and what
            else is known, see :class:`lagbench.exchange.trajectory.Description`. With
            ``rescale`` and without ``bounds``, the extent of all positions is the box.

    Raises:
        UsageError: no radius or frame interval, too few trajectories or one named
            twice, an output folder that exists already, a task that does not fit the
            data, a period that the positions contradict. One message names everything
            that is missing.
        UnreadableFileError: a file is damaged, pickled, or holds no positions.
        DataError: positions are not finite, or outside the unit box, or
            particles jump by more than half the box along an axis with walls.
        WorkFailedError: the disk is full or not writable.
    """
    options = check_options(options)
    if isinstance(sources, str | Path):
        paths = [expand_home(sources, "sources")]
    else:
        paths = [expand_home(source, "sources") for source in sources]

    rows_of: Mapping[str, list[Row]] = {}
    mistakes = UsageErrorCollector()
    for name, meaning in NEEDED_OPTIONS.items():
        with mistakes:
            _require_option(options, name, meaning)
    folder = Path()
    with mistakes:
        folder = check_output(output)
    stated_order = None
    if "axes" in options:
        with mistakes:
            stated_order = parse_order(options["axes"])
    with mistakes:
        rows_of = _divide_into_subsets(paths, valid=valid, test=test)
    mistakes.raise_errors()
    _refuse_duplicates(list(chain(*rows_of.values())))

    open_row = partial(open_trajectory, order=stated_order)
    counts = {}
    subsets = {}
    for subset, rows in rows_of.items():
        counts[subset] = len(rows)
        subsets[subset] = map(open_row, rows)
    stated_fields: dict[str, Any] = {**options}
    stated_fields.pop("axes", None)
    needs_bounds = options.get("rescale") and not options.get("periodic")
    if needs_bounds and "bounds" not in options:
        stated_fields["bounds"] = find_bounds(map(open_row, chain(*rows_of.values())))
    description = Description(
        name=folder.name,
        source=f"{sum(counts.values())} trajectories of the user's own",
        **stated_fields,
    )
    local_split = make_local_split(
        description,
        subsets,
        folder,
        command="adopt",
        counts=counts,
        progress=progress,
    )
    notes = list(local_split.notes)
    if "bounds" not in options:
        walls = format_bounds(local_split.bounds)
        notes.append(
            f"no bounds are stated, so the walls are {walls}, the smallest box around "
            "all positions. Models and scores use these walls; --bounds states the "
            "true ones"
        )
    return replace(local_split, notes=tuple(notes))


def _require_option(options: DataOptions, name: str, meaning: str) -> None:
    """Refuse to go on without an option that no data state."""
    if name in options:
        return
    words = name.replace("_", " ")
    option = name.replace("_", "-")
    raise UsageError(
        f"the {words} is not known",
        where=f"--{option}",
        expected=meaning,
        got="nothing",
        fix=f"add --{option} NUMBER, or the key {name} of a --describe file",
    )


def _divide_into_subsets(
    paths: Sequence[Path], *, valid: int | None, test: int | None
) -> Mapping[str, list[Row]]:
    """Return the trajectories of each subset."""
    if len(paths) == 1 and (paths[0] / HASHED_SUBSETS[0]).is_dir():
        if valid is not None or test is not None:
            raise UsageError(
                "the folders train, valid and test decide the subsets",
                where="--valid and --test",
                expected="no such option beside the folders train, valid and test",
                got=f"--valid {valid}, --test {test}",
                fix="leave them out, or name the files",
            )
        return {
            subset: list_trajectories(paths[0] / subset) for subset in HASHED_SUBSETS
        }

    # A shell lists run10 before run2; an order that is not the shell's is the user's
    # own.
    if list(paths) == sorted(paths):
        paths = sort_naturally(paths)
    rows = []
    for path in paths:
        rows += list_trajectories(path)
    _require_one("--valid", valid)
    _require_one("--test", test)
    valid_count, test_count = _count_held_out(len(rows), valid=valid, test=test)
    train_count = len(rows) - valid_count - test_count
    if train_count < 1:
        fewest = _fewest_trajectories(valid=valid, test=test)
        raise UsageError(
            "each subset needs a trajectory",
            where="--valid and --test",
            expected=f"at least {fewest} trajectories, so that one is left for train",
            got=f"{format_count(len(rows), 'trajectory')}, {valid_count} for valid, "
            f"{test_count} for test",
            fix="name more files, or a .npy of shape [trajectory, frame, particle, "
            "axis]; or ask for fewer with --valid and --test",
        )
    first_test = train_count + valid_count
    return {
        "train": rows[:train_count],
        "valid": rows[train_count:first_test],
        "test": rows[first_test:],
    }


def _require_one(option: str, count: int | None) -> None:
    """Refuse a stated subset without trajectories."""
    if count is None or count >= 1:
        return
    raise UsageError(
        "each subset needs a trajectory",
        where=option,
        expected="at least 1",
        got=count,
        fix="give a larger number, or leave the option out",
    )


def _count_held_out(
    total: int, *, valid: int | None, test: int | None
) -> tuple[int, int]:
    """Return the numbers of trajectories for valid and test; train has the others."""
    if valid is None:
        valid = max(1, total // 10)
    if test is None:
        # enough for a p-value, but no more than train can spare
        test = max(1, total // 10, min(FEWEST_SCENARIOS, total // 3))
    return valid, test


def _fewest_trajectories(*, valid: int | None, test: int | None) -> int:
    """Return the fewest trajectories of which one is left for train."""
    fewest = 1
    while True:
        held_out_count = sum(_count_held_out(fewest, valid=valid, test=test))
        if held_out_count < fewest:
            return fewest
        # With more trajectories no fewer are held out, so the result is no smaller.
        fewest = held_out_count + 1


def _refuse_duplicates(rows: Sequence[Row]) -> None:
    """Refuse a trajectory that is named twice, also by links.

    It could be trained on and tested.
    """
    path_of: dict[Row, Path] = {}
    for path, number in rows:
        row = (path.resolve(), number)
        if row in path_of:
            raise UsageError(
                "a file is named twice",
                where=str(path),
                expected="each once",
                got=f"{path_of[row]} before",
                fix="name it once; otherwise models could be trained and tested on it",
            )
        path_of[row] = path


def import_split(
    source: str | Path,
    *,
    output: str | Path,
    format: str | None = None,
    kinds: Mapping[int, str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    **options: Unpack[DataOptions],
) -> LocalSplit:
    """Make a local split of train, valid and test in another code base's format.

    Positions are taken over as they are, as float32; velocities are their differences
    over the frame interval. No pickle is run. A ``force.py`` beside the data is not
    read; a note says so.

    Args:
        source: folder of the three files and metadata.json.
        output: folder to make; its last part is the name of the split.
        format: "gns-npz" or "lagrangebench-h5"; by default the one whose files the
            folder holds.
        kinds: number of a kind of particles to the material that it stands for, or to
            "drop".
        progress: called as the work advances.
        **options: what shall hold instead of what the metadata say, see
            :class:`lagbench.exchange.trajectory.Description`.

    Raises:
        UsageError: unknown format, a folder whose files are of no format or of both
            and none is named, an output folder that is there, a task that does not fit
            the data, a period that the positions contradict.
        UnreadableFileError: a file is missing, damaged or laid out otherwise, holds a
            pickle of more than arrays, or particles of a kind that no material is
            known for.
        DataError: positions are not finite, or outside the unit box, or
            particles jump by more than half the box along an axis with walls.
        WorkFailedError: the disk is full or not writable.
    """
    options = check_options(options)
    if "axes" in options:
        raise UsageError(
            "the format itself states the order of the axes",
            where="axes",
            expected="no such key",
            got="axes",
            fix="leave it out; adopt takes it",
        )
    folder = expand_home(source, "source")
    if not folder.is_dir():
        raise UnreadableFileError(
            "there is no such folder",
            where=str(folder),
            expected="a folder of train, valid, test and metadata.json",
            got="a file" if folder.exists() else "nothing",
            fix="name the folder of the data",
        )
    if format is None:
        form = _recognise_format(folder)
    else:
        form = parse_format(format)
    names = _file_names(form)
    _require_files(folder, names)
    metadata = read_metadata(folder, form)
    digests = [f"{name} {file_sha256(folder / name)[:16]}" for name in names]
    description = Description(
        name=output_name(output),
        source=f"{form.value}: {', '.join(digests)}",
        **_description_options(metadata, options),
    )

    user_kinds = dict.fromkeys(metadata.lagbench.wall_particle_type, DROP)
    user_kinds.update(kinds or {})
    read = gns_npz.read_trajectories
    if form is Format.LAGRANGEBENCH_H5:
        read = partial(_read_h5, metadata=metadata)
    subsets = {}
    for subset, name in zip(HASHED_SUBSETS, names, strict=True):
        subsets[subset] = read(folder / name, user_kinds)
    local_split = make_local_split(
        description, subsets, output, command="import", progress=progress
    )
    if not (folder / FORCE).is_file():
        return local_split
    note = f"{FORCE} is a program and is not read: the split has no body force"
    return replace(local_split, notes=(*local_split.notes, note))


def _file_names(form: Format) -> list[str]:
    """Return the names of train, valid and test in a format."""
    return [f"{subset}{ENDINGS[form]}" for subset in HASHED_SUBSETS]


def _missing_files(folder: Path, names: Sequence[str]) -> list[str]:
    return [name for name in names if not (folder / name).is_file()]


def _recognise_format(folder: Path) -> Format:
    """Return the format whose files a folder holds; refuse none, and several.

    A format with all three files wins over one of which files are missing.
    """
    whole_formats = []
    begun_formats = []
    layouts = []
    for form in Format:
        names = _file_names(form)
        layouts.append(f"{', '.join(names)} ({form.value})")
        missing_count = len(_missing_files(folder, names))
        if missing_count == 0:
            whole_formats.append(form)
        elif missing_count < len(names):
            begun_formats.append(form)
    formats = whole_formats or begun_formats
    if len(formats) == 1:
        return formats[0]
    if formats:
        got = "files of both formats"
        fix = f"name one: --format {formats[0].value}"
    else:
        got = "no such files"
        fix = "name their folder; `lagbench adopt` takes other files"
    raise UsageError(
        "the format of the data is not clear",
        where=str(folder),
        expected=" or ".join(layouts),
        got=got,
        fix=fix,
    )


def _require_files(folder: Path, names: Sequence[str]) -> None:
    """Refuse a folder without the files of a format; name the format that it has."""
    missing = _missing_files(folder, names)
    if not missing:
        return
    fix = None
    for form in Format:
        form_names = _file_names(form)
        if not _missing_files(folder, form_names):
            fix = f"the folder holds {form_names[0]}: --format {form.value}"
    raise UnreadableFileError(
        "files are missing",
        where=str(folder),
        expected=", ".join(names),
        got=f"no {', no '.join(missing)}",
        fix=fix or "name their folder; `lagbench adopt` takes other files",
    )


def _description_options(
    metadata: SourceMetadata, options: DataOptions
) -> dict[str, Any]:
    """Return the keywords of a ``Description``, without its name and source.

    The user's options win over what our own exports add (``metadata.lagbench``), which
    wins over the rest of the metadata.

    Raises:
        UsageError: nothing states the time between frames.
    """
    keys = metadata.lagbench
    if "input_frames" in options or "horizon" in options:
        # The frames of interest belong to the exported task.
        keys = keys.model_copy(update={"frames_of_interest": None})
    merged: dict[str, Any] = metadata.model_dump(
        exclude={"periodic", "lagbench"}, exclude_none=True
    )
    merged |= keys.model_dump(
        exclude={"origin", "placement", "wall_particle_type"}, exclude_none=True
    )
    merged["periodic"] = metadata.periodic_axes
    merged["full_box"] = keys.placement == "cell_centres"
    merged |= options
    if "frame_interval" not in merged:
        raise UsageError(
            "the metadata state no time between frames",
            where="metadata.json",
            expected="dt",
            got="none",
            fix="state it: --frame-interval SECONDS",
        )
    return merged


def _read_h5(
    path: Path, kinds: Mapping[int, str], metadata: SourceMetadata
) -> Iterator[Trajectory]:
    """Yield the trajectories of a file of LagrangeBench."""
    with open_hdf5(path) as file:
        # A stranger's file shall read none of ours, and hold no more than it shows.
        structure = Structure(members=MOST_TRAJECTORIES, groups=None)
        check_structure(file, path, structure)
        for key in sorted(file):
            name = f"{path}, group {key!r}"
            with hdf5_errors(path):
                trajectory = _parse_group(
                    path, file[key], name=name, kinds=kinds, metadata=metadata
                )
            yield trajectory


def _parse_group(
    path: Path,
    group: h5py.Group,
    *,
    name: str,
    kinds: Mapping[int, str],
    metadata: SourceMetadata,
) -> Trajectory:
    members = set()
    if not isinstance(group, h5py.Dataset):
        members = set(group)
    if not {"position", "particle_type"} <= members:
        raise UnreadableFileError(
            "this is no trajectory",
            where=name,
            expected="position and particle_type",
            got=", ".join(sorted(members)[:10]) or "no members",
            fix="export it again as LagrangeBench writes it, or use lagbench adopt",
        )
    position = group["position"]
    shape = position.shape
    check_array(name, shape, position.dtype)
    material, is_kept = find_materials(
        Format.LAGRANGEBENCH_H5,
        np.asarray(group["particle_type"]),
        shape[1],
        user_kinds=kinds,
        where=name,
    )
    origin = np.asarray(metadata.lagbench.origin, np.float32)[: shape[2]]

    def read() -> Iterator[Frame]:
        for number in range(shape[0]):
            with hdf5_errors(path, f"{position.name}, frame {number}"):
                frame = position[number][is_kept]
            if origin.any():
                frame = frame + origin
            yield frame, None

    return Trajectory(
        name=name,
        frames=shape[0],
        material=material,
        read=read,
        dimension=shape[2],
    )
