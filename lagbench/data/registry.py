"""The registry: every split and size of datasets.yaml and of installed packages.

A split is a family of simulated scenarios, a size one tier of it. Everything that
decides bits (parameters, scenario ids, frame counts) is written by hand. Everything
that follows from them (hashes, statistics, predictability limit) stands under
``measured`` and is written by ``python -m lagbench.generators.record``.

Other packages may add splits. None of them can harm ours.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Collection, Mapping
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
    SPLIT_NAMED,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    describe_exception,
    suggest_name,
)

from .box import Box, parse_periodic
from .checksums import HASHED_SUBSETS, dataset_hash
from .field_errors import describe_faults
from .grid import MOST_NODES, Grid, Placement, most_cells
from .layout import (
    ScenarioKey,
    dataset_folder,
    format_ids,
    major_of,
    parse_ids,
    scenario_path,
)
from .limits import (
    SCORED_SUBSETS,
    SUBSETS,
    Value,
    check_frames,
    check_parameters,
    check_particle_counts,
    check_subsets,
)

GROUP = "lagbench.generators"
"""Entry points that name a split and its module; ours register the same way."""


class PluginWarning(UserWarning):
    """A package cannot add its split, baseline or metric; all others are there."""


def package_of(point: EntryPoint) -> str:
    """Return the name of the package that an entry point belongs to."""
    if point.dist:
        return point.dist.name
    module = point.value.partition(":")[0]
    return module.partition(".")[0]


def suggest_split(name: str, known_names: Collection[str]) -> str:
    """Return a hint for the name of a split that is not there."""
    if name in SUBSETS:
        return f"that is a subset: name the split first, then subset={name!r}"
    return suggest_name(name, known_names)


@functools.cache
def list_entry_points(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, of the packages that are installed."""
    return tuple(entry_points(group=group))


def _parse_ids(value: str | int) -> tuple[int, ...]:
    try:
        return parse_ids(value)
    except UsageError as error:
        raise ValueError(error.text) from None


Ids = Annotated[tuple[int, ...], BeforeValidator(_parse_ids)]
Interval = Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Version = Annotated[str, Field(pattern=r"^[1-9]\d*\.\d+\.\d+$")]
REGISTRY_VARIABLE = "LAGBENCH_REGISTRY"
"""Environment variable that names a datasets.yaml to use instead of ours."""

CARD_BYTES = 800_000
"""Bytes that manifest, card and pictures of a data set have at most."""

CARD_ROW_BYTES = 20_000
"""Bytes by which they grow with a scenario, at most."""

HEADER_BYTES = 64 * 1024
"""The most bytes of a file's header, constants and index of chunks."""

NO_GENERATOR = "none"
"""Generator of splits that were not simulated here; see ``lagbench.data.local``."""


