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
from lagbench.errors import UsageError, check_installed, require
from lagbench.tensors import Batch
from lagbench.torch import WindowDataset, check_history, collate

from .onnx_model import OUTPUT, SIZE_KEY, SPLIT_KEY, check_onnx, open_session

__all__ = ["export_onnx"]

SUFFIX = ".onnx"
OPSET = 18

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
        WorkFailedError: the file cannot be written.
    """
    target = expand_home(path, "export_onnx, path")
    if target.suffix != SUFFIX:
        raise UsageError(f"name the file {target.stem or 'model'}{SUFFIX}")
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
                opset_version=OPSET,
                dynamo=False,
            )
        except Exception as error:  # the exporter and the step raise any kind
            raise UsageError(
                f"the model cannot be exported: {error!r:.200}; use operations that "
                f"ONNX has, read only {', '.join(inputs)}, and name its networks: "
                "modules=[net]"
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
    exporter.register_custom_op_symbolic("aten::index_add", translate, OPSET)
    try:
        yield
    finally:
        exporter.unregister_custom_op_symbolic("aten::index_add", OPSET)


def _require_same(wrapped: nn.Module, inputs: dict[str, Tensor], path: Path) -> None:
    """Refuse a file that predicts something else than the model.

    Exporters translate some operations wrongly, without an error.
    """
    with torch.no_grad():
        expected = wrapped(*inputs.values()).numpy()
    if expected.shape != (1, *inputs["position"].shape[1:]):
        raise UsageError(
            f"the step returns shape {expected.shape[1:]}; one position of every "
            "particle is expected"
        )
    session = open_session(path)
    values = {}
    for value in session.get_inputs():
        values[value.name] = inputs[value.name].numpy()
    try:
        (exported,) = session.run([OUTPUT], values)
    except Exception as error:  # onnxruntime raises its own types
        raise UsageError(f"the exported model does not run: {error!r:.200}") from error
    if exported.shape != expected.shape:
        raise UsageError(
            f"the exported model predicts shape {exported.shape}, not {expected.shape}"
        )
    difference = float(np.abs(exported - expected).max())
    if not difference <= MOST_DIFFERENCE:
        raise UsageError(
            f"the exported model predicts positions that differ by {difference:.2g}: "
            "the exporter translates an operation wrongly"
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
        for name in ("wall_velocity", "body_force"):
            if name in given:
                given[name] = given[name][-self.history - 1 :]
        optional: dict[str, Any] = {}
        for name in ("wall_velocity", "body_force", "viscosity", "obstacle"):
            value = given.get(name)
            optional[name] = None if value is None else value[None]
        batch = Batch(
            position=given["position"][-self.history :].transpose(0, 1),
            sample=torch.zeros_like(given["material"]),
            material=given["material"],
            scenario=torch.zeros(1, dtype=torch.int64),
            frame=torch.zeros(1, dtype=torch.int64),
            **optional,
        )
        return self.step(batch)[None]
