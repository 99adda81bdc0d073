"""Write a predictions.nc scenario by scenario; it appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.atomic import atomic_path
from lagbench.data.local import locate, suggest_repair
from lagbench.data.registry import Registry, Size, format_ids
from lagbench.errors import DataError, UsageError, WorkFailedError, suggest_name

from .findings import quoted
from .format import ATTRIBUTES, DIMS, FORMAT, NEVER, OPTIONAL, SPACE, require_fit
from .task_checks import HASH, dataset_hash_of, frames_to_predict
from .truth import Truth

Label = str | int | float  # value of an optional attribute


class PredictionsWriter:
    """Write predictions one scenario at a time; use it as a context manager.

    The file has a temporary name until the clean exit, where it must hold every test
    scenario; on an error it is removed.

    Args:
        path: file to write.
        split: name of the split.
        size: name of the size; the only one that is there when None.
        method: what makes the predictions.
        velocity: whether velocities are stored too (they are not scored).
        dataset_sha256: hash of the data set that the model was given; else the recorded
            one.
        root: folder of all data sets; asked only where no hash is recorded.
        registry: where splits are described; ours when None.
        **labels: see :meth:`label`.

    Raises:
        UsageError: unknown split, size or label.
        DataError: the hash of the data set is not known.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        split: str | Path,
        size: str | None = None,
        method: str,
        velocity: bool = False,
        dataset_sha256: str | None = None,
        root: str | Path | None = None,
        registry: Registry | None = None,
        **labels: Label,
    ) -> None:
        self.path = Path(path)
        self.size, folder, _ = locate(split, size, root=root, registry=registry)
        if dataset_sha256 is None:
            _bring(self.size, folder)
            dataset_sha256 = dataset_hash_of(self.size, folder)
            if dataset_sha256 is None:
                raise DataError(
                    "the hash of the data set is not known",
                    where=f"{self.size.split} {self.size.name}",
                    expected="a hash in datasets.yaml, or a complete data set here",
                    fix=f"{suggest_repair(self.size, root=folder)}, or give dataset_sha256",
                )
        self._hash = dataset_sha256
        if not isinstance(self._hash, str) or not HASH.fullmatch(self._hash):
            raise UsageError(
                "dataset_sha256 does not fit",
                expected="64 hex digits",
                got=quoted(self._hash),
            )
        require_fit("method", method)
        self._names = ("position", "velocity") if velocity else ("position",)
        self._rows = {
            scenario: row
            for row, scenario in enumerate(sorted(self.size.subsets["test"]))
        }
        self._open = False  # whether a file is being written
        self._written: set[int] = set()
        self._diverged = np.full(len(self._rows), NEVER, np.int32)
        self._labels: dict[str, Label] = {"method": method}
        self.label(**labels)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of one scenario: frames to predict, particles, components."""
        return self.size.task.horizon, self.size.particles, SPACE

    def label(self, **labels: Label) -> None:
        """Set optional attributes, at any time before the exit.

        Args:
            **labels: seconds_per_frame [s], device, seed, parameters (trainable, a
                number >= 0), training (in words), solver_seconds_per_frame [s], budget
                and provenance (JSON, docs/predictions.md).

        Raises:
            UsageError: there is no such label, or it cannot have that value.
        """
        for name, value in labels.items():
            if isinstance(value, np.generic):
                value = value.item()
            else:
                value = value
            if name not in OPTIONAL:
                raise UsageError(f"no label {name!r}", fix=suggest_name(name, OPTIONAL))
            require_fit(name, value)
            self._labels[name] = value

    def __enter__(self) -> Self:
        """Create the temporary file with everything but the predictions."""
        import netCDF4

        if self._open:
            raise UsageError(
                "the file is being written",
                where=str(self.path),
                fix="enter a writer once",
            )
        self._written.clear()
        self._diverged.fill(NEVER)
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self.path, option="--output"))
            with self._writing():
                self._file = netCDF4.Dataset(temporary, "w", format="NETCDF4")
                stack.callback(self._abandon)
                for name, length in zip(
                    DIMS, (len(self._rows), *self.shape), strict=True
                ):
                    self._file.createDimension(name, length)
                self._create(
                    "scenario", "scenario", np.array(list(self._rows), np.int32)
                )
                self._create(
                    "frame", "frame", np.array(frames_to_predict(self.size), np.int32)
                )
                for name in self._names:
                    self._create(name)
                size = self.size
                head = {"Conventions": "CF-1.11", "lagbench_format": np.int32(FORMAT)}
                names = {
                    "split": size.split,
                    "size": size.name,
                    "dataset_version": size.version,
                }
                self._file.setncatts({**head, **names, "dataset_sha256": self._hash})
            self._stack = stack.pop_all()
        self._open = True
        return self

    def add(
        self,
        scenario: int,
        position: ArrayLike,
        velocity: ArrayLike | None = None,
        *,
        diverged_at: int | None = None,
    ) -> None:
        """Add the predictions of a scenario, in any order of scenarios.

        Args:
            scenario: id of a test scenario.
            position: positions [length] at the frames to predict, shape [frame,
                particle, space].
            velocity: velocities [length/s], same shape.
            diverged_at: absolute frame from which a diverging rollout is frozen.

        Raises:
            UsageError: unknown or repeated scenario, wrong shape, values that are not
                finite, or a rollout that is not frozen where ``diverged_at`` says.
            WorkFailedError: the disk is full.
        """
        if not self._open:
            fix = "with PredictionsWriter(...) as writer:"
            raise UsageError("no file is open", where=str(self.path), fix=fix)
        if scenario not in self._rows or scenario in self._written:
            if scenario in self._written:
                what = "is written twice"
            else:
                what = "is no test scenario"
            expected = f"whole numbers: {format_ids(self._rows)}"
            raise UsageError(f"scenario {scenario!r} {what}", expected=expected)
        if velocity is None:
            arrays = [position]
        else:
            arrays = [position, velocity]
        if len(arrays) != len(self._names):
            raise UsageError(
                "velocities come for every scenario or for none",
                where=f"scenario {scenario}",
            )
        checked = [
            self._checked(n, scenario, held)
            for n, held in zip(self._names, arrays, strict=True)
        ]
        frames = frames_to_predict(self.size)
        where = f"diverged_at of scenario {scenario}"
        if diverged_at is not None and diverged_at not in frames:
            what = "no such frame is predicted"
            expected = format_ids(frames)
            raise UsageError(
                what, where=where, expected=expected, got=repr(diverged_at)
            )
        rest = checked[0][
            len(frames) if diverged_at is None else frames.index(diverged_at) :
        ]
        moved = np.flatnonzero((rest != rest[:1]).any(axis=(1, 2)))
        if moved.size:
            raise UsageError(
                "the rollout moves after it was frozen",
                where=where,
                expected=f"the same positions from frame {diverged_at} on",
                got=f"frame {frames[int(moved[0]) - len(rest)]} differs",
                fix="freeze a diverging rollout at its last finite frame",
            )
        row = self._rows[scenario]
        with self._writing():
            for name, values in zip(self._names, checked, strict=True):
                self._file[name][row] = values
        if diverged_at is None:
            self._diverged[row] = NEVER
        else:
            self._diverged[row] = diverged_at
        self._written.add(scenario)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish and rename the file, or remove it when the body raised."""
        self._open = False
        if error is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            if missing := sorted(set(self._rows) - self._written):
                what = f"{len(missing)} test scenarios are missing"
                got = f"missing: {format_ids(missing)}"
                raise UsageError(
                    what, where=str(self.path), expected=format_ids(self._rows), got=got
                )
            with self._writing():
                if (self._diverged != NEVER).any():
                    self._create("diverged_at", "scenario", self._diverged)
                self._file.setncatts(self._labels)
                self._file.close()

    def _abandon(self) -> None:
        """Close a file that goes; that it cannot be written either must not hide the
        error before.
        """
        if self._file.isopen():
            with suppress(OSError, RuntimeError):
                self._file.close()

    def _checked(
        self, name: str, scenario: int, values: ArrayLike
    ) -> NDArray[np.float32]:
        where = f"{name} of scenario {scenario}"
        try:
            given = np.asanyarray(values)
            if np.ma.is_masked(given):
                kind = "masked values"
            else:
                kind = f"values of type {given.dtype}"
        except (
            ValueError,
            TypeError,
            RuntimeError,
        ) as error:  # ragged lists, tensors with gradients
            given = np.empty(0, object)
            kind = f"{type(values).__name__}: {str(error)[:200]}"
        if given.dtype.kind not in "fiu" or np.ma.is_masked(given):
            expected = "an array of numbers without a mask"
            raise UsageError(
                "these are no positions", where=where, expected=expected, got=kind
            )
        with np.errstate(over="ignore"):
            array = np.asarray(given).astype(np.float32)
        if array.shape != self.shape:
            turned = sorted(array.shape) == sorted(self.shape)
            if turned:
                fix = "transpose it: frame, particle, space"
            else:
                fix = None
            got = array.shape
            raise UsageError(
                "the shape is another",
                where=where,
                expected=self.shape,
                got=got,
                fix=fix,
            )
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            frame, particle, axis = wrong[0].tolist()
            what = f"{len(wrong)} values are not finite as float32"
            got = array[frame, particle, axis]
            where += (
                f", frame {frame + self.size.task.input_frames}, particle {particle}"
            )
            fix = "freeze a diverging rollout at its last finite frame and give diverged_at"
            raise UsageError(what, where=where, got=got, fix=fix)
        return array

    def _create(
        self, name: str, dim: str = "", values: NDArray[np.int32] | None = None
    ) -> None:
        packing: dict[str, Any] = {"endian": "little", "fill_value": False}
        if not dim:
            # Not packed: zlib saves little of digits that hardly repeat, and unpacking
            # makes scoring slower. Frames are written once, in order: a cache of a MiB
            # does.
            packing |= {
                "fletcher32": True,
                "chunksizes": (1, 1, *self.shape[1:]),
                "chunk_cache": 1 << 20,
            }
        variable = self._file.createVariable(
            name, "i4" if dim else "f4", (dim,) if dim else DIMS, **packing
        )
        variable.setncatts(ATTRIBUTES[name])
        if values is not None:
            variable[:] = values

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError) as error:
            fix = "free disk space, or name a folder that you may write to: --output"
            what = "cannot write the predictions"
            where = str(self.path)
            raise WorkFailedError(what, where=where, got=error, fix=fix) from error