class _RegistryModel(BaseModel):
    """Frozen model that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Parameter(_RegistryModel):
    """A physical or numerical parameter: value, unit and what it means."""

    value: Value | None = None
    unit: str
    description: str
    # the only subset whose scenarios it concerns and whose files state it; all by
    # default
    subset: str | None = None
    optional: bool = False  # whether a size may do without a value


class ScoreGrid(_RegistryModel):
    """Grid on which the scorer forms fields."""

    cells: int = Field(gt=1)
    # nodes at (i + 1/2) / cells, or at i / cells
    placement: Literal["cell_centres", "nodes"]


class Task(_RegistryModel):
    """Given frames of a model, and frames that it must predict."""

    input_frames: int = Field(gt=1)  # frames given at the start of a test scenario
    horizon: int = Field(gt=0)  # frames to predict after them
    # absolute frames at which the scorer reports
    frames_of_interest: tuple[int, ...] = Field(strict=False, min_length=1)
    score_grid: ScoreGrid  # grid of the scorer's fields
    # connectivity radius for graph models [length]
    radius: float = Field(gt=0, allow_inf_nan=False)
    # kinematic viscosity that is given where scenarios state none [length^2/s]
    effective_viscosity: float | None = Field(None, gt=0, allow_inf_nan=False)


class Measured(_RegistryModel):
    """Hashes, statistics of train, predictability limit: results of the parameters."""

    dataset_sha256: Hash  # data set hash over train, valid and test
    subset_sha256: dict[str, Hash]  # hash of each subset
    # content hash of each scenario, first 16 hex digits
    scenario_sha256: dict[int, Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]]
    # mean and standard deviation per component over train
    statistics: dict[str, Annotated[tuple[float, ...], Field(strict=False)]]
    # position RMSE of a slightly perturbed run per predicted frame, mean over test
    # [length]
    twin_floor: tuple[float, ...] = Field(strict=False)
    # ranking metric between the truth and a run with twice its refinement, mean over
    # three scenarios of test
    truth_error: float | None = None


LARGEST_END = 1e6  # greatest distance of an end of a box from 0 [length]
SHORTEST_SIDE = 1e-6  # of a box, which is about the unit box [length]


class _SizeEntry(_RegistryModel):
    """A size as written in datasets.yaml; :class:`Size` adds the split's fields."""

    subsets: dict[str, Ids]
    frames: int | dict[int, Ids]
    # ends of the box along x, y and, in three dimensions, z [length]
    bounds: tuple[Interval, ...] = Field(strict=False, min_length=2, max_length=3)
    periodic: tuple[str, ...] = Field((), strict=False)  # axes without walls, by name
    # ids of the scenarios by their number of particles, where it differs
    particle_counts: dict[int, Ids] = Field(default_factory=dict)
    parameters: dict[str, Value]
    task: Task
    # seed of a blind test; without it the draws follow from the names
    draw_seed: Hash | None = None
    # cells of the run that made the files, along each axis, per cell of ``grid``
    refinement: int = Field(1, ge=1, le=16)
    # version of this size where its bits are older than those of the split
    version: Version | None = None

    @model_validator(mode="after")
    def _check_box(self) -> _SizeEntry:
        ends = [abs(end) for side in self.bounds for end in side]
        if max(ends) > LARGEST_END:
            raise ValueError(
                f"bounds: expected ends within {LARGEST_END:g} of 0, got {self.bounds}"
            )
        try:
            periodic = parse_periodic(self.periodic, len(self.bounds))
            box = Box.from_bounds(self.bounds, periodic)
        except UsageError as error:
            text = error.text
            raise ValueError(text) from None
        if box.lengths.min() < SHORTEST_SIDE:
            raise ValueError(
                f"bounds: expected sides of at least {SHORTEST_SIDE:g}, got "
                f"{self.bounds}"
            )

        cells = self.task.score_grid.cells
        most = most_cells(box)
        if cells > most:
            raise ValueError(
                f"task.score_grid.cells: expected at most {most}, which gives at most "
                f"{MOST_NODES} nodes in this box, got {cells}"
            )
        if not box.allows_radius(self.task.radius):
            raise ValueError(
                f"task.radius: expected at most half of each period, "
                f"{box.largest_radius:g}, got {self.task.radius:g}"
            )
        return self


