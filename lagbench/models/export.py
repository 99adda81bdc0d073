"""Export a PyTorch model to an ONNX file that an entry can carry."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.onnx import symbolic_helper

from lagbench.atomic import checked_path
from lagbench.data.layout import expand_home
from lagbench.data.registry import Registry, Size
from lagbench.errors import (
    LagbenchError,
    UsageError,
    WorkFailedError,
    check_installed,
    require,
)
from lagbench.tensors import Batch
from lagbench.torch import WindowDataset, check_history, collate

from .onnx_checks import LEAST_OPSET, OUTPUT, SIZE_KEY, SPLIT_KEY
from .onnx_model import check_onnx
from .onnx_rollout import open_session

__all__ = ["export_onnx"]

SUFFIX = ".onnx"

MOST_DIFFERENCE = 1e-5
"""Distance between a predicted frame of the model and of its file [length]."""

Step = Callable[[Batch], Tensor]
"""From windows to the positions of the next frame [length], shape [particle, axis]."""

DYNAMIC_AXES = {
    "position": {1: "particle"},
    "material": {0: "particle"},
    OUTPUT: {1: "particle"},
}
"""Axes whose length differs from scenario to scenario."""


def export_onnx(
    step: Step,
    path: str | Path,
    *,
    split: str | Path,
    size: str | None = None,
    modules: Sequence[nn.Module] = (),
    history: int | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Path:
    """Write a model that `lagbench.torch.predict` could roll out as an ONNX file.

    The model is traced once on the given frames of a test scenario, so it must do the
    same operations for every scenario. The metadata of the file state split and size.

    Args:
        step: the model.
        path: file to write, named ``.onnx``.
        split: name of the split.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        modules: the networks whose weights ``step`` uses, if it is no module itself.
        history: how many of the last given frames the model sees; all by default.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: torch, onnx or onnxruntime is missing, the file has another suffix,
            history is beyond the given frames, the model cannot be traced, or its file
            predicts something else.
        UnreadableFileError: the file holds what an entry may not carry.
        WorkFailedError: the file cannot be written.
    """
    target = expand_home(path, "export_onnx, path")
    if target.suffix != SUFFIX:
        raise UsageError(
            "an ONNX file needs its suffix",
            where="export_onnx, path",
            expected=f"a name that ends with {SUFFIX}",
            got=target.name,
            fix=f"name it {target.stem or 'model'}{SUFFIX}",
        )
    for module in modules:
        if not isinstance(module, nn.Module):
            raise UsageError(
                "modules holds a value that is no network",
                where="export_onnx, modules",
                expected="a list of torch.nn.Module",
                got=f"{type(module).__name__} in it",
                fix="name the networks whose weights the step uses: modules=[net]",
            )
    check_installed("onnx", extra="onnx")
    data = WindowDataset(
        split, subset="test", size=size, root=root, future=0, registry=registry
    )
    window = collate([data[data.starts[0]]])
    frames = window.frames
    history = check_history(history, frames, where="export_onnx")
    inputs: dict[str, Tensor] = {
        "position": window.position.transpose(0, 1).contiguous(),
        "material": window.material,
    }
    if window.wall_velocity is not None:
        inputs["wall_velocity"] = _one_frame_more(window.wall_velocity[0], frames)
    if window.viscosity is not None:
        inputs["viscosity"] = window.viscosity[0]
    if window.body_force is not None:
        inputs["body_force"] = _one_frame_more(window.body_force[0], frames)
    if window.obstacle is not None:
        inputs["obstacle"] = window.obstacle[0]
    wrapped = _Exported(step, modules, history=history, input_names=tuple(inputs))

    with (
        _evaluation_mode(wrapped),
        checked_path(target, option="path") as unchecked,
    ):
        _write(wrapped, inputs, unchecked)
        _state_data_set(unchecked, data.size)
        check_onnx(unchecked)
        _require_same(wrapped, inputs, unchecked)
    return target


@contextmanager
def _evaluation_mode(model: nn.Module) -> Iterator[None]:
    """Evaluate a model, as without dropout; each part gets its own mode back."""
    modes = [(part, part.training) for part in model.modules()]
    model.eval()
    try:
        yield
    finally:
        for part, is_training in modes:
            part.training = is_training


def _one_frame_more(forcing: Tensor, frames: int) -> Tensor:
    """Return what drives the flow towards the given frames and the next one.

    The shape is [frame, ...]. Where the next frame is not known, the forcing of the
    last known frame repeats.
    """
    return torch.cat([forcing, forcing[-1:]])[: frames + 1]


def _write(wrapped: nn.Module, inputs: dict[str, Tensor], path: Path) -> None:
    """Trace a model on some inputs and write it as an ONNX file.

    Raises:
        UsageError: the step fails, or the exporter does.
        WorkFailedError: the operating system refused.
    """
    with warnings.catch_warnings(), _sums_of_index_add():
        # the newer exporter needs a package more and writes data beside the file
        warnings.simplefilter("ignore")
        try:
            torch.onnx.export(
                wrapped,
                tuple(inputs.values()),
                str(path),
                input_names=list(inputs),
                output_names=[OUTPUT],
                dynamic_axes=DYNAMIC_AXES,
                opset_version=LEAST_OPSET,
                dynamo=False,
            )
        except (LagbenchError, MemoryError):
            raise
        except OSError as error:
            raise WorkFailedError(
                "the model cannot be written",
                where=str(path),
                expected="a temporary folder with room",
                got=error,
                fix="free disk space, or set TMPDIR to another folder; where the step "
                "opens files, correct it",
            ) from error
        except Exception as error:  # the exporter and the step raise any kind
            reason = str(error).split("\n")[0][:200]
            names = ", ".join(inputs)
            raise UsageError(
                "the model cannot be exported",
                where="export_onnx",
                expected=f"a step that reads only inputs of this data set: {names}",
                got=f"{type(error).__name__}: {reason}",
                fix="name its networks: modules=[net]; use operations that ONNX has",
            ) from error


def _state_data_set(path: Path, size: Size) -> None:
    """Write the names of split and size into the metadata of an ONNX file."""
    onnx = require("onnx", extra="onnx")
    model = onnx.load(path, load_external_data=False)
    names = {SPLIT_KEY: size.split, SIZE_KEY: size.name}
    onnx.helper.set_model_props(model, names)
    onnx.save(model, path)


@contextmanager
def _sums_of_index_add() -> Iterator[None]:
    """Export ``index_add`` as a sum.

    The exporter's own translation keeps one of the values that share an index.
    """

    def translate(
        graph: Any,  # noqa: ANN401
        total: Any,  # noqa: ANN401
        axis: Any,  # noqa: ANN401
        index: Any,  # noqa: ANN401
        source: Any,  # noqa: ANN401
        _alpha: Any = None,  # noqa: ANN401
    ) -> Any:  # noqa: ANN401
        helper: Any = symbolic_helper  # has no types
        number = helper._get_const(axis, "i", "dim")
        rank = helper._get_tensor_rank(source)
        others = [other for other in range(rank) if other != number % rank]
        if others:
            axes = graph.op("Constant", value_t=torch.tensor(others))
            index = graph.op("Unsqueeze", index, axes)
        index = graph.op("Expand", index, graph.op("Shape", source))
        return graph.op(
            "ScatterElements", total, index, source, axis_i=number, reduction_s="add"
        )

    exporter: Any = torch.onnx
    exporter.register_custom_op_symbolic("aten::index_add", translate, LEAST_OPSET)
    try:
        yield
    finally:
        exporter.unregister_custom_op_symbolic("aten::index_add", LEAST_OPSET)


def _require_same(wrapped: nn.Module, inputs: dict[str, Tensor], path: Path) -> None:
    """Refuse a file that predicts something else than the model.

    Exporters translate some operations wrongly, without an error. The file runs with
    the same session options as where an entry is reproduced.
    """
    with torch.no_grad():
        expected = wrapped(*inputs.values()).numpy()
    frame_shape = (1, *inputs["position"].shape[1:])
    if expected.shape != frame_shape:
        raise UsageError(
            "the model does not predict the positions of the next frame",
            where="export_onnx, step",
            expected=f"shape {frame_shape[1:]}: particle, component",
            got=f"shape {expected.shape[1:]}",
            fix="return one position of every particle",
        )
    try:
        session, names = open_session(str(path))
        values = {}
        for name, tensor in inputs.items():
            if name in names:
                values[name] = tensor.numpy()
        (exported,) = session.run([OUTPUT], values)
    except MemoryError:
        raise
    except Exception as error:  # onnxruntime raises its own types
        reason = str(error).split("\n")[0][:200]
        raise UsageError(
            "the exported model does not run",
            where="export_onnx",
            expected="a model that onnxruntime can run",
            got=f"{type(error).__name__}: {reason}",
            fix="replace the operation, or compute in float32 where it has float64",
        ) from error
    if exported.shape != expected.shape:
        raise UsageError(
            "the exported model predicts another number of positions",
            where="export_onnx",
            expected=f"shape {expected.shape}",
            got=f"shape {exported.shape}",
            fix="let the step do the same operations whenever it is called",
        )
    difference = float(np.abs(exported - expected).max())
    if not difference <= MOST_DIFFERENCE:
        raise UsageError(
            "the exported model does not predict what the model does",
            where="export_onnx",
            expected=f"positions within {MOST_DIFFERENCE:g}",
            got=f"a difference of {difference:.2g}",
            fix="replace the operations that the exporter translates wrongly",
        )


class _Exported(nn.Module):
    """A step with the signature of an ONNX entry."""

    def __init__(
        self,
        step: Step,
        modules: Sequence[nn.Module],
        *,
        history: int,
        input_names: tuple[str, ...],
    ) -> None:
        super().__init__()
        # registered, so that the weights are found
        self.networks = nn.ModuleList(modules)
        self.step = step
        self.history = history
        self.input_names = input_names

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the next frame, shape [1, particle, axis]."""
        given = dict(zip(self.input_names, inputs, strict=True))
        position = given["position"]
        material = given["material"]
        walls = None
        if "wall_velocity" in given:
            walls = given["wall_velocity"][-self.history - 1 :][None]
        force = None
        if "body_force" in given:
            force = given["body_force"][-self.history - 1 :][None]
        viscosity = None
        if "viscosity" in given:
            viscosity = given["viscosity"][None]
        obstacle = None
        if "obstacle" in given:
            obstacle = given["obstacle"][None]
        values: dict[str, Any] = {
            "position": position[-self.history :].transpose(0, 1),
            "sample": torch.zeros_like(material),
            "material": material,
            "wall_velocity": walls,
            "viscosity": viscosity,
            "body_force": force,
            "obstacle": obstacle,
            "scenario": torch.zeros(1, dtype=torch.int64),
            "frame": torch.zeros(1, dtype=torch.int64),
        }
        return self.step(Batch(**values))[None]
