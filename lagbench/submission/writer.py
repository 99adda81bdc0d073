"""Write a predictions.nc scenario by scenario; it appears whole or not at all."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.atomic import atomic_path, check_output_file, explain_write_error
from lagbench.data.hdf5 import open_netcdf
from lagbench.data.layout import expand_home, format_ids
from lagbench.data.local import locate, suggest_repair
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.store.copy import update_working_copy

from .format import ATTRIBUTES, DIMS, FORMAT, HASH, NEVER, check_labels
from .issues import quote
from .truth import Truth, dataset_hash_of, frames_to_predict, max_test_particles

CHUNK_CACHE_BYTES = 1 << 20
"""Memory for the chunks of a variable while it is written [bytes]."""

Label = str | int | float
"""Value of an optional attribute."""


class PredictionsWriter:
    """Write predictions one scenario at a time; use it as a context manager.

    The file has a temporary name until the clean exit, where it must hold every test
    scenario; on an error it is removed.

    Args:
        path: file to write. A file or a symbolic link of that name is replaced.
        split: name of the split.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        method: what makes the predictions.
        subset: the subset that is predicted: test, or shift, which lies outside train.
        dataset_sha256: hash of the data set that the model was given; else the recorded
            one.
        root: folder of all data sets; read where no size is named, where the split is a
            folder of its own, or where no hash is recorded.
        registry: where splits are described; ours when None.
        option: option or argument that names the path, for messages.
        **labels: see :meth:`label`.

    Raises:
        UsageError: unknown split, size or label, or the path is that of a folder.
        DataError: the hash of the data set is not known.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        split: str | Path,
        size: str | None = None,
        method: str,
        subset: str = "test",
        dataset_sha256: str | None = None,
        root: str | Path | None = None,
        registry: Registry | None = None,
        option: str = "path",
        **labels: Label,
    ) -> None:
        self.path = expand_home(path, option)
        self._option = option
        check_output_file(self.path, overwrite=True, option=option)
        tier, folder, _ = locate(split, size, root=root, registry=registry)
        self.size = tier.scored_on(subset)
        if dataset_sha256 is None:
            if self.size.measured is None:
                update_working_copy(self.size, folder)
            dataset_sha256 = dataset_hash_of(self.size, folder)
        if dataset_sha256 is None:
            raise DataError(
                f"neither {self.size.record_name} nor a complete data set here has the "
                f"hash of the data; {suggest_repair(self.size, root=folder)}, or give "
                "dataset_sha256",
                where=f"{self.size.split} {self.size.name}",
            )
        if not isinstance(dataset_sha256, str) or not HASH.fullmatch(dataset_sha256):
            raise UsageError(
                f"64 hex digits, as `lagbench info` prints them, got "
                f"{quote(dataset_sha256)}; leave it out where a hash is recorded",
                where="dataset_sha256",
            )
        self._dataset_sha256 = dataset_sha256
        self._row_of: dict[int, int] = {}
        for row, scenario in enumerate(sorted(self.size.scored_scenarios)):
            self._row_of[scenario] = row
        self._is_open = False
        self._written: set[int] = set()
        self._diverged_at = np.full(len(self._row_of), NEVER, np.int32)
        self._labels: dict[str, Label] = {}
        self.label(method=method, **labels)
        if subset != "test":
            self._labels["subset"] = subset

    def shape_of(self, scenario: int) -> tuple[int, int, int]:
        """Return the shape of a scenario: frames to predict, particles, components."""
        particles = self.size.particle_count(scenario)
        return self.size.task.horizon, particles, self.size.dimension

    @property
    def _stored_shape(self) -> tuple[int, int, int]:
        """Shape of a scenario in the file, which may end in padding."""
        particles = max_test_particles(self.size)
        return self.size.task.horizon, particles, self.size.dimension

    def label(self, **labels: Label) -> None:
        """Set optional attributes, at any time before the exit.

        Args:
            **labels: seconds_per_frame [s], device, seed, parameters (trainable, a
                number >= 0), training (in words), solver_seconds_per_frame [s], budget
                and provenance (JSON, docs/predictions.md).

        Raises:
            UsageError: there is no such label, or it cannot have that value.
        """
        plain_labels = {}
        for name, value in labels.items():
            plain_labels[name] = (
                value.item() if isinstance(value, np.generic) else value
            )
        check_labels(plain_labels)
        self._labels |= plain_labels

    def __enter__(self) -> Self:
        """Create the temporary file with everything but the predictions."""
        if self._is_open:
            raise UsageError("enter a writer once", where=str(self.path))
        self._written.clear()
        self._diverged_at.fill(NEVER)
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self.path, option=self._option))
            with self._writing():
                self._file = open_netcdf(temporary, "w")
                stack.callback(self._abandon)
                lengths = (len(self._row_of), *self._stored_shape)
                for name, length in zip(DIMS, lengths, strict=True):
                    self._file.createDimension(name, length)
                numbers = list(self._row_of)
                self._create_coordinate("scenario", "scenario", numbers)
                self._create_coordinate("frame", "frame", frames_to_predict(self.size))
                counts = [self.size.particle_count(number) for number in numbers]
                if len(set(counts)) > 1:
                    self._create_coordinate("particle_count", "scenario", counts)
                # Not packed: zlib saves little of digits that hardly repeat, and
                # unpacking makes scoring slower. Frames are written once, in order: a
                # cache of a MiB does.
                variable = self._file.createVariable(
                    "position",
                    "f4",
                    DIMS,
                    endian="little",
                    fill_value=False,
                    fletcher32=True,
                    chunksizes=(1, 1, *self._stored_shape[1:]),
                    chunk_cache=CHUNK_CACHE_BYTES,
                )
                variable.setncatts(ATTRIBUTES["position"])
                self._file.setncatts(
                    {
                        "Conventions": "CF-1.11",
                        "lagbench_format": np.int32(FORMAT),
                        "split": self.size.split,
                        "size": self.size.name,
                        "dataset_version": self.size.version,
                        "dataset_sha256": self._dataset_sha256,
                    }
                )
            self._stack = stack.pop_all()
        self._is_open = True
        return self

    def add(
        self,
        scenario: int,
        position: ArrayLike,
        *,
        diverged_at: int | None = None,
    ) -> None:
        """Add the predictions of a scenario, in any order of scenarios.

        Args:
            scenario: id of a test scenario, also as an array of one number without
                dimensions.
            position: positions [length] at the frames to predict, shape [frame,
                particle, space].
            diverged_at: absolute frame from which a diverging rollout is frozen.

        Raises:
            UsageError: unknown or repeated scenario, wrong shape, values that are not
                finite, or a rollout that is not frozen where ``diverged_at`` says.
            WorkFailedError: the disk is full.
        """
        if not self._is_open:
            raise UsageError(
                "no file is open; with PredictionsWriter(...) as writer:",
                where=str(self.path),
            )
        number = None
        with suppress(TypeError, ValueError, RuntimeError):
            number = operator.index(np.asarray(scenario)[()])
        if number is None or number not in self._row_of:
            raise UsageError(
                f"no such scenario; give ids, not rows: {format_ids(self._row_of)}",
                where=f"scenario {quote(scenario)}",
            )
        where = f"scenario {number}"
        if number in self._written:
            raise UsageError("a scenario is written once", where=where)
        values = self._check_values(number, position)
        if diverged_at is not None:
            frames = frames_to_predict(self.size)
            where = f"diverged_at of {where}"
            is_whole = isinstance(diverged_at, int | np.integer)
            if not is_whole or diverged_at not in frames:
                raise UsageError(
                    f"no predicted frame, but {quote(diverged_at)}; give the absolute "
                    f"number of the first frozen frame: {format_ids(frames)}",
                    where=where,
                )
            frozen = values[frames.index(diverged_at) :]
            if (frozen != frozen[:1]).any():
                raise UsageError(
                    f"the rollout moves after frame {diverged_at}; freeze it at its "
                    "last finite frame",
                    where=where,
                )

        row = self._row_of[number]
        with self._writing():
            # Particles that the scenario does not have are padding.
            padded = np.full(self._stored_shape, np.nan, np.float32)
            padded[:, : values.shape[1]] = values
            self._file["position"][row] = padded
        if diverged_at is not None:
            self._diverged_at[row] = diverged_at
        self._written.add(number)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish and rename the file, or remove it when the body raised."""
        self._is_open = False
        if error is not None:
            # the error of the body goes on as it is, whatever its kind
            with suppress(WorkFailedError):
                self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            missing = sorted(set(self._row_of) - self._written)
            if missing:
                raise UsageError(
                    f"scenarios {format_ids(missing)} are missing; predict every test "
                    "scenario",
                    where=str(self.path),
                )
            with self._writing():
                if (self._diverged_at != NEVER).any():
                    self._create_coordinate(
                        "diverged_at", "scenario", self._diverged_at
                    )
                self._file.setncatts(self._labels)
                self._file.close()

    def _abandon(self) -> None:
        """Close a file that goes; a second error must not hide the first one."""
        if self._file.isopen():
            with suppress(OSError, RuntimeError):
                self._file.close()

    def _check_values(self, scenario: int, values: ArrayLike) -> NDArray[np.float32]:
        """Return values as float32; refuse a wrong type, shape or values not finite."""
        where = f"position of scenario {scenario}"
        numbers = _numbers_of(values, where)
        with np.errstate(over="ignore"):
            array = numbers.astype(np.float32)
        expected_shape = self.shape_of(scenario)
        if array.shape != expected_shape:
            raise UsageError(
                f"shape {array.shape}; give {expected_shape}: frame, particle, space",
                where=where,
            )
        bad_places = np.argwhere(~np.isfinite(array))
        if len(bad_places):
            step, particle, axis = bad_places[0].tolist()
            frame = self.size.task.input_frames + step
            raise UsageError(
                f"{array[step, particle, axis]} is not finite as float32; freeze a "
                "diverging rollout at its last finite frame and give diverged_at",
                where=f"{where}, frame {frame}, particle {particle}",
            )
        return array

    def _create_coordinate(
        self, name: str, dim: str, values: Sequence[int] | NDArray[np.int32]
    ) -> None:
        variable = self._file.createVariable(
            name, "i4", (dim,), endian="little", fill_value=False
        )
        variable.setncatts(ATTRIBUTES[name])
        variable[:] = np.array(values, np.int32)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError) as error:
            raise explain_write_error(self.path, error, option=self._option) from error


def _numbers_of(values: ArrayLike, where: str) -> NDArray[Any]:
    """Return values as an array; refuse what is masked or no number."""
    try:
        array = np.asanyarray(values)
    except (ValueError, TypeError, RuntimeError):  # ragged, tensors with gradients
        array = np.array(None)
    if np.ma.is_masked(array) or array.dtype.kind not in "fiu":
        raise UsageError(
            f"{type(values).__name__} is no array of numbers without a mask; of a "
            "tensor: tensor.detach().float().cpu().numpy()",
            where=where,
        )
    return np.asarray(array)


def write(
    path: str | Path,
    positions: Mapping[int, ArrayLike] | ArrayLike,
    *,
    split: str | Path,
    size: str | None = None,
    method: str,
    subset: str = "test",
    diverged_at: Mapping[int, int] | None = None,
    dataset_sha256: str | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
    **labels: Label,
) -> Path:
    """Write a predictions.nc from arrays.

    Args:
        path: file to write. A file of that name is replaced. So is a symbolic link: the
            file that it leads to stays as it is.
        positions: scenario id to positions [length], shape [frame, particle, space]; or
            one array [scenario, frame, particle, space] with the test scenarios by
            ascending id.
        split: name of the split.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        method: what made the predictions.
        subset: the subset that is predicted: test, or shift, which lies outside train.
        diverged_at: scenario id to the absolute frame from which its rollout is frozen.
        dataset_sha256: hash of the data set that the model was given; else the recorded
            one.
        root: folder of all data sets; read where no size is named, where the split is a
            folder of its own, or where no hash is recorded.
        registry: where splits are described; ours when None.
        **labels: see :meth:`PredictionsWriter.label`.

    Returns:
        The path.

    Raises:
        UsageError: unknown names or scenarios, wrong shapes, missing scenarios, values
            that are not finite, or the path is that of a folder.
        DataError: the hash of the data set is not known.
        WorkFailedError: the disk is full or not writable.
    """
    writer = PredictionsWriter(
        path,
        split=split,
        size=size,
        method=method,
        subset=subset,
        dataset_sha256=dataset_sha256,
        root=root,
        registry=registry,
        option="path",
        **labels,
    )
    scenarios = sorted(writer.size.scored_scenarios)
    position_of = _by_scenario(positions, scenarios)
    frozen_from = diverged_at or {}
    unknown = [scenario for scenario in frozen_from if scenario not in scenarios]
    if unknown:
        raise UsageError(
            f"no test scenarios: {quote(unknown)}; give ids, not rows: "
            f"{format_ids(scenarios)}",
            where="diverged_at",
        )
    with writer:
        for scenario, position in position_of.items():
            writer.add(
                scenario,
                position,
                diverged_at=frozen_from.get(scenario),
            )
    return writer.path


def _by_scenario(
    values: Mapping[int, ArrayLike] | ArrayLike, scenarios: list[int]
) -> Mapping[int, ArrayLike]:
    """Return values by scenario id; an array holds scenarios by ascending id."""
    if isinstance(values, Mapping):
        return values
    array = _numbers_of(values, "positions")
    if array.ndim != len(DIMS) or len(array) != len(scenarios):
        raise UsageError(
            f"shape {array.shape}; give all {len(scenarios)} test scenarios in one "
            "array of 4 dimensions, or a mapping of id to array",
            where="positions",
        )
    return dict(zip(scenarios, array, strict=True))


@dataclass(frozen=True, kw_only=True)
class TemplateResult:
    """A template that was written."""

    path: Path
    split: str
    size: str
    scenarios: tuple[int, ...]
    # absolute numbers of the first and the last frame to predict
    frames: tuple[int, int]
    particles: int  # of the scenario with the most
    # least and greatest number of particles of a predicted scenario
    particle_range: tuple[int, int]
    bytes: int


def template(
    split: str | Path,
    size: str | None = None,
    *,
    subset: str = "test",
    output: str | Path = "predictions.nc",
    overwrite: bool = False,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> TemplateResult:
    """Write a valid predictions.nc to fill: the last given frame, repeated.

    Args:
        split: name of the split.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        subset: the subset to predict: test, or shift, which lies outside train.
        output: file to write.
        overwrite: whether to replace a file of that name.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or subset, or there is such a file.
        DataError: scenarios of the subset are missing or damaged, or their data set
            has no recorded hash.
        WorkFailedError: the disk is full or not writable.
    """
    any_size, folder, splits = locate(split, size, root=root, registry=registry)
    entry = any_size.scored_on(subset)
    output_path = expand_home(output, "--output")
    check_output_file(output_path, overwrite=overwrite)
    update_working_copy(entry, folder, entry.subsets[subset])
    truth = Truth(entry, folder)
    truth.require()
    writer = PredictionsWriter(
        output_path,
        split=entry.split,
        size=entry.name,
        method="persistence",
        subset=subset,
        root=folder,
        registry=splits,
        option="--output",
    )
    scenarios = tuple(sorted(entry.subsets[subset]))
    particle_counts = []
    with writer:
        for scenario in scenarios:
            last_given = truth.given_frames(scenario)[-1]
            particle_counts.append(len(last_given))
            writer.add(scenario, np.broadcast_to(last_given, writer.shape_of(scenario)))
    frames = frames_to_predict(entry)
    return TemplateResult(
        path=writer.path,
        split=entry.split,
        size=entry.name,
        scenarios=scenarios,
        frames=(frames[0], frames[-1]),
        particles=entry.particles,
        particle_range=(min(particle_counts), max(particle_counts)),
        bytes=writer.path.stat().st_size,
    )
