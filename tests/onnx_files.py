"""ONNX files for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT


def save_model(
    path: Path,
    nodes: list[Any],
    *,
    initialisers: list[Any] | None = None,
    inputs: list[Any] | None = None,
) -> Path:
    """Write a model with the input position and the output next_position."""
    if inputs is None:
        inputs = [value("position", GIVEN_POSITIONS)]
    output = value("next_position", ["frame", "particle", "axis"])
    graph = helper.make_graph(
        nodes,
        "model",
        inputs,
        [output],
        initializer=initialisers or [],
    )
    imports = [helper.make_opsetid("", 18)]
    model = helper.make_model(
        graph,
        opset_imports=imports,
        ir_version=10,
    )
    path.write_bytes(model.SerializeToString())
    return path


GIVEN_POSITIONS = ["given", "particle", "axis"]


def value(name: str, shape: list[str]) -> Any:
    """Return the description of an input or output."""
    return helper.make_tensor_value_info(name, FLOAT, shape)


def integers(name: str, *numbers: int) -> Any:
    """Return an initialiser of integers."""
    array = np.array(numbers, np.int64)
    return numpy_helper.from_array(array, name)


def node(operator: str, inputs: list[str], output: str, **attributes: Any) -> Any:
    """Return a node of a graph."""
    return helper.make_node(operator, inputs, [output], **attributes)


def straight_on(path: Path) -> Path:
    """Write the model x(n) + (x(n) - x(n - 1))."""
    nodes = [
        node("Gather", ["position", "last"], "now", axis=0),
        node("Gather", ["position", "before"], "past", axis=0),
        node("Sub", ["now", "past"], "step"),
        node("Add", ["now", "step"], "next_position"),
    ]
    places = [integers("last", -1), integers("before", -2)]
    return save_model(path, nodes, initialisers=places)


def external_data(path: Path) -> Path:
    """Name a file of the reader as the data of a tensor."""
    straight_on(path)
    model = onnx.load(path, load_external_data=False)
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key = "location"
    entry.value = "/etc/passwd"
    path.write_bytes(model.SerializeToString())
    return path
