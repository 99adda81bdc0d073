"""The registry: what datasets.yaml says about every split and size.

A split is a family of simulated scenarios, a size one tier of it. Everything that decides
bits (parameters, scenario ids, frame counts) is written by hand; everything that follows
from them (hashes, statistics, twin floor) stands under ``measured`` and is written by
``python -m lagbench.generators.record``.

Scenario ids as text: ``0,3-5`` means 0, 3, 4 and 5.

Splits that other installed packages add, none of which can harm ours.
"""

from __future__ import annotations

import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Hashable, Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from lagbench.errors import LagbenchError, UnreadableFileError, UsageError, loaded, nearest

from .layout import ScenarioKey, dataset_folder, scenario_path
from .limits import check_frames, check_parameters, check_subsets

__all__ = [
    "MAX_ID",
    "parse_ids",
    "spell_ids",
    "GROUP",
    "PluginWarning",
    "added_splits",
    "installed",
    "NO_GENERATOR",
    "Measured",
    "Parameter",
    "Registry",
    "ScoreGrid",
    "Size",
    "Split",
    "Task",
    "default_path",
    "load",
]


MAX_ID = 9999
"""Largest scenario id: file names have four digits."""

_PART = re.compile(r"(\d{1,4})(?:-(\d{1,4}))?")


def parse_ids(text: str | int, *, where: str = "--scenarios", noun: str = "id") -> tuple[int, ...]:
    """Return the scenario ids that a text names, in its order.

    Args:
        text: comma-separated ids and inclusive ranges; an int stands for itself.
        where: option that gave the text, for messages.
        noun: what the numbers are, for messages.

    Raises:
        UsageError: the text is no list of ids, a range runs backwards, or an id stands twice.

    >>> parse_ids("0,3-5")
    (0, 3, 4, 5)
    """

    def bad(got: str) -> UsageError:
        return UsageError(
            f"bad list of {noun}s {text!r}",
            where=where,
            expected=f"{noun}s and ranges from 0 to {MAX_ID}, as in 0,3-5",
            got=got,
        )

    ids: list[int] = []
    for part in str(text).replace(" ", "").split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise bad(f"{part!r} is no {noun} and no range")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise bad(f"{part!r} runs backwards")
        ids.extend(range(first, last + 1))
    if len(set(ids)) != len(ids):
        raise bad("a number stands twice")
    return tuple(ids)


def spell_ids(ids: Iterable[int]) -> str:
    """Return the shortest text that :func:`parse_ids` reads as these ids.

    >>> spell_ids([0, 3, 4, 5])
    '0,3-5'
    """
    runs: list[list[int]] = []
    for i in ids:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


GROUP = "lagbench.generators"
"""Entry points of this group name a split and its module; ours register the same way."""

Found = TypeVar("Found")


class PluginWarning(UserWarning):
    """A package that wants to add a split cannot; all other splits are there."""


def installed(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, of the packages that are installed now.

    Python reads the files of every package at each call. Here they are read again once a folder on the
    path has changed, as it does where a package is installed or removed.
    """
    return _read_points(group, tuple((place, _changed_at(place)) for place in sys.path))


def _changed_at(place: str) -> int | None:
    try:
        return os.stat(place or os.curdir).st_mtime_ns
    except OSError:
        return None


@functools.lru_cache(maxsize=8)
def _read_points(group: str, _: Hashable) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))


def added_splits(own: Mapping[str, str], read: Callable[[Path, str], Found]) -> dict[str, Found]:
    """Return what other packages say about their splits, by name.

    A package that cannot be imported or read, or wants a name that is taken, is left out with
    a :class:`PluginWarning`.
    """
    added: dict[str, Found] = {}
    for point in dict.fromkeys(installed(GROUP)):
        if own.get(point.name) == point.value:
            continue
        try:
            if point.name in own or point.name in added:
                raise UsageError("its name is taken")
            added[point.name] = read(_registry_path(point), point.name)
        except Exception as error:  # a stranger's module: importing it may raise anything
            warnings.warn(_complaint(point, error), PluginWarning, stacklevel=2)
    return added


def _registry_path(point: EntryPoint) -> Path:
    """Return the datasets.yaml that a split's module names as REGISTRY."""
    module = loaded(point)
    if not hasattr(module, "REGISTRY"):
        raise UsageError(
            "its module has no registry", expected="an attribute REGISTRY: the path of its datasets.yaml"
        )
    return Path(module.REGISTRY)


def _complaint(point: EntryPoint, error: Exception) -> str:
    package = point.dist.name if point.dist else point.value.partition(".")[0]
    reason = error if isinstance(error, LagbenchError) else f"{type(error).__name__}: {error}"
    return f"package {package} adds no split {point.name!r} ({point.value}): {reason}"


Number = int | float


def _ids(value: str | int) -> tuple[int, ...]:
    try:
        return parse_ids(value)
    except UsageError as error:
        raise ValueError(f"{error.what}: {error.got}") from None


Ids = Annotated[tuple[int, ...], BeforeValidator(_ids)]
Interval = Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ShortHash = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
SizeName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,63}$")]  # names a folder
REGISTRY_VARIABLE = "LAGBENCH_REGISTRY"
"""Environment variable that names a datasets.yaml to use instead of ours."""

