"""Data from elsewhere: trajectories, which formats are read into, and what a user says
of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config
from typing_extensions import (
    TypedDict,
)  # pydantic reads that of Python 3.12 and later only

from lagbench.data.checksums import round_digits
from lagbench.data.limits import FRAMES, NEEDED
from lagbench.data.local import is_split_name
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import DataError, UnreadableFileError, UsageError, suggest_name
from lagbench.submission.findings import quoted

from .mistakes import misplaced_axes

Array = NDArray[np.floating]
# positions [length of the source], velocities [its length/s] if any
Frame = tuple[Array, Array | None]
# Frames of a trajectory, what returns the positions of one of them, and the kind of
# each particle.
Run = tuple[int, Callable[[int], NDArray[np.float32]], NDArray[np.int64]]
# low and high walls along x and y
Box = tuple[tuple[float, float], tuple[float, float]]

HARMLESS = 1 << 28  # bytes that may come of anything
MOST_INFLATION = 200  # times its own length that a larger array may unpack to

LEAST = 1e-30
MOST = 1e30  # what a length, a time or a density may be: squares of them are floats
FEWEST_CELLS = 4
MOST_CELLS = 4096  # across of a score grid
WIDE = 3.0  # radii within which neighbours are counted to estimate the spacing


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One trajectory whose frames are read when asked for."""

    name: str  # file and key, for messages
    frames: int  # recorded frames
    # value of ``lagbench.data.MATERIALS`` of each particle, [particle]
    material: NDArray[np.int8]
    read: Callable[[], Iterator[Frame]]  # returns the frames in order, one at a time
    # [length/s], [wall, 2] or [frame, wall, 2]; None without walls
    wall_velocity: Array | None = None
    # facts that the file states and hashes
    parameters: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Measure:
    """How lengths of the source become the unit box's, ``(x - corner) / scale``: powers
    of 2 lose no bit.
    """

    scale: float = 1.0
    corner: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def fitting(cls, bounds: Box) -> Measure:
        """Return the measure of the least scale by which a box fits, the corner 0 where
        that is enough.
        """
        low, high = np.array(bounds, dtype=np.float64).T
        corner = low
        if (low >= 0.0).all() and (high <= _power(float(high.max()))).all():
            corner = np.zeros(2)
        return cls(
            scale=_power(float((high - corner).max())),
            corner=(float(corner[0]), float(corner[1])),
        )

    def place(self, position: Array) -> NDArray[np.float32]:
        """Return positions in the unit box, float32."""
        if self.scale != 1.0 or any(self.corner):
            position = (position.astype(np.float64) - self.corner) / self.scale
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            return position.astype(np.float32, copy=False)

    def box(self, bounds: Box) -> Box:
        """Return a box of the source in the unit box."""
        (left, right), (bottom, top) = (
            tuple((value - corner) / self.scale for value in pair)
            for pair, corner in zip(bounds, self.corner, strict=True)
        )
        return (left, right), (bottom, top)


def _power(length: float) -> float:
    """Return the least power of two that is not below a length, at least 1."""
    if length > 1.0:
        return 2.0 ** max(0, math.ceil(math.log2(length)))
    return 1.0


# one that a message can spell out
Count = Annotated[int, Field(gt=-(1 << 31), lt=1 << 31)]


@with_config(ConfigDict(extra="forbid"))
class Wishes(TypedDict, total=False):
    """What a user may say of data from elsewhere; see :class:`Description`."""

    title: str
    text: str
    citation: str
    licence: str
    radius: float
    frame_interval: float
    bounds: Box
    rescale: bool
    density: float
    spacing: float
    input_frames: Count
    horizon: Count
    frames_of_interest: Sequence[Count]
    cells: Count
    full_box: bool


def read_wishes(path: Path) -> Wishes:
    """Return what a YAML file says of the data."""
    return _checked(read_yaml(path), where=f"{path}, key ")


def check_wishes(wishes: Wishes) -> Wishes:
    """Return what a caller says of the data as plain values, NumPy's converted; None
    says nothing.
    """
    said = {name: value for name, value in wishes.items() if value is not None}
    plain = {
        n: v.tolist() if isinstance(v, np.ndarray | np.generic) else v
        for n, v in said.items()
    }
    return _checked(plain, where="")


