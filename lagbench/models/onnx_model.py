"""An ONNX model as something that predicts scenarios; onnxruntime runs it.

The graph gets some of the inputs :data:`INPUTS`, by name, and returns the next frames,
at least one, as ``next_position`` [length], shape [frame, particle, axis]. A stranger's
file is run without limits: run it in a container (docs/reproduce.md).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.data.scenario import read_scenario
from lagbench.errors import UnreadableFileError, check_regular, require
from lagbench.references.predictor import given_in

INPUTS = (
    "position",  # given frames and predicted ones, the last input_frames of them
    "material",
    "bounds",
    "periodic",
    "wall_velocity",  # towards each frame of position and the next one [length/s]
    "viscosity",
    "body_force",  # towards each frame of position and the next one [length/s^2]
    "obstacle",
    "edges",  # pairs nearer than the connectivity radius, shape [2, edge]
)
BY_FRAME = ("wall_velocity", "body_force")
OUTPUT = "next_position"
SPLIT_KEY = "lagbench_split"
SIZE_KEY = "lagbench_size"
"""Keys of the metadata that state the data set of a model."""

MOST_BYTES = 16_000_000
"""Longest ONNX file [bytes]."""

MOST_DISTANCE = 10.0
"""Farthest that a particle may be from the middle of the box [length], as in a file of
predictions.
"""

LEAST_SECONDS = 1e-6  # processor time of a rollout, which is never nothing [s]

DTYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class OnnxRollout:
    """Predicted positions of one scenario."""

    position: NDArray[np.float32]  # [length], shape [frame, particle, axis]
    seconds: float  # processor time [s]
    # absolute frame from which the positions are frozen; None where none is
    diverged_at: int | None


@dataclass(frozen=True, kw_only=True)
class DeclaredModel:
    """What an ONNX file declares."""

    inputs: tuple[str, ...]  # names of its inputs
    parameters: int  # numbers in its initialisers
    split: str | None  # split that its metadata state
    size: str | None  # size that its metadata state


def check_onnx(path: Path) -> DeclaredModel:
    """Return what an ONNX file declares.

    Raises:
        UsageError: onnx or onnxruntime is not installed.
        UnreadableFileError: the file is no ONNX, has other inputs or outputs than
            those above, or keeps data outside the file.
    """
    onnx = require("onnx", extra="onnx")
    check_regular(path, longest=MOST_BYTES)
    try:
        model = onnx.load(path, load_external_data=False)
    except Exception as error:  # protobuf raises its own types
        raise UnreadableFileError("not an ONNX file", where=str(path)) from error
    tensors = model.graph.initializer
    if any(tensor.external_data for tensor in tensors):
        raise UnreadableFileError("it keeps data outside the file", where=str(path))
    session = open_session(path)
    inputs = [value.name for value in session.get_inputs()]
    outputs = [value.name for value in session.get_outputs()]
    unknown = sorted(set(inputs) - set(INPUTS))
    if unknown or outputs != [OUTPUT] or "position" not in inputs:
        raise UnreadableFileError(
            f"inputs {inputs} and outputs {outputs}; expected are position, any of "
            f"{INPUTS}, and {OUTPUT}",
            where=str(path),
        )
    stated = session.get_modelmeta().custom_metadata_map
    return DeclaredModel(
        inputs=tuple(inputs),
        parameters=sum(int(np.prod(tensor.dims)) for tensor in tensors),
        split=stated.get(SPLIT_KEY),
        size=stated.get(SIZE_KEY),
    )


def open_session(path: Path) -> Any:  # noqa: ANN401 (onnxruntime has no types)
    """Return a model that is ready to run on one thread."""
    onnxruntime = require("onnxruntime", extra="onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime raises its own types
        reason = str(error).split("\n")[0][:200]
        raise UnreadableFileError(
            f"onnxruntime cannot load the model: {reason}", where=str(path)
        ) from error


class OnnxModel:
    """An ONNX file, for the data of one split and size.

    Args:
        path: the file.
        size: the split and size to predict.
        root: folder of all data sets.

    Raises:
        UsageError: onnx or onnxruntime is not installed.
        UnreadableFileError: see :func:`check_onnx`.
    """

    def __init__(self, path: Path, *, size: Size, root: Path) -> None:
        self.path = path
        self.size = size
        self.root = root
        self.parameters = check_onnx(path).parameters
        self._session = open_session(path)
        self._types = {}
        for value in self._session.get_inputs():
            self._types[value.name] = DTYPES[value.type]

    def predict(
        self, scenario_file: Path, frames: int | None = None
    ) -> NDArray[np.float32]:
        """Return positions of the frames after the given ones [length].

        Args:
            scenario_file: file of the scenario.
            frames: frames to predict; by default those of the task.

        Returns:
            Positions, shape [frame, particle, axis].

        Raises:
            UnreadableFileError: the model cannot be run, or returns something else than
                positions.
        """
        return self.roll_out(scenario_file, frames).position

    def time(self, scenario_file: Path, frames: int) -> float:
        """Return the processor time of a frame, mean over the first ones [s]."""
        return max(self.roll_out(scenario_file, frames).seconds, LEAST_SECONDS) / frames

    def close(self) -> None:
        """Nothing is left open."""

    def roll_out(self, scenario_file: Path, frames: int | None = None) -> OnnxRollout:
        """Return positions and what they took; see :meth:`predict`.

        A rollout that ceases to be finite, or goes far off, is frozen at its last sound
        frame.
        """
        count = frames or self.size.task.horizon
        given = self._read(scenario_file)
        window = given["position"].astype(np.float64)
        input_frames = len(window)
        middle = given["bounds"].mean(axis=1)
        predicted = np.empty((count, *window.shape[1:]), np.float32)
        self._advance(given, window, 0)  # the first call compiles and allocates

        started = time.thread_time()
        diverged_at = None
        done = 0
        while done < count and diverged_at is None:
            output = self._advance(given, window, done)
            for frame in output[: count - done]:
                predicted[done] = frame
                is_near = np.abs(predicted[done] - middle) <= MOST_DISTANCE
                if not is_near.all():
                    last_sound = predicted[done - 1] if done else given["position"][-1]
                    predicted[done:] = last_sound
                    diverged_at = input_frames + done
                    break
                done += 1
            window = np.concatenate([window, output])[-input_frames:]
        seconds = time.thread_time() - started
        return OnnxRollout(position=predicted, seconds=seconds, diverged_at=diverged_at)

    def _read(self, scenario_file: Path) -> dict[str, NDArray[Any]]:
        """Return what the scenario gives to a model, by the names of inputs.

        The model gets velocities of walls and forces per unit of time, as files have
        them; :class:`~lagbench.references.predictor.Given` has them per frame.
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
            arrays["body_force"] = given.body_force / self.size.frame_interval**2
        if given.obstacle is not None:
            arrays["obstacle"] = given.obstacle
        return arrays

    def _advance(
        self, given: dict[str, NDArray[Any]], window: NDArray[np.float64], done: int
    ) -> NDArray[np.float64]:
        """Return the next frames, at least one, shape [frame, particle, axis]."""
        values: dict[str, NDArray[Any]] = {}
        for name, dtype in self._types.items():
            if name == "position":
                value: NDArray[Any] = window
            elif name == "edges":
                radius = self.size.task.radius
                value = find_edges(
                    window[-1], radius, given["bounds"], given["periodic"]
                )
            elif name not in given:
                raise UnreadableFileError(
                    f"the model has the input {name}, which {self.size.split} does not "
                    "have",
                    where=str(self.path),
                )
            elif name in BY_FRAME:
                # on the way to each frame of the window, and to the next one
                value = given[name][done : done + len(window) + 1]
            else:
                value = given[name]
            values[name] = np.asarray(value, dtype, order="C")
        try:
            (output,) = self._session.run([OUTPUT], values)
        except Exception as error:  # onnxruntime raises its own types
            reason = str(error).split("\n")[0][:200]
            raise UnreadableFileError(
                f"the model cannot be run: {reason}", where=str(self.path)
            ) from error
        if output.ndim != 3 or output.shape[1:] != window.shape[1:] or not len(output):
            raise UnreadableFileError(
                f"{OUTPUT} has shape {list(output.shape)}; expected is [frame, "
                f"{window.shape[1]}, {window.shape[2]}]",
                where=str(self.path),
            )
        return np.asarray(output, np.float64)


