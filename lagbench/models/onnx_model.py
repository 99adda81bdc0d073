"""An ONNX model as something that predicts scenarios, without trust in its file.

The file is parsed and run in child processes (`lagbench.work.machine.run_in_child`)
with limits on memory, processor time and time of the clock, which may write no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.local import is_split_name
from lagbench.data.registry import Size
from lagbench.data.scenario import read_scenario
from lagbench.errors import (
    UnreadableFileError,
    WorkFailedError,
    check_installed,
)
from lagbench.references.predictor import given_in
from lagbench.work.machine import run_in_child

from .formats import require_onnx_bytes
from .onnx_checks import MOST_BYTES
from .onnx_rollout import pack, unpack

CHECK_SECONDS = 5.0  # processor time of the checks [s]
LOAD_SECONDS = 10.0  # processor time of imports and of loading a model [s]
CHECK_MEMORY = 1 << 30  # address space of the checks [bytes]
MEMORY = 4 << 30  # address space of a rollout [bytes]
SECONDS_PER_CALL = 3.0  # processor time of loading, and of each call of a model [s]
LEAST_SECONDS = 1e-6  # processor time of a rollout, which is never nothing [s]
WALL_FACTOR = 4.0  # time of the clock over processor time, on a busy machine
START_SECONDS = 600.0
"""Time of the clock for the start of a child and its checks [s].

Only a child that waits gets that far: what computes too long is stopped by its limit of
processor time. On a machine that is busy with other work the imports alone may take
minutes.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class OnnxRollout:
    """Predicted positions of one scenario."""

    position: NDArray[np.float32]  # [length], shape [frame, particle, axis]
    seconds: float  # processor time [s]
    # absolute frame from which the positions are frozen; None where none is
    diverged_at: int | None


@dataclass(frozen=True, kw_only=True)
class OnnxModel:
    """A checked ONNX file, for the data of one split and size."""

    path: Path
    size: Size
    root: Path  # folder of all data sets
    inputs: tuple[str, ...]  # names of its inputs
    parameters: int  # numbers in its initialisers
    memory: int = MEMORY
    seconds_per_call: float = SECONDS_PER_CALL

    def predict(
        self, scenario_file: Path, frames: int | None = None
    ) -> NDArray[np.float32]:
        """Return positions of the frames after the given ones [length].

        A rollout that ceases to be finite is frozen.

        Args:
            scenario_file: file of the scenario.
            frames: frames to predict; by default those of the task.

        Returns:
            Positions, shape [frame, particle, axis].

        Raises:
            UnreadableFileError: the model cannot be run, or returns something else than
                positions.
            WorkFailedError: it needed more time or memory than allowed, or the machine
                is too busy.
        """
        return self.roll_out(scenario_file, frames).position

    def time(self, scenario_file: Path, frames: int) -> float:
        """Return the processor time of a frame, mean over the first ones [s]."""
        return max(self.roll_out(scenario_file, frames).seconds, LEAST_SECONDS) / frames

    def roll_out(self, scenario_file: Path, frames: int | None = None) -> OnnxRollout:
        """Return positions and what they took; see :meth:`predict`."""
        answer = self._run(scenario_file, frames)
        diverged_at = answer["diverged_at"]
        if diverged_at is not None:
            diverged_at += self.size.task.input_frames
        return OnnxRollout(
            position=unpack(answer["position"]),
            seconds=float(answer["seconds"]),
            diverged_at=diverged_at,
        )

    def close(self) -> None:
        """Nothing is left open: a child ends with its scenario."""

    def _run(self, scenario_file: Path, frames: int | None) -> dict[str, Any]:
        """Return the answer of a child about one scenario."""
        count = frames or self.size.task.horizon
        request = self._make_request(scenario_file, count)
        most_calls = count + 1  # the first one is made twice
        seconds = LOAD_SECONDS + self.seconds_per_call * most_calls
        answers = run_in_child(
            "lagbench.models.onnx_rollout.predict_scenario",
            [request],
            seconds=seconds,
            wall=START_SECONDS + WALL_FACTOR * seconds,
            memory=self.memory,
        )
        answers.require_in_time(str(self.path))
        if not answers.values:
            raise WorkFailedError(
                "the model was stopped",
                where=str(self.path),
                expected=f"at most {self.seconds_per_call:g} s of processor time per "
                f"call and {self.memory >> 20} MiB of memory",
                got=answers.stopped,
                fix="make the model smaller or faster; see docs/submitting.md",
            )
        answer: dict[str, Any] = answers.values[0]
        if "failed" in answer:
            raise UnreadableFileError(
                "the model cannot be run",
                where=str(self.path),
                expected="an ONNX model as docs/submitting.md describes it",
                got=answer["failed"],
                fix=f"export it for {self.size.split} {self.size.name}, by the options "
                "split and size of export_onnx, or run it with onnxruntime first",
            )
        return answer

    def _make_request(self, scenario_file: Path, frames: int) -> dict[str, Any]:
        """Return what the child process needs to roll a scenario out, ready for JSON.

        The model gets velocities of walls and forces per unit of time, as files have
        them. :class:`Given` has them per frame.
        """
        with read_scenario(scenario_file) as file:
            given = given_in(file, self.size, self.root)
        arrays: dict[str, NDArray[Any]] = {
            "position": given.position.astype(np.float32),
            "material": given.material.astype(np.int64),
            "bounds": np.asarray(given.box.bounds, np.float64),
            "periodic": np.asarray(given.box.periodic, np.bool_),
            "wall_velocity": given.walls / self.size.frame_interval,
            "viscosity": np.asarray(given.viscosity, np.float64),
        }
        if given.body_force is not None:
            per_square_second = given.body_force / self.size.frame_interval**2
            arrays["body_force"] = per_square_second
        if given.obstacle is not None:
            arrays["obstacle"] = given.obstacle
        packed_arrays = {}
        for name, array in arrays.items():
            packed_arrays[name] = pack(array)
        return {
            "path": str(self.path.absolute()),
            "frames": frames,
            "seconds_per_call": self.seconds_per_call,
            "radius": self.size.task.radius,
            "arrays": packed_arrays,
        }