class Size(BaseModel):
    """One tier of a split with all that is needed to simulate, read and score it."""

    model_config = ConfigDict(frozen=True)

    split: str
    name: str
    version: str
    generator: str
    subsets: dict[str, tuple[int, ...]]
    frames: int | dict[int, tuple[int, ...]]
    bounds: tuple[Interval, ...]  # of x, y and, in three dimensions, z [length]
    periodic: tuple[str, ...] = ()  # names of the axes that have no walls
    # ids of the scenarios by their number of particles; empty where all have as many
    particle_counts: dict[int, tuple[int, ...]] = {}
    parameters: dict[str, Parameter]
    task: Task
    measured: Measured | None = None
    file: Path = Path("datasets.yaml")  # the file that describes it
    package_file: bool = False  # whether that file belongs to another package
    scored_subset: str = "test"  # subset that is predicted and scored
    # seed of a blind test [64 hex digits]; without it draws follow from the names of
    # split, size, version and scenario
    draw_seed: str | None = None
    # cells of the run that made the files, along each axis, per cell of ``grid``
    refinement: int = 1
    # the same of this description itself: 1, but for the size on which the solver runs
    subdivision: int = 1

    @property
    def scored_scenarios(self) -> tuple[int, ...]:
        """Ids of the scenarios that are predicted and scored."""
        return self.subsets[self.scored_subset]

    def scored_on(self, subset: str) -> Size:
        """Return the same size with another subset to predict and to score.

        Raises:
            UsageError: the size has no such subset, or it is not one to be scored.
        """
        choices = [name for name in SCORED_SUBSETS if name in self.subsets]
        if subset not in choices:
            raise UsageError(
                f"no scored subset {subset!r}: expected {' or '.join(choices)}; "
                f"{suggest_name(subset, choices)}; `lagbench info {self.split}` shows "
                "the subsets of each size",
                where=f"{self.split} {self.name}",
            )
        return self.model_copy(update={"scored_subset": subset})

    @property
    def major(self) -> int:
        """MAJOR of the version: it changes when existing bits change."""
        return major_of(self.version)

    @property
    def simulated(self) -> bool:
        """Whether scenarios can be simulated; those of local splits cannot."""
        return self.generator != NO_GENERATOR

    @property
    def box(self) -> Box:
        """The box that holds the particles."""
        periodic = parse_periodic(self.periodic, len(self.bounds))
        return Box.from_bounds(self.bounds, periodic)

    @property
    def is_full_box(self) -> bool:
        """Whether one fluid fills the box; else the material has a free surface."""
        return Placement(self.task.score_grid.placement).is_full_box

    @property
    def record_name(self) -> str:
        """Name of the file that describes the size and records its hashes.

        It is datasets.yaml of lagbench, a file in the folder of another package, the
        description of a local split.
        """
        if self.package_file:
            return f"{self.file.parent.name}/{self.file.name}"
        return self.file.name

    @property
    def field_grid(self) -> Grid:
        """Grid of the scorer's fields."""
        score_grid = self.task.score_grid
        return Grid(score_grid.cells, Placement(score_grid.placement), self.box)

    def value(self, name: str) -> Any:  # noqa: ANN401
        """Return a parameter's value."""
        if name not in self.parameters:
            raise UsageError(
                f"no parameter {name!r}; {suggest_name(name, self.parameters)}",
                where=f"{self.record_name}, {self.split} {self.name}",
            )
        return self.parameters[name].value

    @property
    def has_fringe(self) -> bool:
        """Whether a fringe draws the fluid to a stream: a rate of 0 stands for none."""
        if "fringe_rate" not in self.parameters:
            return False
        return bool(self.value("fringe_rate"))

    def viscosity(self, stated: float | None = None) -> float | None:
        """Return the kinematic viscosity that a model is given [length^2/s].

        It is the scenario's own; else the effective one of the data set; else that of
        its liquid. None where none is known.

        Args:
            stated: viscosity in the scenario's file [length^2/s]; None where it has
                none.
        """
        if stated is not None:
            return stated
        if self.task.effective_viscosity is not None:
            return self.task.effective_viscosity
        liquid_viscosity = self.parameters.get("liquid_viscosity")
        if liquid_viscosity is None or liquid_viscosity.value is None:
            return None
        return float(liquid_viscosity.value)

    @property
    def dimension(self) -> int:
        """Number of axes of the box: 2 or 3."""
        return len(self.bounds)

    @property
    def particles(self) -> int:
        """Particles in one scenario; the most of any where scenarios differ."""
        return int(self.value("particles"))

    def particle_count(self, scenario: int) -> int:
        """Return how many particles a scenario has."""
        for count, ids in self.particle_counts.items():
            if scenario in ids:
                return count
        return self.particles

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
        scenarios: list[int] = []
        for ids in self.subsets.values():
            scenarios += ids
        return tuple(sorted(scenarios))

    def subset_of(self, scenario: int) -> str:
        """Return the subset that a scenario belongs to.

        Raises:
            UsageError: no subset has the scenario.
        """
        texts = []
        for subset, ids in self.subsets.items():
            if scenario in ids:
                return subset
            texts.append(f"{subset} {format_ids(ids)}")
        raise UsageError(
            f"no scenario {scenario}: expected {', '.join(texts)}; name one of these; "
            "`lagbench info` lists those of other sizes",
            where=f"{self.split} {self.name}",
        )

    def key(self, scenario: int) -> ScenarioKey:
        """Return the names of a scenario."""
        return ScenarioKey(
            split=self.split,
            size=self.name,
            version=self.version,
            scenario=scenario,
            subset=self.subset_of(scenario),
        )

    def folder(self, root: Path) -> Path:
        """Return the folder of the data set below a root folder."""
        return dataset_folder(root, self.split, self.name, self.major)

    def path(self, root: Path, scenario: int) -> Path:
        """Return the file of a scenario below a root folder."""
        return scenario_path(root, self.key(scenario))

    def registered_hash(self, scenario: int) -> str:
        """Return the content hash in datasets.yaml or its first digits, or nothing."""
        if self.measured is None:
            return ""
        return self.measured.scenario_sha256.get(scenario, "")

    def frame_count(self, scenario: int) -> int:
        """Return how many frames a scenario records."""
        if isinstance(self.frames, int):
            return self.frames
        for count, ids in self.frames.items():
            if scenario in ids:
                return count
        raise UsageError(
            f"no scenario {scenario}: expected an id among "
            f"{format_ids(self.scenarios)}; name one of these; `lagbench info "
            f"{self.split}` shows their subsets",
            where=f"{self.split} {self.name}, frames",
        )

    @property
    def truth_error(self) -> float | None:
        """How far the truth is from a run twice as fine, in the metric that ranks."""
        if self.measured is None:
            return None
        return self.measured.truth_error

    @property
    def stores_velocity(self) -> bool:
        """Whether generated files hold the solver's velocities.

        Those in three dimensions do not: velocities would be half of the bytes.
        """
        return self.dimension == 2

    def file_bytes(self, scenario: int) -> int:
        """Return the most bytes of a scenario's file, on average over a data set.

        Files of local splits may hold velocities.
        """
        moving_variables = 1
        if self.stores_velocity or not self.simulated:
            moving_variables = 2
        return self._value_bytes(scenario, moving_variables) + HEADER_BYTES

    def data_set_bytes(self, scenarios: Collection[int]) -> int:
        """Return the most bytes of some scenarios' files, card and pictures with them.

        Pictures and texts grow with the number of scenarios.
        """
        card_bytes = CARD_BYTES + CARD_ROW_BYTES * len(scenarios)
        return card_bytes + sum(map(self.file_bytes, scenarios))

    def longest_file(self, scenario: int) -> int:
        """Return the most bytes of a scenario's file; a store may claim more.

        It may hold velocities whether or not the generator stores them.
        """
        file_bytes = self._value_bytes(scenario, moving_variables=2) + HEADER_BYTES
        # zlib makes values longer that it cannot pack.
        return round(1.25 * file_bytes) + (1 << 20)

    def _value_bytes(self, scenario: int, moving_variables: int) -> int:
        """Return the bytes of so many float32 vectors of each particle and frame."""
        vectors = self.frame_count(scenario) * self.particle_count(scenario)
        return moving_variables * vectors * 4 * self.dimension

    def frames_after_horizon(self, scenario: int) -> int:
        """Return how many of a scenario's frames come after the horizon of the task."""
        task_frames = self.task.input_frames + self.task.horizon
        return max(0, self.frame_count(scenario) - task_frames)


