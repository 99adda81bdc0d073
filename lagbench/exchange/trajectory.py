"""Trajectories from elsewhere, and what a user or their metadata say of them."""

from __future__ import annotations

import math
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    with_config,
)
from pydantic_core import ErrorDetails

# pydantic reads the TypedDict of Python 3.12 and later only
from typing_extensions import TypedDict

from lagbench.data.box import AXES, SMALL_SIDE, Box, parse_periodic, unit_box
from lagbench.data.checksums import round_digits
from lagbench.data.field_errors import describe_expectation, describe_input
from lagbench.data.grid import MOST_CELLS
from lagbench.data.hdf5 import FIRST_BYTES, guess_format
from lagbench.data.limits import FRAMES, NEEDED
from lagbench.data.local import is_split_name
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    UsageError,
    UsageErrorCollector,
    format_count,
    suggest_name,
)
from lagbench.submission.issues import quote

Array = NDArray[np.floating]

Frame = tuple[Array, Array | None]
"""Positions [length of the source] and velocities [its length/s], if any."""

Run = tuple[int, Callable[[int], NDArray[np.float32]], NDArray[np.int64]]
"""What a format writes of a trajectory.

The number of frames, a function that returns the positions of one of them, and the kind
of each particle.
"""

Bounds = tuple[tuple[float, float], ...]
"""Low and high walls along x, y and, in three dimensions, z."""

DIMENSIONS = (2, 3)
"""Numbers of components that positions may have."""

ARCHIVE = b"PK"
"""First bytes of a zip archive, which an npz file is."""

HARMLESS_BYTES = 1 << 28
"""Length that an array may always unpack to [bytes]."""

MOST_INFLATION = 200
"""Times its own length that a larger array may unpack to.

Moving particles compress by two or so, resting ones by a hundred: more was made to fill
the memory.
"""

LEAST = 1e-30
MOST = 1e30
"""What a length, a time or a density may be: squares of them are floats."""

LEAST_INTERVAL = 1.0 / NEEDED["frame_rate"].high
"""Shortest time between two frames: a description of a split states the frame rate."""

MOST_MISTAKES = 10
"""Mistakes of a description that one message tells."""

FEWEST_CELLS = 4
MOST_CELLS_OF_PERIODS = 64
"""Cells across a length of 1 of which one number must fit the periods."""

NEIGHBOUR_RADII = 3.0
"""Radii within which a particle must have neighbours, to estimate the spacing."""

REACHES_ACROSS = 4.0
"""Radii of the kernel that measures the density, across a square or cube of all
particles, between the limits.
"""

LEAST_REACH = 3.0
MOST_REACH = 6.0
"""Limits of the radius of the kernel [spacing]; a large one averages over random
positions.
"""

REACH_IN_LATTICE = 1.8
"""Radius of the kernel where particles stand on a lattice: it fits into thin bodies
[spacing].
"""

LATTICE_SPREAD = 0.1
"""Spread of the distances to the nearest neighbour up to which particles are taken for
a lattice: quartile range over median [1].
"""

KERNEL_ROUNDS = 10
"""Rounds in which spacing and reach of the kernel come to agree."""

MOST_SAMPLES = 2_000
"""Particles around which the density is measured, at most."""