def open_onnx(
    path: Path,
    *,
    size: Size,
    root: Path,
    memory: int = MEMORY,
    seconds_per_call: float = SECONDS_PER_CALL,
    declared: DeclaredModel | None = None,
) -> OnnxModel:
    """Check an ONNX file and return its model; nothing in it is run yet.

    Args:
        path: the file.
        size: the split and size to predict.
        root: folder of all data sets.
        memory: address space of a rollout [bytes].
        seconds_per_call: processor time of loading the model, and of each call [s].
        declared: what :func:`check_onnx` returned for the file; it is called when None.

    Raises:
        UsageError: onnx or onnxruntime is not installed.
        UnreadableFileError: the file is no ONNX, or holds what is not allowed.
        WorkFailedError: the machine is too busy.
    """
    if declared is None:
        declared = check_onnx(path)
    return OnnxModel(
        path=path,
        size=size,
        root=root,
        inputs=declared.inputs,
        parameters=declared.parameters,
        memory=memory,
        seconds_per_call=seconds_per_call,
    )


@dataclass(frozen=True, kw_only=True)
class DeclaredModel:
    """What an ONNX file that passed the checks declares."""

    inputs: tuple[str, ...]  # names of its inputs
    parameters: int  # numbers in its initialisers
    split: str | None  # split that its metadata state
    size: str | None  # size that its metadata state


def check_onnx(path: Path) -> DeclaredModel:
    """Check an ONNX file in a child process; nothing in it is run.

    Raises:
        UsageError: onnx or onnxruntime is not installed.
        UnreadableFileError: the file is no ONNX, or holds what is not allowed.
        WorkFailedError: the machine is too busy.
    """
    for package in ("onnx", "onnxruntime"):
        check_installed(package, extra="onnx")
    require_onnx_bytes(path, longest=MOST_BYTES)
    answers = run_in_child(
        "lagbench.models.onnx_checks.examine",
        [str(path.absolute())],
        seconds=CHECK_SECONDS,
        wall=START_SECONDS,
        memory=CHECK_MEMORY,
    )
    answers.require_in_time(str(path))
    reason = answers.stopped
    declared: dict[str, Any] = {}
    if answers.values:
        declared = answers.values[0]
        reason = declared["refused"]
    if reason is not None:
        raise UnreadableFileError(
            "the model is refused",
            where=str(path),
            expected="ONNX as docs/submitting.md describes it",
            got=reason,
            fix="export the model anew without that",
        )
    for name in (declared["split"], declared["size"]):
        if name is not None and not is_split_name(name):
            raise UnreadableFileError(
                "the metadata name no data set",
                where=str(path),
                expected="names of a split and a size, such as cavity and mini",
                got=ascii(name),
                fix="write the file with export_onnx, or without these metadata",
            )
    return DeclaredModel(
        inputs=tuple(declared["inputs"]),
        parameters=int(declared["parameters"]),
        split=declared["split"],
        size=declared["size"],
    )
