"""Trajectories from elsewhere in, a hashed local split out: the one door."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pydantic import ValidationError

from lagbench.data import WALL
from lagbench.data.box import AXES, Box
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.judgement import Judgement, find_shared_frames, judge_trajectory
from lagbench.data.layout import expand_home
from lagbench.errors import DataError, UsageError
from lagbench.metrics.significance import FEWEST_SCENARIOS
from lagbench.work.run import Meter, Progress

from .local_split import (
    Description,
    LocalSplit,
    check_output,
    write_local_split,
)
from .names import Trajectory, name_trajectory, parse_kinds
from .readers import (
    Listing,
    Reading,
    Source,
    list_sources,
    read_metadata,
    reading,
)
from .spacing import ball_volume, estimate_spacing

RADIUS = 2.0
"""Connectivity radius where none is stated [spacing]."""

SPACING_RATIO = 1.5
"""Ratio of the stated spacing and the measured one, or its inverse, at most."""

MOST_SPREAD = 10.0
"""Ratio of the spacings of two trajectories, at most."""

FEWEST_NEIGHBOURS = 3.0
MOST_NEIGHBOURS = 100.0
"""Neighbours within the radius between which nothing is said."""

SMALL_SHARE = 0.1
"""Extent of all positions over the box, along every axis, that needs no note."""

Data = str | Path | xr.Dataset


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """A trajectory that was looked at once, and how it is opened again."""

    open: Callable[[], Trajectory]
    judgement: Judgement
    spacing: float | None  # measured in the first frame [length]; None for one particle
    interval: float  # time between two frames, as the user or the file says [s]
    interval_name: str  # variable or attribute of the file that states it
    particles: int
    axes: tuple[int, ...]  # components that are not constant
    frames: int
    states_kinds: bool  # whether the file says which materials there are
    has_velocity: bool
    has_walls: bool  # whether some particles are walls
    stated: Mapping[str, Any]  # options that the file states


def adopt(
    sources: Data | Sequence[Data],
    *,
    output: str | Path,
    axes: Sequence[str] | str = (),
    positions: str | None = None,
    kinds: Mapping[Any, str] | str | None = None,
    valid: int | None = None,
    test: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    **options: Any,  # noqa: ANN401 (fields of a Description)
) -> LocalSplit:
    """Make a local split of trajectories; nothing about them is guessed.

    A dataset has the dimensions time, particle and space and the variable ``position``;
    where it has them, ``velocity`` of the same shape, ``time`` [s, or its unit],
    ``material`` [particle] (0 liquid, 1 jelly, 2 snow, 3 rope, 4 wall), ``id``
    [particle] or [time, particle], which orders the rows, and ``wall_velocity`` [wall,
    axis] or [time, wall, axis]. docs/exchange.md has the formats.

    Args:
        sources: a folder with subfolders, or files, ``train``, ``valid`` and ``test``;
            or files, folders and datasets of which the last are taken for test, those
            before for valid.
        output: folder to make; its last part is the name of the split.
        axes: order of the axes of arrays without names, of "trajectory", "frame",
            "particle" and "space"; frame, particle, space when empty.
        positions: name of the positions, in HDF5 their path.
        kinds: material, or "drop", of each kind of particles, as in "3=jelly,0=drop".
        valid: trajectories for valid; a tenth, at least one, when None.
        test: trajectories for test; when None a tenth, at least six (with fewer no
            p-value can reach 5 %), at most a third.
        progress: called as the work advances.
        **options: what else is known, see
            :class:`lagbench.exchange.local_split.Description`.

    Raises:
        UsageError: something is not known, or contradicts the data.
        UnreadableFileError: a file is damaged, or of no format that is read.
        DataError: the positions are no trajectories, see
            :mod:`lagbench.data.judgement`.
        WorkFailedError: the disk is full or not writable.
    """
    folder = check_output(output)
    if isinstance(axes, str):
        axes = axes.split(",")
    axes = [axis.strip().replace("time", "frame") for axis in axes]
    if set(axes) - {"trajectory", "frame", "particle", "space"}:
        raise UsageError(
            f"--axes: {', '.join(axes)} are not all known; name trajectory, frame, "
            "particle and space in their order, as in frame,particle,space"
        )
    reading = Reading(axes=axes, positions=positions)
    if isinstance(sources, str | Path | xr.Dataset):
        sources = [sources]
    listings, stated = _list_subsets(sources, reading, valid=valid, test=test)
    known_kinds = parse_kinds(kinds)
    description = _describe({**stated, **options})
    counts = {subset: len(listing.sources) for subset, listing in listings.items()}
    total = sum(counts.values())

    meter = Meter(progress)
    meter.begin("judging", total=total, scenarios=total)
    judged: dict[str, list[_Judged]] = {}
    notes: list[str] = []
    for subset, listing in listings.items():
        notes += [f"not read: {', '.join(listing.skipped)}"] if listing.skipped else []
        judged[subset] = []
        for source in listing.sources:
            judged[subset].append(_judge(source, description, known_kinds, notes))
            meter.count(1, scenarios=1)
    judgements = {}
    for subset, members in judged.items():
        judgements[subset] = [member.judgement for member in members]
    description, box, more_notes = _complete(description, judged)
    notes = [*_shorten(notes), *more_notes, *find_shared_frames(judgements)]

    trajectories = {}
    lone_spacing = float(description.radius or 1.0)  # of a single particle
    for subset, members in judged.items():
        trajectories[subset] = [
            (member.open, description.spacing or member.spacing or lone_spacing)
            for member in members
        ]
    meter.begin("writing", total=total, scenarios=total)
    local_split = write_local_split(
        folder,
        description,
        box,
        trajectories,
        source=f"{total} trajectories of the user's own",
        count=partial(meter.count, 1, scenarios=1),
    )
    if counts["test"] < FEWEST_SCENARIOS:
        notes.append(
            f"{counts['test']} trajectories for test: under {FEWEST_SCENARIOS} no "
            "difference between methods can be significant; --test puts more there"
        )
    interval_source = f"{judged['train'][0].interval_name} in the files"
    if options.get("frame_interval") is not None:
        interval_source = "--frame-interval"
    elif "frame_interval" in stated:
        interval_source = "metadata.json"
    return replace(local_split, interval_source=interval_source, notes=tuple(notes))


def _list_subsets(
    sources: Sequence[Data],
    reading: Reading,
    *,
    valid: int | None,
    test: int | None,
) -> tuple[dict[str, Listing], dict[str, Any]]:
    """Return the trajectories of each subset, and what metadata state."""
    first = sources[0]
    if len(sources) == 1 and not isinstance(first, xr.Dataset):
        folder = expand_home(first, "sources")
        parts = {}
        for subset in HASHED_SUBSETS:
            candidates = [folder / subset, *folder.glob(f"{subset}.*")]
            parts[subset] = [path for path in candidates if path.exists()]
        if all(parts.values()):
            several = [paths for paths in parts.values() if len(paths) > 1]
            if several or valid is not None or test is not None:
                raise UsageError(
                    f"{folder}: train, valid and test decide the subsets; leave "
                    "--valid and --test out, and keep one file or folder of each name"
                )
            listings = {}
            for subset, (path,) in parts.items():
                listings[subset] = list_sources(path, reading)
            known = ["metadata.json", *(path.name for (path,) in parts.values())]
            for entry in sorted(folder.iterdir()):
                if entry.name not in known and not entry.name.startswith("."):
                    listings["train"].skipped.append(entry.name)
            return listings, read_metadata(folder)

    found: list[Source] = []
    skipped: list[str] = []
    for source in sources:
        if isinstance(source, xr.Dataset):
            name = f"dataset {len(found)}"
            found += _sources_of_dataset(source, name)
            continue
        listing = list_sources(expand_home(source, "sources"), reading)
        found += listing.sources
        skipped += listing.skipped
    total = len(found)
    valid_count = max(1, total // 10) if valid is None else valid
    test_count = test
    if test_count is None:
        # enough for a p-value, but no more than train can spare
        test_count = max(1, total // 10, min(FEWEST_SCENARIOS, total // 3))
    train_count = total - valid_count - test_count
    if min(train_count, valid_count, test_count) < 1:
        names = ", ".join(source.name for source in found[:3])
        raise UsageError(
            f"{total} trajectories, {valid_count} for valid and {test_count} for test, "
            "leave none for one of train, valid and test; give three or more, and "
            f"--valid and --test from 1. There are {names}; a table of several frames "
            "needs a column time"
        )
    ends = (0, train_count, train_count + valid_count, total)
    listings = {}
    for number, subset in enumerate(HASHED_SUBSETS):
        members = found[ends[number] : ends[number + 1]]
        listings[subset] = Listing(sources=members)
    listings["train"].skipped.extend(skipped)
    return listings, {}


def _sources_of_dataset(dataset: xr.Dataset, name: str) -> Iterator[Source]:
    if "trajectory" not in dataset.dims:
        yield Source(name=name, open=dataset.copy)
        return
    for number in range(dataset.sizes["trajectory"]):
        one = dataset.isel(trajectory=number)
        yield Source(name=f"{name}, trajectory {number}", open=one.copy)


def _describe(options: Mapping[str, Any]) -> Description:
    """Return checked options; values of NumPy become those of Python."""
    plain = {}
    for name, value in options.items():
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if value is not None:
            plain[name] = value
    try:
        return Description.model_validate(plain)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        known = ""
        if first["type"] == "extra_forbidden":
            known = f"; known are {', '.join(Description.model_fields)}"
        raise UsageError(
            f"{name}: {first['msg']} (got {first['input']!r}); correct it{known}"
        ) from error


def _judge(
    source: Source,
    description: Description,
    kinds: Mapping[str, str],
    notes: list[str],
) -> _Judged:
    """Read a trajectory once; refuse what is none, and note what a user should know."""

    def open_trajectory() -> Trajectory:
        with reading(source.name):
            dataset = source.open()
        return _drop_constant_axes(name_trajectory(dataset, source.name, kinds))

    trajectory = open_trajectory()
    name = trajectory.name
    notes += trajectory.notes
    interval = description.frame_interval or trajectory.interval
    if interval is None:
        raise UsageError(
            f"{name} does not state the time between two frames; add --frame-interval "
            "SECONDS, in Python frame_interval=SECONDS"
        )
    if trajectory.interval and abs(trajectory.interval / interval - 1.0) > 0.01:
        raise UsageError(
            f"{name}: frames are {trajectory.interval:.6g} s apart by the times in the "
            f"file, and --frame-interval is {interval:.6g} s; leave the option out, or "
            "correct the file"
        )
    stated = _state_box(description, trajectory)
    with closing(trajectory):
        is_wall = trajectory.material == WALL
        if is_wall.all():
            raise DataError(f"{name}: all particles are walls; give one another kind")
        judgement = judge_trajectory(
            name,
            trajectory.read(),
            box=stated.box,
            frame_interval=interval,
            is_wall=is_wall,
        )
        first_frame, _ = next(trajectory.read())
    box = stated.box or _box_around([judgement])
    notes += judgement.notes
    return _Judged(
        open=open_trajectory,
        judgement=judgement,
        spacing=estimate_spacing(first_frame[~is_wall], box, where=f"{name}, frame 0"),
        has_walls=bool(is_wall.any()),
        interval=interval,
        interval_name=trajectory.interval_name,
        particles=len(trajectory.material),
        axes=trajectory.axes,
        frames=trajectory.frames,
        states_kinds=trajectory.states_kinds,
        has_velocity="velocity" in trajectory.dataset,
        stated={"bounds": stated.bounds, "periodic": stated.periodic},
    )


def _drop_constant_axes(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without components that are the same everywhere.

    Two-dimensional data in formats of three dimensions have one.
    """
    dataset = trajectory.dataset
    last = trajectory.frames - 1
    position = dataset["position"].isel(time=[0, last // 2, last]).values
    lows = position.min(axis=(0, 1))
    is_constant = lows == position.max(axis=(0, 1))
    kept = np.flatnonzero(~is_constant)
    if len(kept) == len(lows) or position.shape[1] == 1:
        return replace(trajectory, axes=tuple(range(len(lows))))
    names = [AXES[axis] for axis in np.flatnonzero(is_constant)]
    text = (
        f"{trajectory.name}: {' and '.join(names)} is {lows[is_constant][0]:g} for all "
        "particles in all frames"
    )
    if len(kept) < 2:
        raise DataError(f"{text}; a trajectory has two or three dimensions")
    note = f"{text}: it is left out, and the data have two dimensions, "
    note += " and ".join(AXES[axis] for axis in kept)
    return replace(
        trajectory,
        dataset=dataset.isel(space=kept),
        axes=tuple(kept.tolist()),
        notes=(*trajectory.notes, note),
    )


def _state_box(description: Description, trajectory: Trajectory) -> Description:
    """Return a description with the bounds and periodic axes of the axes that are kept.

    They are the user's, else those of the file.
    """
    if description.bounds is None and trajectory.stated.get("periodic"):
        description = _describe({**description.model_dump(), **trajectory.stated})
    axes = trajectory.axes
    bounds = description.bounds
    if bounds is None or len(bounds) == len(axes):
        return description
    if len(bounds) < len(axes):
        raise UsageError(
            f"{trajectory.name} has {len(axes)} components, and --bounds has "
            f"{len(bounds)} pairs; give a pair for each"
        )
    periodic = []
    for number, axis in enumerate(axes):
        if AXES[axis] in description.periodic:
            periodic.append(AXES[number])
    return description.model_copy(
        update={
            "bounds": tuple(bounds[axis] for axis in axes),
            "periodic": tuple(periodic),
        }
    )


def _box_around(judgements: Sequence[Judgement]) -> Box:
    """Return the smallest box that holds all positions."""
    low = np.min([judgement.low for judgement in judgements], axis=0)
    high = np.max([judgement.high for judgement in judgements], axis=0)
    return Box.from_bounds(np.stack([low, high], axis=1).tolist())


def _complete(
    description: Description, judged: Mapping[str, Sequence[_Judged]]
) -> tuple[Description, Box, list[str]]:
    """Return a description without gaps, the box, and notes on both.

    Raises:
        UsageError: what is stated contradicts the data, or trajectories differ in what
            a split has once.
    """
    members = [member for many in judged.values() for member in many]
    first = members[0]
    for member in members:
        differing = None
        if member.axes != first.axes:
            differing = f"the dimensions {first.axes} and {member.axes}"
        elif member.stated != first.stated:
            differing = f"the boxes {first.stated} and {member.stated}"
        elif member.has_walls != first.has_walls:
            differing = "particles of walls in one of them only"
        elif member.states_kinds != first.states_kinds:
            differing = "materials in one of them only"
        elif not math.isclose(member.interval, first.interval, rel_tol=0.01):
            differing = f"frames {first.interval:.6g} and {member.interval:.6g} s apart"
        if differing is not None:
            raise UsageError(
                f"{first.judgement.name} and {member.judgement.name} have {differing}; "
                "import them apart"
            )
    notes = []
    if not first.states_kinds:
        notes.append("no file has an array of kinds, so all particles are liquid")
    with_velocity = [member for member in members if member.has_velocity]
    if 0 < len(with_velocity) < len(members):
        notes.append(
            f"{with_velocity[0].judgement.name} has velocities, as "
            f"{len(with_velocity)} of {len(members)} trajectories; those of others are "
            "differences of positions"
        )
    shortest = min([*judged["valid"], *judged["test"]], key=lambda one: one.frames)
    if description.horizon is None and shortest.frames < max(m.frames for m in members):
        notes.append(
            f"{shortest.judgement.name} has {shortest.frames} frames, others more: "
            "frames after these are not predicted; --valid and --test, or names, put "
            "short trajectories into train"
        )
    judgements = [member.judgement for member in members]
    extent = _box_around(judgements)
    middles = np.array([0.5 * (one.low + one.high) for one in judgements])
    distance = np.linalg.norm(middles - np.median(middles, axis=0), axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] > 2.0 * judgements[farthest].extent:
        notes.append(
            f"{judgements[farthest].name} lies {distance[farthest]:.3g} away from the "
            "other trajectories: have all the same origin?"
        )
    bounds = first.stated["bounds"]
    periodic = first.stated["periodic"]
    box = extent
    if bounds is not None:
        stated = description.model_copy(update={"bounds": bounds, "periodic": periodic})
        box = stated.box or extent
    else:
        sides = " x ".join(f"[{low:.6g}, {high:.6g}]" for low, high in extent.bounds)
        notes.append(
            f"no bounds are stated, so the walls are {sides}, the smallest box around "
            "all positions; --bounds states the true ones"
        )
    known_spacings = [member.spacing for member in members if member.spacing]
    usual = description.spacing
    if known_spacings:
        measured = float(np.median(known_spacings))
        usual = usual or measured
        _check_spacing(description, known_spacings, notes)
    _check_bounds(box, extent, judgements, usual or 0.0, notes)
    radius = description.radius
    if radius is None:
        if usual is None:
            raise UsageError("one particle has no spacing; add --radius LENGTH")
        radius = float(f"{RADIUS * usual:.2g}")
        notes.append(f"no radius is stated, so it is {radius:g}, about two spacings")
    if radius > box.largest_radius * (1.0 + 1e-6):
        raise UsageError(
            f"the radius {radius:g} is above half of the shortest period, "
            f"{box.largest_radius:g}; give a smaller --radius: two or three spacings"
        )
    if usual is not None:
        neighbours = ball_volume(radius / usual, box.dimension)
        most = max(member.particles for member in members)
        if most > FEWEST_NEIGHBOURS and neighbours < FEWEST_NEIGHBOURS:
            notes.append(
                f"the radius {radius:g} holds {neighbours:.1g} neighbours: a graph "
                f"model sees next to nothing; two spacings are {2.0 * usual:.2g}"
            )
        neighbours = min(neighbours, most - 1.0)
        if neighbours > MOST_NEIGHBOURS:
            notes.append(
                f"the radius {radius:g} holds about {neighbours:.0f} neighbours, which "
                f"make {neighbours * most:.2g} edges: a graph model may need more "
                f"memory than there is; two spacings are {2.0 * usual:.2g}"
            )
    complete = description.model_copy(
        update={
            "radius": radius,
            "frame_interval": first.interval,
            "bounds": bounds,
            "periodic": periodic,
        }
    )
    return complete, box, notes


def _check_spacing(
    description: Description, measured: Sequence[float], notes: list[str]
) -> None:
    """Refuse a stated spacing that is not the measured one; note several ones."""
    low = min(measured)
    high = max(measured)
    stated = description.spacing
    if high > MOST_SPREAD * low:
        raise UsageError(
            f"spacings of trajectories range from {low:.3g} to {high:.3g}: are they in "
            "one unit? give all in the same, or import them apart"
        )
    if stated is None:
        if high > 1.1 * low:
            notes.append(
                f"spacings of trajectories differ, from {low:.3g} to {high:.3g}: each "
                "has the particle mass of its own"
            )
        return
    usual = float(np.median(measured))
    if max(stated / usual, usual / stated) > SPACING_RATIO:
        raise UsageError(
            f"the stated spacing is {stated:.4g}, and particles are {usual:.4g} apart "
            "in the first frames; leave it out, or give it in the length of the data "
            "(masses and the score grid rest on it)"
        )


def _check_bounds(
    box: Box,
    extent: Box,
    judgements: Sequence[Judgement],
    spacing: float,
    notes: list[str],
) -> None:
    """Refuse particles outside the walls; note a box that is far too large."""
    for judgement in judgements:
        excess = np.maximum(box.lower_walls - judgement.low, 0.0)
        excess = np.maximum(excess, judgement.high - box.upper_walls)
        if excess.max() > spacing:
            axis = AXES[int(np.argmax(excess))]
            sides = np.stack([judgement.low, judgement.high], axis=1).round(6).tolist()
            raise UsageError(
                f"{judgement.name}: particles lie {excess.max():.3g} outside the "
                f"bounds along {axis}; the trajectory fills {sides}: give --bounds "
                "that hold it"
            )
    share = extent.lengths / box.lengths
    if (share < SMALL_SHARE).all():
        notes.append(
            f"all positions lie in {share.max():.2g} of the box along each axis: are "
            "--bounds in the length of the data?"
        )


def _shorten(notes: Sequence[str]) -> list[str]:
    """Return notes of which those that trajectories share stand once.

    A note begins with the name of the trajectory, and a colon.
    """
    names_of: dict[str, list[str]] = {}
    for note in notes:
        name, _, text = note.partition(": ")
        names_of.setdefault(text or name, []).append(name)
    lines = []
    for text, names in names_of.items():
        if text in names:
            lines.append(text)
        elif len(names) == 1:
            lines.append(f"{names[0]}: {text}")
        else:
            lines.append(f"{names[0]} and {len(names) - 1} more: {text}")
    return lines


import_split = adopt
"""The same function by the name of the command, ``lagbench import``."""