def _checked(given: object, *, where: str) -> Wishes:
    try:
        return TypeAdapter(Wishes).validate_python(given)
    except ValidationError as error:
        first = error.errors()[0]
        value = first["input"]
        key = quoted(".".join(map(str, first["loc"])))[1:-1]
        strange = first["type"] == "extra_forbidden"
        raise UsageError(
            "this does not describe data",
            where=f"{where}{key or '(whole file)'}",
            expected=first["msg"],
            got=quoted(value)
            if isinstance(value, str | int | float)
            else f"a {type(value).__name__}",
            fix=suggest_name(key, Wishes.__annotations__)
            if strange
            else "docs/exchange.md has the keys",
        ) from None


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
    bounds: Box | None = None
    rescale: bool = False  # whether to fit the bounds into the unit box
    density: float = 1.0  # rest density [mass/length^2]
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
    measure: Measure = field(init=False, default=Measure())

    def __post_init__(self) -> None:
        """Check what the user gave."""
        if not is_split_name(self.name):
            proposal = (
                re.sub(r"[^a-z0-9_-]+", "-", self.name.lower()).strip("-_0123456789")
                or "own"
            )
            raise UsageError(
                "a split cannot have that name",
                where="--output, its last part",
                expected="small letters, digits, - and _, a letter first",
                got=self.name,
                fix=f"--output {proposal}",
            )
        positive = {
            "--radius": self.radius,
            "--frame-interval": self.frame_interval,
            "density": self.density,
            "spacing": 1.0 if self.spacing is None else self.spacing,
        }
        for option, value in positive.items():
            if not (LEAST <= value <= MOST):
                raise UsageError(
                    "not a number above 0 that computes", where=option, got=value
                )
        counts = (
            ("--input-frames", self.input_frames, 2),
            ("--horizon", self.horizon, 1),
        )
        for option, count, least in counts:
            if count is not None and count < least:
                expected = f"at least {least}"
                raise UsageError(
                    "too few frames for a task",
                    where=option,
                    expected=expected,
                    got=count,
                )
        if self.bounds is not None and any(
            not -MOST <= low < high <= MOST for low, high in self.bounds
        ):
            raise UsageError(
                "bounds run from low to high", where="--bounds", got=self.bounds
            )
        if self.cells is not None and not FEWEST_CELLS <= self.cells <= MOST_CELLS:
            expected = f"{FEWEST_CELLS} to {MOST_CELLS}"
            raise UsageError(
                "no such score grid", where="--cells", expected=expected, got=self.cells
            )
        if self.rescale:
            if self.bounds is None:
                raise UsageError(
                    "what is to fit the unit box?",
                    where="--rescale",
                    fix="add --bounds",
                )
            object.__setattr__(self, "measure", Measure.fitting(self.bounds))

    @property
    def rate(self) -> float:
        """Frames per second to 12 digits: 1 / (0.1 / 12 * 12) is 10."""
        return round_digits(1.0 / self.frame_interval, 12)


def estimate_spacing(position: Array, radius: float) -> float:
    """Return the distance of neighbouring particles in one frame,
    ``sqrt(area / particles)``.
    """
    from scipy.spatial import cKDTree

    points = position.astype(np.float64)
    reach = WIDE * radius
    counts = cKDTree(points).query_ball_point(points, reach, return_length=True)
    # deep inside the material: this leaves surfaces out
    inside = float(np.quantile(counts, 0.75))
    if inside < 2.0 and len(points) > 1:  # a particle counts itself
        raise UsageError(
            "particles have no neighbours: their spacing cannot be estimated",
            where="--radius",
            expected=f"neighbours within {WIDE:g} radii",
            got=radius,
            fix="a larger --radius, or say in a file how far particles are apart: "
            "--describe, key spacing",
        )
    return math.sqrt(math.pi * reach**2 / inside)


def check_array(name: str, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> None:
    """Refuse positions that are no floats of two components, or of more particles than
    a split may have.
    """
    if len(shape) != 3 or dtype.kind != "f":
        raise UnreadableFileError(
            "these are no positions",
            where=name,
            expected="floats of shape (frame, particle, 2)",
            got=f"{dtype} of shape {shape}",
        )
    if shape[2] != 2:
        turned = misplaced_axes(shape)
        raise DataError(
            turned.what if turned else f"positions have {shape[2]} components",
            where=name,
            expected="2: lagbench holds plane data only",
            got=f"shape {shape}",
            fix=turned.fix if turned else None,
        )
    if shape[0] < 2 or shape[1] < 1:
        raise DataError(
            "too little for a trajectory",
            where=name,
            expected="2 frames, 1 particle",
            got=shape,
        )
    for what, limit, count in (
        ("frames", FRAMES, shape[0]),
        ("particles", NEEDED["particles"], shape[1]),
    ):
        if not limit.holds(count):
            raise DataError(
                f"too many {what} for a trajectory",
                where=name,
                expected=limit,
                got=count,
            )


def check_inflation(where: str, *, packed: int, unpacked: int) -> None:
    """Refuse an array [bytes] that is far larger than what a file holds of it."""
    # Particles that move compress by two or so, at rest by a hundred: more was made to
    # fill the memory.
    if unpacked > max(HARMLESS, MOST_INFLATION * packed):
        raise UnreadableFileError(
            "the file would unpack to far more than it holds",
            where=where,
            expected=f"at most {MOST_INFLATION} times {packed} bytes",
            got=f"{unpacked} bytes",
        )


def read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, whether the order is Fortran's, and type of a .npy stream."""
    first = np.lib.format.read_magic(stream) == (1, 0)
    if first:
        read = np.lib.format.read_array_header_1_0
    else:
        read = np.lib.format.read_array_header_2_0
    return read(stream)