INTERIOR_QUANTILE = 0.75
"""Quantile of densities that stands for the inside of the material."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One trajectory whose frames are read when asked for."""

    name: str  # file and key, for messages
    frames: int  # recorded frames
    # value of ``lagbench.data.MATERIALS`` of each particle, [particle]
    material: NDArray[np.int8]
    read: Callable[[], Iterator[Frame]]  # returns the frames in order, one at a time
    dimension: int = 2  # components of a position
    # [length/s], [wall, axis] or [frame, wall, axis]; None without walls
    wall_velocity: Array | None = None
    # parameters that the file states and hashes
    parameters: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class BoxTransform:
    """How lengths of the source become the unit box's: ``(x - corner) / scale``."""

    scale: float = 1.0
    corner: tuple[float, ...] = (0.0, 0.0, 0.0)  # of the axes that there are

    @classmethod
    def fit(cls, bounds: Bounds, periodic: Sequence[str] = ()) -> BoxTransform:
        """Return the transform that brings a box into the unit box.

        The scale is a power of two, which loses no bit: the least that is not below the
        longest side, but 1 for sides from 1/16 to 1. Where no score grid would fit the
        periods then, as in a box of side 2 pi, it is a multiple of the longest period,
        if that helps. The corner is 0 where that is enough.

        Args:
            bounds: the box [length].
            periodic: names of the axes without walls.
        """
        low, high = np.array(bounds, dtype=np.float64).T
        sides = high - low
        scale = _fitting_power_of_two(float(sides.max()))
        is_periodic = parse_periodic(periodic, len(bounds))
        if any(is_periodic):
            scale = _scale_with_grid(sides, is_periodic, scale)
        corner = low
        if (low >= 0.0).all() and (high <= scale).all():
            corner = np.zeros(len(bounds))
        return cls(scale=scale, corner=tuple(float(value) for value in corner))

    def transform_positions(self, position: Array) -> NDArray[np.float32]:
        """Return positions in the unit box, float32."""
        if self.scale != 1.0 or any(self.corner):
            corner = np.asarray(self.corner[: position.shape[-1]])
            position = (position.astype(np.float64) - corner) / self.scale
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            return position.astype(np.float32, copy=False)

    def transform_box(self, bounds: Bounds) -> Bounds:
        """Return a box of the source in the unit box."""
        sides = []
        for (low, high), corner in zip(bounds, self.corner, strict=False):
            side = ((low - corner) / self.scale, (high - corner) / self.scale)
            sides.append(side)
        return tuple(sides)


def _fitting_power_of_two(side: float) -> float:
    """Return the least power of two that is not below a side; 1 from 1/16 to 1."""
    if SMALL_SIDE <= side <= 1.0:
        return 1.0
    mantissa, exponent = math.frexp(side)  # exact; the mantissa is from 1/2 to 1
    if mantissa == 0.5:
        exponent -= 1
    return math.ldexp(1.0, exponent)


def _scale_with_grid(
    sides: NDArray[np.float64], is_periodic: Sequence[bool], scale: float
) -> float:
    """Return a scale by which some score grid fits the periods.

    It is the given one if that fits, or if no multiple of the longest period fits.
    """
    period = float(sides[np.asarray(is_periodic)].max())
    multiple = period * math.ceil(float(sides.max()) / period)
    for candidate in (scale, multiple):
        bounds = [(0.0, float(side / candidate)) for side in sides]
        if _has_grid(Box.from_bounds(bounds, is_periodic)):
            return candidate
    return scale


def _has_grid(box: Box) -> bool:
    """Tell whether some score grid has whole cells along the periodic axes."""
    numbers = range(FEWEST_CELLS, MOST_CELLS_OF_PERIODS + 1)
    return any(box.has_whole_cells(cells) for cells in numbers)


Count = Annotated[int, Field(gt=-(1 << 31), lt=1 << 31)]
"""A number that a message can print."""


