"""ONNX files and weights of the attack: valid ones, and their mutations."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from .mutations import Mutation

Content = dict[str, Any]

CASE_OPSET = 18
"""Operator set of the models."""


def write_straight_on(path: Path) -> Path:
    """Write the model x(n) + (x(n) - x(n - 1))."""
    last = numpy_helper.from_array(np.array([-1], np.int64), "last")
    before = numpy_helper.from_array(np.array([-2], np.int64), "before")
    nodes = [
        helper.make_node("Gather", ["position", "last"], ["now"], axis=0),
        helper.make_node("Gather", ["position", "before"], ["past"], axis=0),
        helper.make_node("Sub", ["now", "past"], ["step"]),
        helper.make_node("Add", ["now", "step"], ["next_position"]),
    ]
    given = ["given", "particle", "axis"]
    following = ["frame", "particle", "axis"]
    kind = TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "model",
        [helper.make_tensor_value_info("position", kind, given)],
        [helper.make_tensor_value_info("next_position", kind, following)],
        initializer=[last, before],
    )
    opset = helper.make_opsetid("", CASE_OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=10)
    path.write_bytes(model.SerializeToString())
    return path


def _load(path: Path) -> onnx.ModelProto:
    return onnx.load(path, load_external_data=False)


def _save(path: Path, model: onnx.ModelProto) -> None:
    path.write_bytes(model.SerializeToString())


def remove_a_node(path: Path, rng: np.random.Generator) -> None:
    """Remove a node of the graph."""
    model = _load(path)
    del model.graph.node[rng.integers(len(model.graph.node))]
    _save(path, model)


def repeat_a_node(path: Path, rng: np.random.Generator) -> None:
    """Compute a value twice under one name."""
    model = _load(path)
    node = model.graph.node[rng.integers(len(model.graph.node))]
    model.graph.node.append(node)
    _save(path, model)


def other_operator(path: Path, rng: np.random.Generator) -> None:
    """Exchange an operator."""
    names = ("Loop", "If", "Scan", "Div", "Log", "Concat", "Evil", "NonZero", "Sqrt")
    model = _load(path)
    node = model.graph.node[rng.integers(len(model.graph.node))]
    node.op_type = names[rng.integers(len(names))]
    _save(path, model)


def other_domain(path: Path, rng: np.random.Generator) -> None:
    """Take an operator from another domain."""
    model = _load(path)
    model.graph.node[0].domain = ("com.microsoft", "../../evil", "\u202e")[
        rng.integers(3)
    ]
    _save(path, model)


def other_opset(path: Path, rng: np.random.Generator) -> None:
    """State another operator set."""
    versions = (-1, 0, 1, 17, 10**6, 2**62)
    model = _load(path)
    model.opset_import[0].version = versions[rng.integers(len(versions))]
    _save(path, model)


def other_index(path: Path, rng: np.random.Generator) -> None:
    """Ask for a frame that is not given."""
    values = (-(2**62), -7, 5, 10**12)
    model = _load(path)
    index = np.array([values[rng.integers(len(values))]], np.int64)
    model.graph.initializer[0].CopyFrom(numpy_helper.from_array(index, "last"))
    _save(path, model)


def other_dimensions(path: Path, rng: np.random.Generator) -> None:
    """Claim a tensor of another shape than the file holds."""
    values = (0, -1, 10**6, 2**40)
    model = _load(path)
    tensor = model.graph.initializer[0]
    del tensor.dims[:]
    tensor.dims.extend([values[rng.integers(len(values))]] * 2)
    _save(path, model)


def other_tensor_type(path: Path, rng: np.random.Generator) -> None:
    """Claim a tensor of another type."""
    model = _load(path)
    model.graph.initializer[0].data_type = int(rng.integers(0, 30))
    _save(path, model)


def external_data(path: Path, rng: np.random.Generator) -> None:
    """Name a file of the reader as the data of a tensor."""
    places = ("/etc/passwd", "../../../etc/passwd", ".", "model.onnx")
    model = _load(path)
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key = "location"
    entry.value = places[rng.integers(len(places))]
    _save(path, model)


def other_names(path: Path, rng: np.random.Generator) -> None:
    """Give input or output another name."""
    names = ("", "velocity", "../../x", "\u202e", "x" * 100_000)
    model = _load(path)
    values = (model.graph.input[0], model.graph.output[0])
    values[rng.integers(2)].name = names[rng.integers(len(names))]
    _save(path, model)


def hostile_values(path: Path, rng: np.random.Generator) -> None:
    """Add a constant to the predictions that is no number, huge, or moves nothing."""
    constants = (np.nan, np.inf, -np.inf, 1e30, -1e3, 0.1)
    constant = np.float32(constants[rng.integers(len(constants))])
    model = _load(path)
    tensor = numpy_helper.from_array(np.array(constant), "constant")
    model.graph.initializer.append(tensor)
    model.graph.node[-1].output[0] = "sum"
    node = helper.make_node("Add", ["sum", "constant"], ["next_position"])
    model.graph.node.append(node)
    _save(path, model)


def wrong_result(path: Path, rng: np.random.Generator) -> None:
    """Return another shape or type than the next frame."""
    model = _load(path)
    model.graph.node[-1].output[0] = "sum"
    nodes = (
        helper.make_node("ReduceSum", ["sum"], ["next_position"], keepdims=0),
        helper.make_node("Transpose", ["sum"], ["next_position"], perm=[2, 1, 0]),
        helper.make_node("Concat", ["sum", "sum"], ["next_position"], axis=1),
        helper.make_node("Cast", ["sum"], ["next_position"], to=TensorProto.DOUBLE),
    )
    model.graph.node.append(nodes[rng.integers(len(nodes))])
    _save(path, model)


def greedy(path: Path, rng: np.random.Generator) -> None:
    """Let the model multiply square matrices, for more time or memory than it has."""
    # a matrix of side 3,000 takes too long, one of side 10^6 has 4 TB
    side = (3_000, 10**6)[rng.integers(2)]
    shape = numpy_helper.from_array(np.array([side, side], np.int64), "shape")
    model = _load(path)
    model.graph.initializer.append(shape)
    model.graph.node[-1].output[0] = "sum"
    nodes = [
        helper.make_node("ReduceSum", ["sum"], ["seed"], keepdims=0),
        helper.make_node("Expand", ["seed", "shape"], ["m0"]),
    ]
    for i in range(300):
        nodes.append(helper.make_node("MatMul", [f"m{i}", f"m{i}"], [f"m{i + 1}"]))
    nodes += [
        helper.make_node("ReduceSum", ["m300"], ["total"], keepdims=0),
        helper.make_node("Add", ["sum", "total"], ["next_position"]),
    ]
    model.graph.node.extend(nodes)
    _save(path, model)


ONNX: tuple[Mutation, ...] = (
    remove_a_node,
    repeat_a_node,
    other_operator,
    other_domain,
    other_opset,
    other_index,
    other_dimensions,
    other_tensor_type,
    external_data,
    other_names,
    hostile_values,
    hostile_values,
    wrong_result,
    greedy,
)


# --- weights --------------------------------------------------------------------------


def _edit_weights(path: Path, edit: Callable[[Content], None]) -> None:
    """Change a checkpoint; its description is a JSON text."""
    content = torch.load(path, weights_only=True)
    content["about"] = json.loads(content["about"])
    edit(content)
    if "about" in content:
        content["about"] = json.dumps(content["about"])
    torch.save(content, path)


def _choose(rng: np.random.Generator, content: dict[str, Any]) -> str:
    names = sorted(content)
    return names[rng.integers(len(names))]


def _mappings(about: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the description and all mappings in it that are not empty."""
    mappings = [about]
    for value in about.values():
        if isinstance(value, dict) and value:
            mappings.append(value)
    return mappings