def _bring(size: Size, root: Path, scenarios: Sequence[int] = ()) -> None:
    from lagbench.store.copy import (
        update_working_copy,
    )  # http and more, which a child that only reads can do without

    update_working_copy(size, root, scenarios)


def write(
    path: str | Path,
    positions: Mapping[int, ArrayLike] | ArrayLike,
    *,
    split: str | Path,
    size: str | None = None,
    method: str,
    velocities: Mapping[int, ArrayLike] | ArrayLike | None = None,
    diverged_at: Mapping[int, int] | None = None,
    dataset_sha256: str | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
    **labels: Label,
) -> Path:
    """Write a predictions.nc from arrays.

    Args:
        path: file to write.
        positions: scenario id to positions [length], shape [frame, particle, space]; or
            one array [scenario, frame, particle, space] with the test scenarios by
            ascending id.
        split: name of the split.
        size: name of the size; the only one that is there when None.
        method: what made the predictions.
        velocities: velocities [length/s], in the same form; stored, not scored.
        diverged_at: scenario id to the absolute frame from which its rollout is frozen.
        dataset_sha256: hash of the data set that the model was given; else the recorded
            one.
        root: folder of all data sets; asked only where no hash is recorded.
        registry: where splits are described; ours when None.
        **labels: see :meth:`PredictionsWriter.label`.

    Returns:
        The path.

    Raises:
        UsageError: unknown names or scenarios, wrong shapes, missing scenarios, values
            that are not finite.
        DataError: the hash of the data set is not known.
        WorkFailedError: the disk is full or not writable.
    """
    writer = PredictionsWriter(
        path,
        split=split,
        size=size,
        method=method,
        velocity=velocities is not None,
        dataset_sha256=dataset_sha256,
        root=root,
        registry=registry,
        **labels,
    )
    ids = sorted(writer.size.subsets["test"])
    placed = _by_id(positions, ids)
    if velocities is None:
        moving = None
    else:
        moving = _by_id(velocities, ids)
    marks = diverged_at or {}
    for name, held in (("velocities", moving or {}), ("diverged_at", marks)):
        if unknown := [scenario for scenario in held if scenario not in ids]:
            got = ", ".join(map(quoted, unknown[:5]))
            fix = "name scenarios by id, not by row"
            raise UsageError(
                "no such test scenario",
                where=name,
                expected=format_ids(ids),
                got=got,
                fix=fix,
            )
    with writer:
        for scenario, values in placed.items():
            if moving is None:
                velocity = None
            else:
                velocity = moving.get(scenario)
            writer.add(scenario, values, velocity, diverged_at=marks.get(scenario))
    return writer.path