def _refuse_truth(value: object) -> object:
    """Refuse True and False, which pydantic takes for 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("a number, not true or false")
    return value


Number = Annotated[float, BeforeValidator(_refuse_truth)]

Text = Annotated[str, Field(max_length=100_000)]
"""A text that a file in UTF-8 can hold, which pydantic checks with its length."""


@with_config(ConfigDict(extra="forbid"))
class DataOptions(TypedDict, total=False):
    """What a user may say of data from elsewhere; see :class:`Description`."""

    title: Text
    text: Text
    citation: Text
    licence: Text
    radius: Number
    frame_interval: Number
    bounds: Annotated[Bounds, Field(min_length=2, max_length=3)]
    periodic: Sequence[str]
    rescale: bool
    density: Number
    spacing: Number
    axes: Sequence[str]
    input_frames: Count
    horizon: Count
    frames_of_interest: Sequence[Count]
    cells: Count
    full_box: bool


def read_options(path: Path) -> DataOptions:
    """Return what a YAML file says of the data."""
    return _validate_options(read_yaml(path), path)


def check_options(options: DataOptions) -> DataOptions:
    """Return what a caller says of the data as plain values, without None.

    Values of NumPy become those of Python.
    """
    plain: dict[str, object] = {}
    for name, value in options.items():
        if isinstance(value, np.ndarray | np.generic):
            plain[name] = value.tolist()
        elif value is not None:
            plain[name] = value
    return _validate_options(plain, None)


def _validate_options(options: object, path: Path | None) -> DataOptions:
    """Return a checked description of data from elsewhere, which adoption needs.

    It comes from a file or, without a path, from a caller. At most ten mistakes are
    named together.
    """
    checked_options: DataOptions = {}
    details: list[ErrorDetails] = []
    try:
        checked_options = TypeAdapter(DataOptions).validate_python(options)
    except ValidationError as error:
        details = error.errors()

    mistakes = UsageErrorCollector()
    for detail in details[:MOST_MISTAKES]:
        with mistakes:
            raise _option_error(detail, path)
    omitted_count = len(details) - MOST_MISTAKES
    if omitted_count > 0:
        with mistakes:
            raise UsageError(
                "there are more mistakes",
                where="the options" if path is None else str(path),
                expected="options as docs/exchange.md has them",
                got=f"{omitted_count} more",
                fix="correct those above, then try again",
            )
    mistakes.raise_errors()
    return checked_options


def _option_error(detail: ErrorDetails, path: Path | None) -> UsageError:
    """Return what is wrong with one key of the options."""
    key = quote(".".join(map(str, detail["loc"])))[1:-1]
    expected = describe_expectation(detail)
    fix = "docs/exchange.md has the keys"
    if detail["type"] == "extra_forbidden":
        expected = "a key of a description"
        fix = suggest_name(key, DataOptions.__annotations__)
    where = key or "(whole file)"
    if path is not None:
        where = f"{path}, key {where}"
    return UsageError(
        "this does not describe data",
        where=where,
        expected=expected,
        got=describe_input(detail),
        fix=fix,
    )


def check_name(name: str) -> None:
    """Refuse a name that no split can have.

    Raises:
        UsageError: the message has a name like it that one can.
    """
    if is_split_name(name):
        return
    plain = re.sub(r"[^a-z0-9_-]+", "-", name.lower())
    proposal = plain.strip("-_0123456789") or "own"
    raise UsageError(
        "a split cannot have that name",
        where="--output, its last part",
        expected="small letters, digits, - and _, a letter first",
        got=name,
        fix=f"name it so: --output {proposal}",
    )


def bounds_example(dimension: int) -> str:
    """Return how the bounds of a box of side 1 are given on the command line.

    >>> bounds_example(2)
    '--bounds 0,1,0,1'
    """
    return f"--bounds {','.join(['0,1'] * dimension)}"


@dataclass(frozen=True, kw_only=True)
class Description:
    """What is known of data from elsewhere; lengths are those of the source.

    What cannot be (a name, a number out of range, a scale without bounds) is a
    UsageError.
    """

    name: str  # name of the split
    title: str = ""  # title of the split; its name when empty
    text: str = ""  # what the data are
    citation: str = "none"  # whom to cite
    licence: str = "unknown"  # licence of the data
    source: str  # where they come from
    radius: float  # connectivity radius
    frame_interval: float  # time between frames [s]
    # box that holds the particles; None where the positions say
    bounds: Bounds | None = None
    periodic: Sequence[str] = ()  # names of the axes without walls; needs bounds
    rescale: bool = False  # whether to fit the bounds into the unit box
    density: float = 1.0  # rest density [mass/length^d]
    # distance of neighbouring particles at first; None to estimate it
    spacing: float | None = None
    input_frames: int = 6  # frames given to a model
    # frames to predict; None for all that every test scenario has
    horizon: int | None = None
    # absolute frames that are reported; None for the last
    frames_of_interest: Sequence[int] | None = None
    # cells across of the score grid; None for one that suits the spacing
    cells: int | None = None
    # whether material fills the box, so that vorticity ranks; else positions rank
    full_box: bool = False
    transform: BoxTransform = field(init=False, default=BoxTransform())

    def __post_init__(self) -> None:
        """Check what the user said, and fit the box where that is asked."""
        mistakes = UsageErrorCollector()
        with mistakes:
            check_name(self.name)
        self._check_quantities(mistakes)
        self._check_counts(mistakes)
        with mistakes:
            self._check_bounds()
        with mistakes:
            self._check_periodic()
        mistakes.raise_errors()
        if self.rescale:
            if self.bounds is None:
                raise UsageError(
                    "there are no bounds to fit into the unit box",
                    where="--rescale",
                    expected="bounds of the data",
                    got="none",
                    fix="add --bounds",
                )
            transform = BoxTransform.fit(self.bounds, self.periodic)
            object.__setattr__(self, "transform", transform)
        self._check_radius()

    def _check_quantities(self, mistakes: UsageErrorCollector) -> None:
        for option, value, least in (
            ("--radius", self.radius, LEAST),
            ("--frame-interval", self.frame_interval, LEAST_INTERVAL),
            ("density", self.density, LEAST),
            ("spacing", self.spacing, LEAST),
        ):
            if value is None or least <= value <= MOST:
                continue
            with mistakes:
                raise UsageError(
                    "a quantity is out of range",
                    where=option,
                    expected=f"a number from {least:g} to {MOST:g}",
                    got=value,
                    fix="give it in the units of the data; where it is as large or as "
                    "small in them, give all quantities in other units",
                )

    def _check_counts(self, mistakes: UsageErrorCollector) -> None:
        for option, count, least in (
            ("--input-frames", self.input_frames, 2),
            ("--horizon", self.horizon, 1),
        ):
            if count is None or count >= least:
                continue
            with mistakes:
                raise UsageError(
                    "too few frames for a task",
                    where=option,
                    expected=f"at least {least}",
                    got=count,
                    fix="give more, or leave the option out",
                )
        if self.cells is None or FEWEST_CELLS <= self.cells <= MOST_CELLS:
            return
        with mistakes:
            raise UsageError(
                "no such score grid",
                where="--cells",
                expected=f"{FEWEST_CELLS} to {MOST_CELLS}",
                got=self.cells,
                fix="leave it out: it follows from the spacing of the particles",
            )

    def _check_bounds(self) -> None:
        bounds = self.bounds or ()
        for axis, (low, high) in zip(AXES, bounds, strict=False):
            if not -MOST <= low < high <= MOST:
                raise UsageError(
                    "bounds run from low to high",
                    where="--bounds",
                    expected=f"low < high along each axis, from {-MOST:g} to {MOST:g}",
                    got=f"from {low} to {high} along {axis}",
                    fix=f"give them as in {bounds_example(len(bounds))}",
                )

    def _check_periodic(self) -> None:
        if not self.periodic:
            return
        if self.bounds is None:
            dimension = 3 if "z" in self.periodic else 2
            raise UsageError(
                "a periodic axis needs bounds: they are its period",
                where="--periodic",
                expected="X0,X1,Y0,Y1 of the box, in three dimensions also Z0,Z1",
                got="nothing",
                fix=f"add them, as in {bounds_example(dimension)} for a box of side 1",
            )
        try:
            parse_periodic(self.periodic, len(self.bounds))
        except UsageError as error:
            raise UsageError(
                error.what,
                where="--periodic",
                expected=error.expected,
                got=error.got,
                fix=f"{error.fix}; a box of three axes has three pairs of --bounds",
            ) from None

    def _check_radius(self) -> None:
        """Refuse a radius above half a period: models see the nearest image only."""
        box = self.source_box
        if box is None or box.allows_radius(self.radius):
            return
        most = box.largest_radius
        raise UsageError(
            "the radius is above half of the shortest period",
            where="--radius, or the radius of the metadata",
            expected=f"at most {most:.6g}, half of the period {2.0 * most:.6g}",
            got=self.radius,
            fix="give a smaller --radius: a few spacings of the particles are enough",
        )

    @cached_property
    def box(self) -> Box | None:
        """The box that holds the particles, in the unit box; None where unknown."""
        if self.bounds is None:
            return None
        sides = self.transform.transform_box(self.bounds)
        return Box.from_bounds(sides, parse_periodic(self.periodic, len(sides)))

    @cached_property
    def source_box(self) -> Box | None:
        """The box that holds the particles, in the lengths of the source."""
        if self.bounds is None:
            return None
        periodic = parse_periodic(self.periodic, len(self.bounds))
        return Box.from_bounds(self.bounds, periodic)

    @property
    def rate(self) -> float:
        """Frames per second to 12 digits: 1 / (0.1 / 12 * 12) is 10."""
        return round_digits(1.0 / self.frame_interval, 12)


def estimate_spacing(position: Array, radius: float, box: Box | None = None) -> float:
    """Return the distance of neighbouring particles in one frame.

    It is ``(volume / particles)^(1/d)`` inside the material, by the density that a
    cubic spline kernel measures (Monaghan 1992, Annu. Rev. Astron. Astrophys. 30) with
    a reach of 3 to 6 spacings, in lattices of 1.8 spacings. A box with periodic axes
    has the lengths of the positions. A single particle has the radius as its spacing.

    Args:
        position: particles [length], shape [particle, axis].
        radius: connectivity radius, within which neighbours are expected [length].
        box: the box of the particles; the unit box when None.

    Raises:
        UsageError: three quarters of the particles have no neighbour within three
            radii, or a quarter of them lie on another one.
    """
    count, dimension = position.shape
    if count == 1:
        return radius
    box = box or unit_box(dimension)
    exact = position.astype(np.float64)
    points = box.tree_points(exact)
    samples = points
    if count > MOST_SAMPLES:
        samples = points[np.linspace(0, count - 1, MOST_SAMPLES).astype(int)]
    particles_across = count ** (1.0 / dimension)
    relative_reach = float(
        np.clip(particles_across / REACHES_ACROSS, LEAST_REACH, MOST_REACH)
    )
    # twice the neighbours within the reach, so that the reach may grow
    ball_volume = _volume_of_unit_ball(dimension) * relative_reach**dimension
    neighbours = min(count, math.ceil(2.0 * ball_volume))
    query = box.tree(exact).query(samples, k=neighbours)
    distances = np.asarray(query[0])  # [sample, neighbour]; the first one is itself
    lower_quartile, median, upper_quartile = np.quantile(
        distances[:, 1], (0.25, 0.5, 0.75)
    )
    if lower_quartile == 0.0:
        raise UsageError(
            "particles lie on one another: their spacing cannot be estimated",
            where="the first frame of train",
            expected="most particles at places of their own",
            got="a quarter of the particles at the place of another one, or more",
            fix="leave out copies, or say in a file how far particles are apart: "
            "--describe, key spacing",
        )
    if lower_quartile > NEIGHBOUR_RADII * radius:
        raise UsageError(
            "particles have no neighbours: their spacing cannot be estimated",
            where="--radius",
            expected=f"neighbours within {NEIGHBOUR_RADII:g} radii",
            got=radius,
            fix="a larger --radius, or say in a file how far particles are apart: "
            "--describe, key spacing",
        )

    if upper_quartile - lower_quartile <= LATTICE_SPREAD * median:
        relative_reach = REACH_IN_LATTICE
    spacing = float(median)
    for _ in range(KERNEL_ROUNDS):
        reach = relative_reach * spacing
        weights = _cubic_spline(distances / reach, dimension) / reach**dimension
        # This quantile leaves surfaces out.
        density = float(np.quantile(weights.sum(axis=1), INTERIOR_QUANTILE))
        spacing = density ** (-1.0 / dimension)
    return spacing


def _volume_of_unit_ball(dimension: int) -> float:
    """Return the volume of a ball of radius 1, in two or three dimensions."""
    return math.pi if dimension == 2 else 4.0 / 3.0 * math.pi


def _cubic_spline(distance: Array, dimension: int) -> Array:
    """Return the cubic spline kernel of reach 1, whose integral is 1.

    Args:
        distance: distances over the reach [1].
        dimension: 2 or 3.
    """
    q = 2.0 * distance
    inner = 1.0 - 1.5 * q**2 + 0.75 * q**3
    outer = 0.25 * np.maximum(2.0 - q, 0.0) ** 3
    shape = np.where(q < 1.0, inner, outer)
    norm = 40.0 / (7.0 * math.pi) if dimension == 2 else 8.0 / math.pi
    return np.asarray(norm * shape)


def check_array(name: str, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> None:
    """Refuse what cannot be the positions of a trajectory.

    Raises:
        UnreadableFileError: no floats of three dimensions.
        DataError: not two or three components, too few or too many frames or particles.
    """
    if len(shape) != 3 or dtype.kind != "f":
        fix = "save positions as float32, with the axes in this order"
        if len(shape) == 4 and dtype.kind == "f":
            fix = (
                "save each trajectory in a file of its own, or all of them in one .npy "
                "file of shape (trajectory, frame, particle, 2 or 3)"
            )
        raise UnreadableFileError(
            "these are no positions",
            where=name,
            expected="floats of shape (frame, particle, 2 or 3)",
            got=f"{dtype} of shape {shape}",
            fix=fix,
        )
    frame_count, particle_count, component_count = shape
    if component_count not in DIMENSIONS:
        raise DataError(
            f"positions have {format_count(component_count, 'component')}",
            where=name,
            expected="shape (frame, particle, 2) or (frame, particle, 3)",
            got=f"shape {shape}",
            fix="bring the axes into this order, or state theirs: --describe, key "
            "axes: [frame, space, particle]",
        )
    if frame_count < 2 or particle_count < 1:
        raise DataError(
            "too little for a trajectory",
            where=name,
            expected="2 frames, 1 particle",
            got=shape,
            fix="give all frames of a run in one array",
        )
    for kind, limit, count in (
        ("frames", FRAMES, frame_count),
        ("particles", NEEDED["particles"], particle_count),
    ):
        if not limit.holds(count):
            raise DataError(
                f"too many {kind} for a trajectory",
                where=name,
                expected=limit,
                got=count,
                fix=f"give fewer {kind}",
            )


def describe_file(path: Path) -> str:
    """Return in plain words what a file is, by its first bytes."""
    with path.open("rb") as stream:
        return guess_format(stream.read(FIRST_BYTES))


def describe_archive(path: Path, error: Exception) -> str:
    """Return in plain words why a file is no readable npz archive."""
    if not isinstance(error, zipfile.BadZipFile):
        return f"{type(error).__name__}: {error}"
    with path.open("rb") as stream:
        is_archive = stream.read(len(ARCHIVE)) == ARCHIVE
    if is_archive:
        return f"a zip archive that is cut or damaged ({error})"
    return describe_file(path)


def check_inflation(where: str, *, packed: int, unpacked: int) -> None:
    """Refuse an array that unpacks to far more bytes than its file holds of it."""
    most = max(HARMLESS_BYTES, MOST_INFLATION * packed)
    if unpacked > most:
        raise UnreadableFileError(
            "the file would unpack to far more than it holds",
            where=where,
            expected=f"at most {most} bytes",
            got=f"{unpacked} bytes",
            fix="save it without compression if it is yours; else leave it out",
        )


def check_names(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse an npz file with two arrays of one name, since a reader finds one of them.

    Raises:
        UnreadableFileError: it has such arrays.
    """
    # numpy reads position.npy and position as one array
    names = Counter(name.removesuffix(".npy") for name in archive.namelist())
    repeated_names = []
    for name, count in names.items():
        if count > 1:
            repeated_names.append(name)
    if repeated_names:
        raise UnreadableFileError(
            "an archive holds two arrays of one name",
            where=str(path),
            expected="each name once",
            got=", ".join(map(ascii, repeated_names[:5])),
            fix="write it again with numpy.savez",
        )


def read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, whether the order is Fortran's, and type of a .npy stream."""
    if np.lib.format.read_magic(stream) == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    return np.lib.format.read_array_header_2_0(stream)