def remove_from_weights(path: Path, rng: np.random.Generator) -> None:
    """Remove a key of the checkpoint, of its options or of its tensors."""

    def edit(content: Content) -> None:
        holders = [content, content["weights"], *_mappings(content["about"])]
        holder = holders[rng.integers(len(holders))]
        del holder[_choose(rng, holder)]

    _edit_weights(path, edit)


def wrong_option(path: Path, rng: np.random.Generator) -> None:
    """Give an option of the model, or a fact of its data, another value."""
    values: tuple[Any, ...] = (-1, 0, 10**9, 1e300, float("nan"), "", [], None, "../x")
    value = values[rng.integers(len(values))]

    def edit(content: Content) -> None:
        holders = _mappings(content["about"])
        holder = holders[rng.integers(len(holders))]
        holder[_choose(rng, holder)] = value

    _edit_weights(path, edit)


def wrong_tensor(path: Path, rng: np.random.Generator) -> None:
    """Change a tensor: values, type or shape."""
    kind = int(rng.integers(6))

    def edit(content: Content) -> None:
        tensors = content["weights"]
        name = _choose(rng, tensors)
        value = tensors[name]
        changed = (
            torch.full_like(value, torch.nan) if value.is_floating_point() else value,
            torch.full_like(value, torch.inf) if value.is_floating_point() else value,
            value.double(),
            value.reshape(-1)[:-1],
            value.to(torch.int8),
            torch.zeros(1).expand(2**20, 2**20),
        )
        tensors[name] = changed[kind]

    _edit_weights(path, edit)


def extreme_tensor(path: Path, rng: np.random.Generator) -> None:
    """Fill a tensor with numbers near the ends of what may be accepted."""
    values = (3.0, -3.0, 2.0, -2.0, 2.999, 1e-30, 3.001, 1e30)
    value = values[rng.integers(len(values))]

    def edit(content: Content) -> None:
        tensors = content["weights"]
        name = _choose(rng, tensors)
        tensors[name] = torch.full_like(tensors[name], value)

    _edit_weights(path, edit)


def other_baseline(path: Path, rng: np.random.Generator) -> None:
    """Claim to be another model."""
    names = ("gns", "mlp", "var", "neuralmpm", "../x", "", "os.system", "\u202e")

    def edit(content: Content) -> None:
        content["about"]["baseline"] = names[rng.integers(len(names))]

    _edit_weights(path, edit)


def hostile_record(path: Path, rng: np.random.Generator) -> None:
    """Store a description that is no JSON, no mapping, deep, long or contradictory."""
    content = torch.load(path, weights_only=True)
    about = content["about"]
    texts: tuple[Any, ...] = (
        "",
        "null",
        "[]",
        "3",
        about[:-1],
        about + about,
        "[" * 100_000,
        '{"a": ' * 50_000,
        about.replace("{", '{"baseline": "mlp", ', 1),
        about.replace("0", "9" * 5_000, 1),
        about.replace("1", "1e999", 1),
        about.replace('"', '"\\u202e', 1),
        about + " " * (1 << 24),
        3,
        None,
        [about],
        torch.zeros(3),
    )
    content["about"] = texts[rng.integers(len(texts))]
    torch.save(content, path)


WEIGHTS: tuple[Mutation, ...] = (
    hostile_record,
    hostile_record,
    remove_from_weights,
    wrong_option,
    wrong_option,
    wrong_tensor,
    wrong_tensor,
    other_baseline,
)
