"""Write a predictions.nc scenario by scenario; it appears whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.atomic import atomic_path
from lagbench.data.local import locate, remedy
from lagbench.data.registry import Registry, Size, spell_ids
from lagbench.errors import DataError, UsageError, WorkFailedError, nearest

from .findings import quoted
from .format import DIMS, FORMAT, NEVER, OPTIONAL, SPACE, fits, kind_of
from .task_checks import HASH, dataset_hash_of, frames_to_predict
from .truth import Truth

CHUNK_CACHE = 1 << 20
"""Chunk cache while writing [bytes]; frames are written once, in order."""

Label = str | int | float
"""Value of an optional attribute."""


class PredictionsWriter:
    """Write predictions one scenario at a time; use it as a context manager.

    The file has a temporary name until the clean exit, where it must hold every test scenario;
    on an error it is removed.

    Args:
        path: file to write.
        split: name of the split.
        size: name of the size; the only one that is there when None.
        method: what makes the predictions.
        velocity: whether velocities are stored too (they are not scored).
        dataset_sha256: hash of the data set that the model was given; else the recorded one.
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
        self._hash = _known_hash(self.size, folder) if dataset_sha256 is None else dataset_sha256
        if not isinstance(self._hash, str) or not HASH.fullmatch(self._hash):
            raise UsageError("dataset_sha256 does not fit", expected="64 hex digits", got=quoted(self._hash))
        _require_fit("method", method)
        self._names = ("position", "velocity") if velocity else ("position",)
        self._rows = {scenario: row for row, scenario in enumerate(sorted(self.size.subsets["test"]))}
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
            **labels: seconds_per_frame [s], device, seed, parameters (trainable, a number >= 0),
                training (in words), solver_seconds_per_frame [s], budget (JSON, docs/predictions.md).

        Raises:
            UsageError: there is no such label, or it cannot have that value.
        """
        for name, value in labels.items():
            value = value.item() if isinstance(value, np.generic) else value
            if name not in OPTIONAL:
                raise UsageError(f"no label {name!r}", fix=nearest(name, OPTIONAL))
            _require_fit(name, value)
            self._labels[name] = value

    def __enter__(self) -> Self:
        """Create the temporary file with everything but the predictions."""
        import netCDF4

        if self._open:
            raise UsageError("the file is being written", where=str(self.path), fix="enter a writer once")
        self._written.clear()
        self._diverged.fill(NEVER)
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self.path, option="--output"))
            try:
                self._file = netCDF4.Dataset(temporary, "w", format="NETCDF4")
                stack.callback(self._abandon)
                self._define()
            except (OSError, RuntimeError) as error:
                raise self._refused(error) from error
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
            position: positions [length] at the frames to predict, shape [frame, particle, space].
            velocity: velocities [length/s], same shape.
            diverged_at: absolute frame from which a diverging rollout is frozen.

        Raises:
            UsageError: unknown or repeated scenario, wrong shape, values that are not finite, or
                a rollout that is not frozen where ``diverged_at`` says.
            WorkFailedError: the disk is full.
        """
        if not self._open:
            raise UsageError(
                "no file is open", where=str(self.path), fix="with PredictionsWriter(...) as writer:"
            )
        if scenario not in self._rows or scenario in self._written:
            what = "is written twice" if scenario in self._written else "is no test scenario"
            raise UsageError(
                f"scenario {scenario!r} {what}", expected=f"whole numbers: {spell_ids(self._rows)}"
            )
        arrays = [position] if velocity is None else [position, velocity]
        if len(arrays) != len(self._names):
            raise UsageError("velocities come for every scenario or for none", where=f"scenario {scenario}")
        row = self._rows[scenario]
        for name, values in zip(self._names, arrays, strict=True):
            checked = self._checked(name, scenario, values)
            if name == "position" and diverged_at is not None:
                self._check_frozen(scenario, checked, diverged_at)
            try:
                self._file[name][row] = checked
            except (OSError, RuntimeError) as error:
                raise self._refused(error) from error
        self._diverged[row] = NEVER if diverged_at is None else diverged_at
        self._written.add(scenario)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish and rename the file, or remove it when the body raised."""
        self._open = False
        if error is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            missing = sorted(set(self._rows) - self._written)
            if missing:
                raise UsageError(
                    f"{len(missing)} test scenarios are missing",
                    where=str(self.path),
                    expected=spell_ids(self._rows),
                    got=f"missing: {spell_ids(missing)}",
                )
            try:
                if (self._diverged != NEVER).any():
                    self._create("diverged_at", "i4", ("scenario",), self._diverged)
                self._file.setncatts(self._labels)
                self._file.close()
            except (OSError, RuntimeError) as failure:
                raise self._refused(failure) from failure

    def _abandon(self) -> None:
        """Close a file that goes; that it cannot be written either must not hide the error before."""
        if self._file.isopen():
            with suppress(OSError, RuntimeError):
                self._file.close()

    def _checked(self, name: str, scenario: int, values: ArrayLike) -> NDArray[np.float32]:
        where = f"{name} of scenario {scenario}"
        try:
            given = np.asanyarray(values)
            kind = "masked values" if np.ma.is_masked(given) else f"values of type {given.dtype}"
        except (ValueError, TypeError, RuntimeError) as error:  # ragged lists, tensors with gradients
            given, kind = np.empty(0, object), f"{type(values).__name__}: {str(error)[:200]}"
        if given.dtype.kind not in "fiu" or np.ma.is_masked(given):
            raise UsageError(
                "these are no positions", where=where, expected="an array of numbers without a mask", got=kind
            )
        with np.errstate(over="ignore"):
            array = np.asarray(given).astype(np.float32)
        if array.shape != self.shape:
            turned = sorted(array.shape) == sorted(self.shape)
            fix = "transpose it: frame, particle, space" if turned else None
            raise UsageError(
                "the shape is another", where=where, expected=self.shape, got=array.shape, fix=fix
            )
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            frame, particle, axis = (int(i) for i in wrong[0])
            raise UsageError(
                f"{len(wrong)} values are not finite as float32",
                where=f"{where}, frame {frame + self.size.task.input_frames}, particle {particle}",
                got=array[frame, particle, axis],
                fix="freeze a diverging rollout at its last finite frame and give diverged_at",
            )
        return array

    def _check_frozen(self, scenario: int, position: NDArray[np.float32], mark: int) -> None:
        frames = frames_to_predict(self.size)
        where = f"diverged_at of scenario {scenario}"
        if mark not in frames:
            raise UsageError(
                "no such frame is predicted", where=where, expected=spell_ids(frames), got=repr(mark)
            )
        rest = position[frames.index(mark) :]
        moved = np.flatnonzero((rest != rest[0]).any(axis=(1, 2)))
        if moved.size:
            raise UsageError(
                "the rollout moves after it was frozen",
                where=where,
                expected=f"the same positions from frame {mark} on",
                got=f"frame {mark + int(moved[0])} differs",
                fix="freeze a diverging rollout at its last finite frame",
            )

    def _define(self) -> None:
        size = self.size
        lengths = (len(self._rows), *self.shape)
        for name, length in zip(DIMS, lengths, strict=True):
            self._file.createDimension(name, length)
        self._create("scenario", "i4", ("scenario",), np.array(list(self._rows), np.int32))
        self._create("frame", "i4", ("frame",), np.array(frames_to_predict(size), np.int32))
        for name in self._names:
            self._create(name, "f4", DIMS)
        names = {"split": size.split, "size": size.name, "dataset_version": size.version}
        head = {"Conventions": "CF-1.11", "lagbench_format": np.int32(FORMAT)}
        self._file.setncatts({**head, **names, "dataset_sha256": self._hash})

    def _create(
        self, name: str, dtype: str, dims: tuple[str, ...], values: NDArray[np.int32] | None = None
    ) -> None:
        packing: dict[str, Any] = {"endian": "little", "fill_value": False}
        if len(dims) > 1:
            # not packed: zlib saves little of digits that hardly repeat, and unpacking makes scoring slower
            packing |= {"fletcher32": True, "chunksizes": (1, 1, *self.shape[1:]), "chunk_cache": CHUNK_CACHE}
        variable = self._file.createVariable(name, dtype, dims, **packing)
        variable.setncatts(_ATTRIBUTES[name])
        if values is not None:
            variable[:] = values

    def _refused(self, error: Exception) -> WorkFailedError:
        fix = "free disk space, or name a folder that you may write to: --output"
        return WorkFailedError("cannot write the predictions", where=str(self.path), got=error, fix=fix)


_ATTRIBUTES: Mapping[str, Mapping[str, str]] = {
    "scenario": {"long_name": "scenario id", "units": "1"},
    "frame": {"long_name": "absolute frame number", "units": "1"},
    "position": {"long_name": "predicted particle position in lengths of the unit box", "units": "1"},
    "velocity": {"long_name": "predicted particle velocity in box lengths per second", "units": "s-1"},
    "diverged_at": {"long_name": "first frame of a frozen rollout, -1 where none is", "units": "1"},
}


def _require_fit(name: str, value: object) -> None:
    """Refuse what `validate` would refuse of the file."""
    if not fits(name, value):
        raise UsageError(f"the label {name!r} does not fit", expected=kind_of(name), got=quoted(value))


def _known_hash(size: Size, root: Path) -> str:
    from lagbench.store.copy import bring  # http and more, which a child that only reads can do without

    bring(size, root)
    known = dataset_hash_of(size, root)
    if known is None:
        raise DataError(
            "the hash of the data set is not known",
            where=f"{size.split} {size.name}",
            expected="a hash in datasets.yaml, or a complete data set here",
            fix=f"{remedy(size, root=root)}, or give dataset_sha256",
        )
    return known


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
        positions: scenario id to positions [length], shape [frame, particle, space]; or one
            array [scenario, frame, particle, space] with the test scenarios by ascending id.
        split: name of the split.
        size: name of the size; the only one that is there when None.
        method: what made the predictions.
        velocities: velocities [length/s], in the same form; stored, not scored.
        diverged_at: scenario id to the absolute frame from which its rollout is frozen.
        dataset_sha256: hash of the data set that the model was given; else the recorded one.
        root: folder of all data sets; asked only where no hash is recorded.
        registry: where splits are described; ours when None.
        **labels: see :meth:`PredictionsWriter.label`.

    Returns:
        The path.

    Raises:
        UsageError: unknown names or scenarios, wrong shapes, missing scenarios, values that are not finite.
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
    placed, moving = _by_id(positions, ids), None if velocities is None else _by_id(velocities, ids)
    for name, held in (("velocities", moving), ("diverged_at", diverged_at)):
        if unknown := [scenario for scenario in held or {} if scenario not in ids]:
            raise UsageError(
                "no such test scenario",
                where=name,
                expected=spell_ids(ids),
                got=", ".join(map(quoted, unknown[:5])),
                fix="name scenarios by id, not by row",
            )
    with writer:
        for scenario, values in placed.items():
            velocity = None if moving is None else moving.get(scenario)
            writer.add(scenario, values, velocity, diverged_at=(diverged_at or {}).get(scenario))
    return writer.path


def _by_id(values: Mapping[int, ArrayLike] | ArrayLike, ids: list[int]) -> Mapping[int, ArrayLike]:
    if isinstance(values, Mapping):
        return values
    array = np.asarray(values)
    if array.ndim != len(DIMS) or len(array) != len(ids):
        raise UsageError(
            "the array does not hold one entry per test scenario",
            expected=f"{len(ids)} scenarios ({spell_ids(ids)}) first, 4 dimensions",
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
    frames: tuple[int, int]  # absolute numbers of the first and the last frame to predict
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
        DataError: test scenarios are missing or damaged, or their data set has no recorded hash.
        WorkFailedError: the disk is full or not writable.
    """
    if Path(output).exists() and not overwrite:
        raise UsageError(
            "there is such a file already",
            where=str(output),
            fix="write elsewhere: -o template.nc; or replace it: --overwrite",
        )
    from lagbench.store.copy import bring

    entry, folder, described = locate(split, size, root=root, registry=registry)
    bring(entry, folder, entry.subsets["test"])
    truth = Truth(entry, folder)
    truth.require()
    writer = PredictionsWriter(
        output, split=entry.split, size=entry.name, method="persistence", root=folder, registry=described
    )
    ids = tuple(sorted(entry.subsets["test"]))
    with writer:
        for scenario in ids:
            writer.add(scenario, np.broadcast_to(truth.given(scenario)[-1], writer.shape))
    task = entry.task
    return TemplateResult(
        path=writer.path,
        split=entry.split,
        size=entry.name,
        scenarios=ids,
        frames=(task.input_frames, task.input_frames + task.horizon - 1),
        particles=entry.particles,
        bytes=writer.path.stat().st_size,
    )