def _by_id(
    values: Mapping[int, ArrayLike] | ArrayLike, ids: list[int]
) -> Mapping[int, ArrayLike]:
    if isinstance(values, Mapping):
        return values
    array = np.asarray(values)
    if array.ndim != len(DIMS) or len(array) != len(ids):
        raise UsageError(
            "the array does not hold one entry per test scenario",
            expected=f"{len(ids)} scenarios ({format_ids(ids)}) first, 4 dimensions",
            got=f"shape {array.shape}",
            fix="or give a mapping of scenario id to array",
        )
    return dict(zip(ids, array, strict=True))


@dataclass(frozen=True, kw_only=True)
class TemplateResult:
    """A template that was written."""

    path: Path
    split: str
    size: str
    scenarios: tuple[int, ...]
    # absolute numbers of the first and the last frame to predict
    frames: tuple[int, int]
    particles: int
    bytes: int


def template(
    split: str | Path,
    size: str | None = None,
    *,
    output: str | Path = "predictions.nc",
    overwrite: bool = False,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> TemplateResult:
    """Write a valid predictions.nc to fill: the last given frame, repeated.

    Args:
        split: name of the split.
        size: name of the size; the only one that is there when None.
        output: file to write.
        overwrite: whether to replace a file of that name.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split or size, or there is such a file.
        DataError: test scenarios are missing or damaged, or their data set has no
            recorded hash.
        WorkFailedError: the disk is full or not writable.
    """
    folder_there = Path(output).is_dir()
    if folder_there or (Path(output).exists() and not overwrite):
        if folder_there:
            what = "the output is a folder"
        else:
            what = "there is such a file already"
        fix = "write elsewhere: -o template.nc" + (
            "" if folder_there else "; or replace it: --overwrite"
        )
        raise UsageError(what, where=str(output), fix=fix)
    entry, folder, described = locate(split, size, root=root, registry=registry)
    _bring(entry, folder, entry.subsets["test"])
    truth = Truth(entry, folder)
    truth.require()
    ids = tuple(sorted(entry.subsets["test"]))
    frames = frames_to_predict(entry)
    named: dict[str, Any] = {
        "split": entry.split,
        "size": entry.name,
        "method": "persistence",
    }
    with PredictionsWriter(output, **named, root=folder, registry=described) as writer:
        for scenario in ids:
            writer.add(
                scenario, np.broadcast_to(truth.given(scenario)[-1], writer.shape)
            )
    return TemplateResult(
        path=writer.path,
        split=entry.split,
        size=entry.name,
        scenarios=ids,
        frames=(frames[0], frames[-1]),
        particles=entry.particles,
        bytes=writer.path.stat().st_size,
    )