def find_edges(
    position: NDArray[np.float64],
    radius: float,
    bounds: NDArray[np.float64],
    periodic: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Return the pairs of particles nearer than a radius, both directions.

    Pairs across a periodic end count. No particle is its own neighbour.

    Args:
        position: positions [length], shape [particle, axis].
        radius: connectivity radius [length].
        bounds: ends of the box [length], shape [axis, 2].
        periodic: whether each axis repeats itself, shape [axis].

    Returns:
        Senders and receivers, ordered by receiver and then sender, shape [2, edge].
    """
    from scipy.spatial import cKDTree  # takes long to load

    if not np.isfinite(position).all():
        return np.zeros((2, 0), np.int64)
    low, high = bounds.T
    lengths = high - low
    from_low = position - low
    wrapped = np.where(periodic, np.mod(from_low, lengths), from_low)
    # scipy refuses points on the upper end of a periodic axis
    is_at_end = periodic & (wrapped >= lengths)
    wrapped = np.where(is_at_end, 0.0, wrapped)
    box_size = None
    if periodic.any():
        box_size = np.where(periodic, lengths, 0.0)
    tree = cKDTree(wrapped, boxsize=box_size)
    pairs = tree.query_pairs(radius, output_type="ndarray")
    edges = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)
    sender, receiver = edges.T
    order = np.lexsort((sender, receiver))
    return np.ascontiguousarray(edges[order].T)
