"""Roll an ONNX model out: the part that runs in a child process with limits.

The child may write no file, and each library in it has one thread. Requests and answers
are JSON; arrays travel as base64.
"""

from __future__ import annotations

import base64
import functools
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .onnx_checks import OUTPUT, examine

if sys.platform != "win32":
    import resource

BY_FRAME = ("wall_velocity", "body_force")
"""Inputs that are given for each frame, those to predict included."""

MOST_DISTANCE = 10.0
"""Farthest that a particle may be from the middle of the box [length], as in a file of
predictions.
"""


def pack(array: NDArray[Any]) -> dict[str, Any]:
    """Return an array as plain values.

    >>> unpack(pack(np.array(0.5))).shape
    ()
    """
    return {
        "type": array.dtype.str,
        "shape": list(array.shape),
        "data": base64.b64encode(array.tobytes()).decode("ascii"),
    }


def unpack(values: dict[str, Any]) -> NDArray[Any]:
    """Return the array of plain values."""
    data = base64.b64decode(values["data"])
    return np.frombuffer(data, np.dtype(values["type"])).reshape(values["shape"])


@functools.cache
def forbid_files() -> None:
    """Let this process write no byte to any file; pipes stay open."""
    if sys.platform != "win32":
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


@contextmanager
def end_after(seconds: float | None) -> Iterator[None]:
    """End this process if the block needs more processor time than allowed [s].

    A call into a library cannot be interrupted from Python, so a signal ends the whole
    process. The parent reads the reason from the exit code.
    """
    if seconds is None or sys.platform == "win32":
        yield
        return
    # a parent may have told its children to ignore the signal
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGPROF})
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def open_session(path: str, seconds: float | None = None) -> tuple[Any, dict[str, str]]:
    """Return a checked model that is ready to run on one thread, and its inputs.

    Args:
        path: the ONNX file.
        seconds: processor time after which loading ends this process, because
            constants are computed then [s]; without it there is no limit.

    Returns:
        The session, and the types of the inputs by name.
    """
    import onnxruntime

    declared = examine(path)
    if declared["refused"] is not None:
        raise ValueError(declared["refused"])
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # the arena keeps all memory that was ever used
    options.enable_cpu_mem_arena = False
    options.add_session_config_entry("session.use_env_allocators", "0")
    with end_after(seconds):
        session = onnxruntime.InferenceSession(
            path, options, providers=["CPUExecutionProvider"]
        )
    return session, declared["inputs"]


_cached_session = functools.cache(open_session)


def predict_scenario(request: dict[str, Any]) -> dict[str, Any]:
    """Return the rollout of a scenario, or why there is none.

    Args:
        request: ``path`` of the model, ``frames`` to predict, arrays of the scenario
            (position, material, bounds, periodic, viscosity, wall_velocity for all
            frames, and body_force for all frames and obstacle where there are such),
            the connectivity ``radius``, and ``seconds_per_call``, the processor time
            of loading and of each call.

    Returns:
        ``position``, shape [frame, particle, axis] [length]; ``seconds``, the processor
        time of the rollout; ``diverged_at``, the predicted frame from which it is
        frozen, or None; or ``failed`` with the reason.
    """
    forbid_files()
    try:
        seconds_per_call = float(request["seconds_per_call"])
        session, inputs = _cached_session(request["path"], seconds_per_call)
        given = {name: unpack(value) for name, value in request["arrays"].items()}
        # the first call compiles and allocates
        _advance(session, inputs, given, given["position"], 0, request)
        # The clock of the process is coarse where its time is limited, as here: 4 ms.
        started = time.thread_time()
        position, diverged_at = _roll_out(session, inputs, given, request)
        seconds = time.thread_time() - started
    except MemoryError:
        raise
    except Exception as error:  # onnxruntime raises its own types
        reason = " ".join(str(error).split())[:300]
        if "bad_alloc" in reason or "Failed to allocate" in reason:
            raise MemoryError from error
        return {"failed": f"{type(error).__name__}: {reason}"}
    return {
        "position": pack(position),
        "seconds": seconds,
        "diverged_at": diverged_at,
    }


def _roll_out(
    session: Any,  # noqa: ANN401
    inputs: dict[str, str],
    given: dict[str, NDArray[Any]],
    request: dict[str, Any],
) -> tuple[NDArray[np.float32], int | None]:
    """Return positions, and the predicted frame from which they are frozen."""
    frames = int(request["frames"])
    window = given["position"].astype(np.float64)
    input_frames = len(window)
    predicted = np.empty((frames, *window.shape[1:]), np.float32)
    middle = given["bounds"].mean(axis=1)
    done = 0
    while done < frames:
        output = _advance(session, inputs, given, window, done, request)
        for frame in output:
            if done == frames:
                break
            predicted[done] = frame
            is_near = np.abs(predicted[done] - middle) <= MOST_DISTANCE
            if not is_near.all():
                _freeze(predicted, done, given["position"][-1])
                return predicted, done
            done += 1
        window = np.concatenate([window, output])[-input_frames:]
    return predicted, None


def _freeze(
    predicted: NDArray[np.float32], first: int, last_given: NDArray[np.float32]
) -> None:
    """Repeat the last sound frame from the first one that is not finite or far off."""
    last = last_given
    if first > 0:
        last = predicted[first - 1]
    predicted[first:] = last


def _advance(
    session: Any,  # noqa: ANN401
    inputs: dict[str, str],
    given: dict[str, NDArray[Any]],
    window: NDArray[np.float64],
    done: int,
    request: dict[str, Any],
) -> NDArray[np.float64]:
    """Return the next frames, at least one, shape [frame, particle, axis]."""
    # edges are pairs of particles that the model itself may have put into one place
    with end_after(request["seconds_per_call"]):
        values = _inputs_of_call(inputs, given, window, done, request["radius"])
        (output,) = session.run([OUTPUT], values)
    if output.ndim != 3 or output.shape[1:] != window.shape[1:] or len(output) == 0:
        raise ValueError(
            f"{OUTPUT} of shape {list(output.shape)}, expected [frame, "
            f"{window.shape[1]}, {window.shape[2]}]"
        )
    return np.asarray(output, np.float64)


def _inputs_of_call(
    inputs: dict[str, str],
    given: dict[str, NDArray[Any]],
    window: NDArray[np.float64],
    done: int,
    radius: float,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of one call, by the name of the input."""
    values: dict[str, NDArray[Any]] = {}
    for name, type_name in inputs.items():
        value: NDArray[Any]
        if name == "position":
            value = window
        elif name in BY_FRAME and name in given:
            # on the way to each frame of the window, and to the next one
            value = given[name][done : done + len(window) + 1]
        elif name == "edges":
            value = find_edges(window[-1], radius, given["bounds"], given["periodic"])
        elif name in given:
            value = given[name]
        else:
            raise ValueError(f"the input {name}, which this data set does not have")
        values[name] = np.asarray(value, np.dtype(type_name), order="C")
    return values


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
    from scipy.spatial import cKDTree

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
    reversed_pairs = pairs[:, ::-1]
    edges = np.concatenate([pairs, reversed_pairs])
    edges = edges.astype(np.int64)
    sender, receiver = edges.T
    order = np.lexsort((sender, receiver))
    return np.ascontiguousarray(edges[order].T)
