"""The registry: what datasets.yaml says about every split and size.

A split is a family of simulated scenarios, a size one tier of it. Everything that
decides bits (parameters, scenario ids, frame counts) is written by hand; everything
that follows from them (hashes, statistics, twin floor) stands under ``measured`` and is
written by ``python -m lagbench.generators.record``.

Splits that other installed packages add, none of which can harm ours.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Hashable, Mapping
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    loaded,
    nearest,
)

from .layout import ScenarioKey, dataset_folder, major_of, scenario_path
from .limits import MAX_ID as MAX_ID
from .limits import Value, check_frames, check_parameters, check_subsets
from .limits import parse_ids as parse_ids
from .limits import spell_ids as spell_ids

GROUP = "lagbench.generators"
"""Entry points of this group name a split and its module; ours register the same way.
"""


class PluginWarning(UserWarning):
    """A package that wants to add a split cannot; all other splits are there."""


def installed(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, of the packages that are installed now.

    Python reads the files of every package at each call. Here they are read again once
    a folder on the path has changed, as it does where a package is installed or
    removed.
    """
    changed = []
    for place in sys.path:
        with suppress(OSError):
            changed.append((place, os.stat(place or os.curdir).st_mtime_ns))
    return _read_points(group, tuple(changed))


@functools.lru_cache(maxsize=8)
def _read_points(group: str, _: Hashable) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))


def _ids(value: str | int) -> tuple[int, ...]:
    try:
        return parse_ids(value)
    except UsageError as error:
        raise ValueError(f"{error.what}: {error.got}") from None


Ids = Annotated[tuple[int, ...], BeforeValidator(_ids)]
Interval = Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
REGISTRY_VARIABLE = "LAGBENCH_REGISTRY"
"""Environment variable that names a datasets.yaml to use instead of ours."""

NO_GENERATOR = "none"
"""Generator of splits that were not simulated here; see ``lagbench.data.local``."""


class _Strict(BaseModel):
    """Frozen model that names the nearest known key when it meets an unknown one."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:  # noqa: ANN401
        for key in data if isinstance(data, Mapping) else ():
            if key not in cls.model_fields:
                raise ValueError(
                    f"unknown key {key!r}: {nearest(str(key), cls.model_fields)}"
                )
        return data


class Parameter(_Strict):
    """A physical or numerical parameter: value, unit and what it means."""

    value: Value | None = None
    unit: str
    description: str


class ScoreGrid(_Strict):
    """Grid on which the scorer forms fields."""

    cells: int = Field(gt=1)
    # nodes at (i + 1/2) / cells, or at i / cells
    placement: Literal["cell_centres", "nodes"]


class Task(_Strict):
    """What a model is given and what it must predict."""

    input_frames: int = Field(gt=1)  # frames given at the start of a test scenario
    horizon: int = Field(gt=0)  # frames to predict after them
    # absolute frames at which the scorer reports
    frames_of_interest: tuple[int, ...] = Field(strict=False)
    score_grid: ScoreGrid  # grid of the scorer's fields
    # connectivity radius for graph models [length]
    radius: float = Field(gt=0, allow_inf_nan=False)
    # kinematic viscosity that models are told where scenarios state none [length^2/s]
    effective_viscosity: float | None = Field(None, gt=0, allow_inf_nan=False)


class Measured(_Strict):
    """What follows from the parameters: hashes, statistics of train, twin floor."""

    dataset_sha256: Hash  # data set hash over train, valid and test
    subset_sha256: dict[str, Hash]  # hash of each subset
    # content hash of each scenario, first 16 hex digits
    scenario_sha256: dict[int, Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]]
    # mean and standard deviation per component over train
    statistics: dict[str, Annotated[tuple[float, ...], Field(strict=False)]]
    # position RMSE of the perturbed twin per predicted frame, mean over test [length]
    twin_floor: tuple[float, ...] = Field(strict=False)


class _SizeEntry(_Strict):
    """A size as written in datasets.yaml; :class:`Size` adds what the split says."""

    subsets: dict[str, Ids]
    frames: int | dict[int, Ids]
    bounds: tuple[Interval, Interval] = Field(strict=False)
    parameters: dict[str, Value]
    task: Task


class Size(BaseModel):
    """One tier of a split with all that is needed to simulate, read and score it."""

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
    file: Path = Path("datasets.yaml")  # what describes it

    @property
    def major(self) -> int:
        """MAJOR of the version: it changes when existing bits change."""
        return major_of(self.version)

    @property
    def simulated(self) -> bool:
        """Whether scenarios can be simulated; those of local splits cannot."""
        return self.generator != NO_GENERATOR

    def value(self, name: str) -> Any:  # noqa: ANN401
        """Return a parameter's value."""
        if name not in self.parameters:
            where = f"datasets.yaml, {self.split} {self.name}"
            raise UsageError(
                f"no parameter {name!r}",
                where=where,
                fix=nearest(name, self.parameters),
            )
        return self.parameters[name].value

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
        expected = ", ".join(
            f"{subset} {spell_ids(ids)}" for subset, ids in self.subsets.items()
        )
        raise UsageError(
            f"no scenario {scenario}",
            where=f"{self.split} {self.name}",
            expected=expected,
        )

    def key(self, scenario: int) -> ScenarioKey:
        """Return what names a scenario."""
        names = {"split": self.split, "size": self.name, "version": self.version}
        return ScenarioKey(**names, scenario=scenario, subset=self.subset_of(scenario))

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
        """Return the most bytes that a scenario's file takes, in sum over a data
        set.
        """
        # Position and velocity are two float32 each; header, constants and chunk index
        # take 64 KiB at most.
        return self.frame_count(scenario) * self.particles * 16 + 64 * 1024

    def longest_file(self, scenario: int) -> int:
        """Return the bytes beyond which no file of a scenario goes, whatever a store
        says of it.
        """
        # What zlib cannot pack becomes longer.
        return round(1.25 * self.file_bytes(scenario)) + (1 << 20)

    def frames_behind(self, scenario: int) -> int:
        """Return how many of a scenario's frames lie behind the horizon of the task."""
        return max(
            0, self.frame_count(scenario) - self.task.input_frames - self.task.horizon
        )