NO_GENERATOR = "none"
"""Generator of splits that were not simulated here; see ``lagbench.data.local``."""

Address = Annotated[str, Field(pattern=r"^https?://[^\s/]\S*$")]


class _Strict(BaseModel):
    """Frozen model that names the nearest known key when it meets an unknown one."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:  # noqa: ANN401
        if isinstance(data, Mapping):
            for key in data:
                if key not in cls.model_fields:
                    message = f"unknown key {key!r}: {nearest(str(key), cls.model_fields)}"
                    raise ValueError(message)
        return data


class Parameter(_Strict):
    """A physical or numerical parameter: value, unit and what it means."""

    value: Number | bool | str | None = None
    unit: str
    description: str


class ScoreGrid(_Strict):
    """Grid on which the scorer forms fields.

    ``cell_centres`` has nodes at (i + 1/2) / cells, ``nodes`` at i / cells.
    """

    cells: int = Field(gt=1)
    placement: Literal["cell_centres", "nodes"]


class Task(_Strict):
    """What a model is given and what it must predict."""

    input_frames: int = Field(gt=1)  # frames given at the start of a test scenario
    horizon: int = Field(gt=0)  # frames to predict after them
    frames_of_interest: tuple[int, ...] = Field(strict=False)  # absolute frames at which the scorer reports
    score_grid: ScoreGrid  # grid of the scorer's fields
    radius: float = Field(gt=0, allow_inf_nan=False)  # connectivity radius for graph models [length]


class Measured(_Strict):
    """What follows from the parameters: hashes, statistics of train, twin floor."""

    dataset_sha256: Hash  # data set hash over train, valid and test
    subset_sha256: dict[str, Hash]  # hash of each subset
    scenario_sha256: dict[int, ShortHash]  # content hash of each scenario, first 16 hex digits
    # mean and standard deviation per component over train
    statistics: dict[str, Annotated[tuple[float, ...], Field(strict=False)]]
    # position RMSE of the perturbed twin per predicted frame, mean over test [length]
    twin_floor: tuple[float, ...] = Field(strict=False)


class _SizeEntry(_Strict):
    """A size as written in datasets.yaml; :class:`Size` adds what the split says."""

    subsets: dict[str, Ids]
    frames: int | dict[int, Ids]
    bounds: tuple[Interval, Interval] = Field(strict=False)
    parameters: dict[str, Number | bool | str]
    task: Task


BYTES_PER_PARTICLE = 2 * 2 * 4
"""Position and velocity in one frame, two float32 each, before compression [bytes]."""

BYTES_BESIDE_FRAMES = 64 * 1024
"""Header, constants and chunk index of a file, generously [bytes]."""

SLACK = 1.25
"""Share by which a compressed file may be longer than its values."""


class Size(BaseModel):
    """One tier of a split with all that is needed to simulate, read and score it.

    ``file`` is the datasets.yaml that describes it.
    """

    model_config = ConfigDict(frozen=True)

    split: str
    name: str
    version: str
    generator: str
    subsets: dict[str, tuple[int, ...]]
    frames: int | dict[int, tuple[int, ...]]
    bounds: tuple[Interval, Interval]
    parameters: dict[str, Parameter]
    task: Task
    measured: Measured | None = None
    file: Path = Path("datasets.yaml")

    @property
    def major(self) -> int:
        """MAJOR of the version: it changes when existing bits change."""
        return int(self.version.split(".")[0])

    @property
    def simulated(self) -> bool:
        """Whether scenarios can be simulated; those of local splits cannot."""
        return self.generator != NO_GENERATOR

    def value(self, name: str) -> Any:  # noqa: ANN401
        """Return a parameter's value."""
        try:
            return self.parameters[name].value
        except KeyError:
            raise UsageError(
                f"no parameter {name!r}",
                where=f"datasets.yaml, {self.split} {self.name}",
                fix=nearest(name, self.parameters),
            ) from None

    @property
    def particles(self) -> int:
        """Particles in one scenario."""
        return int(self.value("particles"))

    @property
    def grid(self) -> int:
        """Solver cells across the unit box."""
        return int(self.value("grid"))

    @property
    def dt(self) -> float:
        """Length of a substep [s]: the frame interval over the substeps of a frame."""
        return self.frame_interval / self.substeps_per_frame

    @property
    def substeps_per_frame(self) -> int:
        """Solver steps from one recorded frame to the next."""
        return int(self.value("substeps_per_frame"))

    @property
    def frame_interval(self) -> float:
        """Time between recorded frames, 1 / frame rate [s]."""
        return 1.0 / float(self.value("frame_rate"))

    @property
    def scenarios(self) -> tuple[int, ...]:
        """All scenario ids of the size, ascending."""
        return tuple(sorted(i for ids in self.subsets.values() for i in ids))

    def subset_of(self, scenario: int) -> str:
        """Return the subset that a scenario belongs to."""
        for subset, ids in self.subsets.items():
            if scenario in ids:
                return subset
        raise UsageError(
            f"no scenario {scenario}",
            where=f"{self.split} {self.name}",
            expected=", ".join(f"{subset} {spell_ids(ids)}" for subset, ids in self.subsets.items()),
        )

    def key(self, scenario: int) -> ScenarioKey:
        """Return what names a scenario."""
        subset = self.subset_of(scenario)
        return ScenarioKey(
            split=self.split, size=self.name, version=self.version, scenario=scenario, subset=subset
        )

    def folder(self, root: Path) -> Path:
        """Return the folder of the data set below a root folder."""
        return dataset_folder(root, self.split, self.name, self.major)

    def path(self, root: Path, scenario: int) -> Path:
        """Return the file of a scenario below a root folder."""
        return scenario_path(root, self.key(scenario))

    def frame_count(self, scenario: int) -> int:
        """Return how many frames a scenario records."""
        if isinstance(self.frames, int):
            return self.frames
        return next(count for count, ids in self.frames.items() if scenario in ids)

    def file_bytes(self, scenario: int) -> int:
        """Return the most bytes that a scenario's file takes, in sum over a data set."""
        return self.frame_count(scenario) * self.particles * BYTES_PER_PARTICLE + BYTES_BESIDE_FRAMES

    def longest_file(self, scenario: int) -> int:
        """Return the bytes beyond which no file of a scenario goes, whatever a store says of it."""
        return round(SLACK * self.file_bytes(scenario)) + (1 << 20)

    def frames_behind(self, scenario: int) -> int:
        """Return how many of a scenario's frames lie behind the horizon of the task."""
        return max(0, self.frame_count(scenario) - self.task.input_frames - self.task.horizon)