class Split(_RegistryModel):
    """A named data set: version, provenance, parameters, sizes and mirrors' URLs."""

    version: Version
    title: str
    description: str
    citation: str
    licence: str
    generator: str
    source: str
    parameters: dict[str, Parameter]
    # a size's name is that of a folder
    sizes: dict[
        Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,63}$")], _SizeEntry
    ] = Field(min_length=1)
    mirrors: tuple[Annotated[str, Field(pattern=r"^https?://[^\s/]\S*$")], ...] = Field(
        (), strict=False
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Split:
        declared = {name: entry.value for name, entry in self.parameters.items()}
        for name, size in self.sizes.items():
            given = dict(declared)
            for key, parameter in self.parameters.items():
                if parameter.optional and key not in size.parameters:
                    del given[key]
            check_parameters(name, size.parameters, given)
            check_subsets(name, size.subsets, needed=HASHED_SUBSETS)
            task_frames = size.task.input_frames + size.task.horizon
            check_frames(name, size.frames, size.subsets, task_frames=task_frames)
            particles = size.parameters.get("particles", declared.get("particles"))
            check_particle_counts(name, size.particle_counts, size.subsets, particles)
        return self


MOST_OLDER_VERSIONS = 100
"""Most older MAJOR versions whose hashes are recognised."""


class Registry:
    """All splits of one datasets.yaml and of the installed packages that add splits."""

    def __init__(
        self,
        splits: Mapping[str, Split],
        measured: Mapping[str, Mapping[str, Measured]],
        files: Mapping[str, Path] | None = None,
        package_splits: Collection[str] = (),
    ) -> None:
        self.splits = dict(splits)
        self.measured = measured
        self.files = dict(files or {})
        self.package_splits = frozenset(package_splits)

    def split(self, name: str) -> Split:
        """Return a split by name.

        Raises:
            UsageError: there is no such split.
        """
        if name not in self.splits:
            raise UsageError(
                f"no split {name!r}; {suggest_split(name, self.splits)}",
                where=SPLIT_NAMED,
            )
        return self.splits[name]

    def size(self, split: str, name: str) -> Size:
        """Return one size of a split with its merged parameters and measured values.

        Values that were recorded of an older MAJOR version are left out.

        Raises:
            UsageError: there is no such split, or it has no such size.
        """
        parent = self.split(split)
        if name not in parent.sizes:
            if name in SUBSETS:
                raise UsageError(
                    f"{name!r} is a subset, not a size; use subset={name!r}"
                )
            names = " or ".join(parent.sizes)
            raise UsageError(
                f"split {split!r} has no size {name!r}: expected {names}; name "
                f"{names}; `lagbench info {split}` says what they cost",
                where="--size",
            )
        entry = parent.sizes[name]
        parameters = {}
        for key, parameter in parent.parameters.items():
            value = entry.parameters.get(key, parameter.value)
            if value is None:
                continue  # an optional one
            parameters[key] = parameter.model_copy(update={"value": value})
        return Size(
            split=split,
            name=name,
            version=entry.version or parent.version,
            generator=parent.generator,
            subsets=entry.subsets,
            frames=entry.frames,
            bounds=entry.bounds,
            periodic=entry.periodic,
            particle_counts=entry.particle_counts,
            parameters=parameters,
            task=entry.task,
            measured=self._measured_values(split, name),
            file=self.files.get(split, Path("datasets.yaml")),
            package_file=split in self.package_splits,
            draw_seed=entry.draw_seed,
            refinement=entry.refinement,
        )

    def _measured_values(self, split: str, name: str) -> Measured | None:
        """Return what is recorded of a size; None where its MAJOR version is older.

        The data set hash is formed with the MAJOR version, so it tells which one it is.
        """
        measured = self.measured.get(split, {}).get(name)
        if measured is None:
            return None
        hashes = measured.subset_sha256
        if not hashes.keys() >= set(HASHED_SUBSETS):
            return measured
        parent = self.splits[split]
        major = major_of(parent.sizes[name].version or parent.version)
        if measured.dataset_sha256 == dataset_hash(split, name, major, hashes):
            return measured
        first = max(1, major - MOST_OLDER_VERSIONS)
        for older in range(first, major):
            if measured.dataset_sha256 == dataset_hash(split, name, older, hashes):
                return None
        return measured


class _RegistryFile(_RegistryModel):
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
        path: a datasets.yaml; else that of ``LAGBENCH_REGISTRY``; else ours, with the
            splits that entry points name. A package is left out with a
            :class:`~lagbench.data.registry.PluginWarning` where its split cannot be
            read, or has a name that is taken.

    Raises:
        UnreadableFileError: no such file, not YAML, an unknown key, or a value that
            does not fit.
    """
    named_path = path or os.environ.get(REGISTRY_VARIABLE)
    if named_path:
        named_path = Path(named_path)
    file = named_path or default_path()
    stamp: tuple[int, ...] = ()
    if file.exists():
        status = file.stat()
        stamp = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    return _load(named_path or None, stamp)


@functools.cache
def _load(path: Path | None, _stamp: tuple[int, ...]) -> Registry:
    """Load a file once, and again once it has changed or the path means another one."""
    file = path or default_path()
    our_file = _read_registry_file(file)
    registry = Registry(
        our_file.splits, our_file.measured, dict.fromkeys(our_file.splits, file)
    )
    if path is not None:
        return registry

    for point in dict.fromkeys(list_entry_points(GROUP)):
        our_split = our_file.splits.get(point.name)
        if our_split is not None and our_split.generator == point.value:
            continue
        try:
            registry = _add_split(registry, point)
        except Exception as error:  # a stranger's module may raise anything
            reason = str(error)
            if not isinstance(error, LagbenchError):
                reason = describe_exception(error)
            warnings.warn(
                f"package {package_of(point)} adds no split {point.name!r} "
                f"({point.value}): {reason}",
                PluginWarning,
                stacklevel=2,
            )
    return registry


def _add_split(registry: Registry, point: EntryPoint) -> Registry:
    """Return a registry with the split of an entry point of another package."""
    name = point.name
    if name in registry.splits:
        raise UsageError("its name is taken")
    module = point.load()
    if not hasattr(module, "REGISTRY"):
        expected = "an attribute REGISTRY: the path of its datasets.yaml"
        raise UsageError(f"its module has no registry: expected {expected}")
    path = Path(module.REGISTRY)
    plugin_file = _read_registry_file(path)
    split = Registry(plugin_file.splits, {}).split(name)
    measured = plugin_file.measured.get(name, {})
    return Registry(
        {**registry.splits, name: split},
        {**registry.measured, name: measured},
        {**registry.files, name: path},
        {*registry.package_splits, name},
    )


def _read_registry_file(path: Path) -> _RegistryFile:
    """Validate one datasets.yaml; say where and what is wrong with it."""
    # A child that validates predictions receives the sizes, and starts sooner without
    # YAML.
    from .yamlfile import read_yaml

    content = read_yaml(path)
    try:
        return _RegistryFile.model_validate(content)
    except ValidationError as error:
        raise UnreadableFileError(
            f"{error.error_count()} mistake(s) in the registry, see docs/extending.md:"
            f"\n    {describe_faults(error)}",
            where=str(path),
        ) from None