class Split(_Strict):
    """A named data set: version, provenance, parameters, sizes, and base URLs of its
    mirrors.
    """

    version: str = Field(pattern=r"^[1-9]\d*\.\d+\.\d+$")
    title: str
    description: str
    citation: str
    licence: str
    generator: str
    source: str
    parameters: dict[str, Parameter]
    # a size's name is that of a folder
    sizes: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,63}$")], _SizeEntry]
    mirrors: tuple[Annotated[str, Field(pattern=r"^https?://[^\s/]\S*$")], ...] = Field(
        (), strict=False
    )

    @model_validator(mode="after")
    def _consistent(self) -> Split:
        for name, size in self.sizes.items():
            check_parameters(
                name, size.parameters, {n: p.value for n, p in self.parameters.items()}
            )
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
            raise UsageError(
                f"no split {name!r}", where="--split", fix=nearest(name, self.splits)
            )
        return self.splits[name]

    def size(self, split: str, name: str) -> Size:
        """Return one size of a split with its merged parameters and measured values."""
        parent = self.split(split)
        if name not in parent.sizes:
            fix = nearest(name, parent.sizes)
            raise UsageError(
                f"split {split!r} has no size {name!r}", where="--size", fix=fix
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
            parameters={
                key: p.model_copy(update={"value": entry.parameters.get(key, p.value)})
                for key, p in parent.parameters.items()
            },
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
        path: a datasets.yaml; else the one that ``LAGBENCH_REGISTRY`` names; else ours,
            with the splits that entry points name; a package whose split cannot be
            read, or has a name that is taken, is left out with a
            :class:`~lagbench.data.registry.PluginWarning`.

    Raises:
        UnreadableFileError: not YAML, an unknown key or a value of the wrong type.
    """
    given = path or os.environ.get(REGISTRY_VARIABLE)
    if given:
        file = Path(given)
    else:
        file = default_path()
    return _load(
        Path(given) if given else None, file.stat().st_mtime_ns if file.exists() else 0
    )


@functools.cache
def _load(path: Path | None, modified: int) -> Registry:
    """Load a file once per modification time."""
    own = _read(path or default_path())
    splits = dict(own.splits)
    measured = dict(own.measured)
    files = dict.fromkeys(splits, path or default_path())
    for point in dict.fromkeys(installed(GROUP)) if path is None else ():
        name = point.name
        if name in own.splits and own.splits[name].generator == point.value:
            continue
        try:
            if name in splits:
                raise UsageError("its name is taken")
            module = loaded(point)
            if not hasattr(module, "REGISTRY"):
                expected = "an attribute REGISTRY: the path of its datasets.yaml"
                raise UsageError("its module has no registry", expected=expected)
            place = Path(module.REGISTRY)
            theirs = _read(place)
            splits[name] = Registry(theirs.splits, {}).split(name)
            measured[name] = theirs.measured.get(name, {})
            files[name] = place
        except (
            Exception
        ) as error:  # a stranger's module: importing it may raise anything
            if point.dist:
                package = point.dist.name
            else:
                package = point.value.partition(".")[0]
            reason = (
                error
                if isinstance(error, LagbenchError)
                else f"{type(error).__name__}: {error}"
            )
            message = (
                f"package {package} adds no split {name!r} ({point.value}): {reason}"
            )
            warnings.warn(message, PluginWarning, stacklevel=2)
    return Registry(splits, measured, files)


def _read(path: Path) -> _File:
    """Validate one datasets.yaml; say where and what is wrong with it."""
    from .yamlfile import (
        read_yaml,
    )  # a child that validates is told of the sizes, and starts sooner without

    try:
        return _File.model_validate(read_yaml(path))
    except ValidationError as error:
        # for each mistake: key, what is expected there, and what was got if that is
        # short
        lines = [""]
        for item in error.errors()[:10]:
            given = item["input"]
            message = item["msg"].removeprefix("Value error, ")
            if (
                isinstance(given, int) and given.bit_length() > 256
            ):  # Python prints no thousands of digits
                given = f"an integer of {given.bit_length()} bits"
            short = isinstance(given, str | int | float) and "; got " not in message
            lines.append(
                f"{'.'.join(map(str, item['loc']))}: "
                f"{message}{f'; got {given!r}' if short else ''}"
            )
        what = f"{error.error_count()} mistake(s) in the registry"
        fix = "mend the keys named above"
        raise UnreadableFileError(
            what, where=str(path), got="\n    ".join(lines), fix=fix
        ) from None