class Split(_Strict):
    """A named data set: version, provenance, parameters, sizes, and base URLs of its mirrors."""

    version: str = Field(pattern=r"^[1-9]\d*\.\d+\.\d+$")
    title: str
    description: str
    citation: str
    licence: str
    generator: str
    source: str
    parameters: dict[str, Parameter]
    sizes: dict[SizeName, _SizeEntry]
    mirrors: tuple[Address, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _consistent(self) -> Split:
        for name, size in self.sizes.items():
            check_parameters(name, size.parameters, {n: p.value for n, p in self.parameters.items()})
            check_subsets(name, size.subsets)
            needed = size.task.input_frames + size.task.horizon
            check_frames(name, size.frames, size.subsets, task_frames=needed)
        return self


class Registry:
    """All splits of one datasets.yaml and of the installed packages that add splits."""

    def __init__(
        self,
        splits: Mapping[str, Split],
        measured: Mapping[str, Mapping[str, Measured]],
        files: Mapping[str, Path] | None = None,
    ) -> None:
        self.splits = dict(splits)
        self.measured = measured
        self.files = dict(files or {})

    def split(self, name: str) -> Split:
        """Return a split by name."""
        if name not in self.splits:
            raise UsageError(f"no split {name!r}", where="--split", fix=nearest(name, self.splits))
        return self.splits[name]

    def size(self, split: str, name: str) -> Size:
        """Return one size of a split with its merged parameters and measured values."""
        parent = self.split(split)
        if name not in parent.sizes:
            raise UsageError(
                f"split {split!r} has no size {name!r}", where="--size", fix=nearest(name, parent.sizes)
            )
        entry = parent.sizes[name]
        return Size(
            split=split,
            name=name,
            version=parent.version,
            generator=parent.generator,
            subsets=entry.subsets,
            frames=entry.frames,
            bounds=entry.bounds,
            parameters=_merge(parent.parameters, entry.parameters),
            task=entry.task,
            measured=self.measured.get(split, {}).get(name),
            file=self.files.get(split, Path("datasets.yaml")),
        )


class _File(_Strict):
    """The whole of a datasets.yaml."""

    format: Literal[1]
    splits: dict[str, Split]
    measured: dict[str, dict[str, Measured]] = Field(default_factory=dict)


def default_path() -> Path:
    """Return the registry that ships with lagbench."""
    return Path(__file__).parent.parent / "datasets.yaml"


def load(path: Path | None = None) -> Registry:
    """Return the validated registry, splits of other installed packages included.

    Args:
        path: a datasets.yaml; else the one that ``LAGBENCH_REGISTRY`` names; else ours, with
            the splits that entry points name; a package whose split cannot be read, or has a
            name that is taken, is left out with a :class:`~lagbench.data.registry.PluginWarning`.

    Raises:
        UnreadableFileError: not YAML, an unknown key or a value of the wrong type.
    """
    given = path or os.environ.get(REGISTRY_VARIABLE)
    file = Path(given) if given else default_path()
    return _load(Path(given) if given else None, file.stat().st_mtime_ns if file.exists() else 0)


@functools.cache
def _load(path: Path | None, modified: int) -> Registry:
    """Load a file once per modification time."""
    own = _read(path or default_path())
    splits, measured = dict(own.splits), dict(own.measured)
    files = dict.fromkeys(splits, path or default_path())
    if path is None:
        modules = {name: split.generator for name, split in own.splits.items()}
        for name, (split, hashes, file) in added_splits(modules, _read_split).items():
            splits[name], measured[name], files[name] = split, hashes, file
    return Registry(splits, measured, files)


def _read_split(path: Path, name: str) -> tuple[Split, dict[str, Measured], Path]:
    """Return one split of a datasets.yaml, its measured values and the file."""
    file = _read(path)
    return Registry(file.splits, {}).split(name), file.measured.get(name, {}), path


def _read(path: Path) -> _File:
    """Validate one datasets.yaml; say where and what is wrong with it."""
    from .yamlfile import read_yaml  # a child that validates is told of the sizes, and starts sooner without

    try:
        return _File.model_validate(read_yaml(path))
    except ValidationError as error:
        lines = [_mistake(item["loc"], item["msg"], item["input"]) for item in error.errors()[:10]]
        raise UnreadableFileError(
            f"{error.error_count()} mistake(s) in the registry",
            where=str(path),
            got="\n    ".join(["", *lines]),
            fix="mend the keys named above",
        ) from None


def _mistake(place: tuple[int | str, ...], message: str, given: object) -> str:
    """Return one line: key, what is expected there, and what was got if that is short."""
    if isinstance(given, int) and given.bit_length() > 256:  # Python prints no integer of thousands of digits
        given = f"an integer of {given.bit_length()} bits"
    got = f"; got {given!r}" if isinstance(given, str | int | float) and "; got " not in message else ""
    return f"{'.'.join(map(str, place))}: {message.removeprefix('Value error, ')}{got}"


def _merge(split: Mapping[str, Parameter], size: Mapping[str, Number | bool | str]) -> dict[str, Parameter]:
    """Return the split's parameters with the size's values put in."""
    return {name: p.model_copy(update={"value": size.get(name, p.value)}) for name, p in split.items()}
