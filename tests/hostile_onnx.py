"""ONNX files for tests: sound ones and hostile ones."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from lagbench.models.onnx_rollout import forbid_files

FLOAT = TensorProto.FLOAT


def save_model(
    path: Path,
    nodes: list[Any],
    *,
    initialisers: list[Any] | None = None,
    inputs: list[Any] | None = None,
    opsets: dict[str, int] | None = None,
    functions: list[Any] | None = None,
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
    imports = []
    versions = opsets or {"": 18}
    for domain, version in versions.items():
        imports.append(helper.make_opsetid(domain, version))
    model = helper.make_model(
        graph,
        opset_imports=imports,
        functions=functions or [],
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


def custom_domain(path: Path) -> Path:
    """Use an operator that a shared library would have to bring."""
    run = node("Run", ["position"], "next_position", domain="evil")
    return save_model(path, [run], opsets={"": 18, "evil": 1})


def own_function(path: Path) -> Path:
    """Call a function that the model defines."""
    function = helper.make_function(
        "own",
        "F",
        ["x"],
        ["y"],
        [node("Identity", ["x"], "y")],
        [helper.make_opsetid("", 18)],
    )
    call = node("F", ["position"], "next_position", domain="own")
    opsets = {"": 18, "own": 1}
    return save_model(path, [call], opsets=opsets, functions=[function])


def endless_loop(path: Path) -> Path:
    """Loop as often as a 64-bit number can count."""
    body = helper.make_graph(
        [
            node("Identity", ["go"], "go_on"),
            node("Identity", ["x"], "x_next"),
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            value("x", GIVEN_POSITIONS),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            value("x_next", GIVEN_POSITIONS),
        ],
    )
    yes = numpy_helper.from_array(np.array(True), "yes")
    count = numpy_helper.from_array(np.array(2**62, np.int64), "count")
    loop = node("Loop", ["count", "yes", "position"], "next_position", body=body)
    return save_model(path, [loop], initialisers=[count, yes])


def huge_shape(path: Path) -> Path:
    """Fill 10^12 numbers with zero."""
    nodes = [
        node("ConstantOfShape", ["shape"], "zeros"),
        node("ReduceSum", ["zeros"], "sum", keepdims=0),
        node("Add", ["position", "sum"], "next_position"),
    ]
    shape = integers("shape", 1_000_000, 1_000_000)
    return save_model(path, nodes, initialisers=[shape])


def long_work(path: Path) -> Path:
    """Multiply large matrices many times: no loop, and no end in sight."""
    nodes = [
        node("ReduceSum", ["position"], "seed", keepdims=0),
        node("Expand", ["seed", "shape"], "m0"),
        *products("m", 200),
        node("ReduceSum", ["m200"], "sum", keepdims=0),
        node("Add", ["position", "sum"], "next_position"),
    ]
    shape = integers("shape", 3000, 3000)
    return save_model(path, nodes, initialisers=[shape])


def products(name: str, count: int) -> list[Any]:
    """Return nodes that square a matrix so many times, from ``name0`` on."""
    nodes = []
    for number in range(count):
        matrix = f"{name}{number}"
        nodes.append(node("MatMul", [matrix, matrix], f"{name}{number + 1}"))
    return nodes


def constant_work(path: Path) -> Path:
    """Multiply large matrices that are constants: they are computed while it loads."""
    nodes = [
        node("ConstantOfShape", ["shape"], "m0"),
        *products("m", 200),
        node("ReduceSum", ["m200"], "sum", keepdims=0),
        node("Add", ["position", "sum"], "next_position"),
    ]
    shape = integers("shape", 3000, 3000)
    return save_model(path, nodes, initialisers=[shape])


def works_later(path: Path) -> Path:
    """Let nothing move; multiply large matrices once the last frames are equal."""
    zero = numpy_helper.from_array(np.array(0, np.float32), "zero")
    nodes = [
        node("Gather", ["position", "last"], "now", axis=0),
        node("Gather", ["position", "before"], "past", axis=0),
        node("Sub", ["now", "past"], "step"),
        node("Abs", ["step"], "distance"),
        node("ReduceMax", ["distance"], "largest", keepdims=0),
        node("Equal", ["largest", "zero"], "at_rest"),
        node("Where", ["at_rest", "large", "small"], "shape"),
        node("Expand", ["zero", "shape"], "m0"),
        *products("m", 200),
        node("ReduceSum", ["m200"], "sum", keepdims=0),
        node("Add", ["now", "sum"], "next_position"),
    ]
    constants = [
        zero,
        integers("last", -1),
        integers("before", -2),
        integers("large", 3000, 3000),
        integers("small", 1, 1),
    ]
    return save_model(path, nodes, initialisers=constants)


def large_constant(path: Path) -> Path:
    """Be a sparse file of two gigabytes."""
    straight_on(path)
    with path.open("r+b") as stream:
        stream.truncate(2 << 30)
    return path


def claimed_constant(path: Path) -> Path:
    """Claim a tensor of 10^12 numbers that the file does not hold."""
    straight_on(path)
    model = onnx.load(path)
    tensor = model.graph.initializer[0]
    del tensor.dims[:]
    tensor.dims.extend([1_000_000, 1_000_000])
    path.write_bytes(model.SerializeToString())
    return path


class _Runs:
    """Runs a command where it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("hostile-pickle-ran"),))


def pickle_as_onnx(path: Path) -> Path:
    """Be a pickle under another suffix."""
    path.write_bytes(pickle.dumps(_Runs()))
    return path


def torchscript_as_onnx(path: Path) -> Path:
    """Be an archive of TorchScript under another suffix."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/code/__torch__.py", "")
        archive.writestr("model/data.pkl", b"")
    return path


def torch_export_as_onnx(path: Path) -> Path:
    """Be an archive of torch.export under another suffix."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/models/model.json", "{}")
        archive.writestr("model/archive_format", "pt2")
    return path


def random_numbers(path: Path) -> Path:
    """Draw random numbers, so that no run is like another."""
    draw = node("RandomNormalLike", ["position"], "next_position")
    return save_model(path, [draw])


def other_input(path: Path) -> Path:
    """Ask for something that no model is given."""
    inputs = [value("future", GIVEN_POSITIONS)]
    copy = node("Identity", ["future"], "next_position")
    return save_model(path, [copy], inputs=inputs)


def old_opset(path: Path) -> Path:
    """Use operators of an old version."""
    copy = node("Identity", ["position"], "next_position")
    return save_model(path, [copy], opsets={"": 13})


def damaged(path: Path) -> Path:
    """Be bytes that are no ONNX."""
    path.write_bytes(b"\xff" * 4000)
    return path


Make = Callable[[Path], Path]

REFUSED: tuple[Make, ...] = (
    external_data,
    custom_domain,
    own_function,
    endless_loop,
    large_constant,
    claimed_constant,
    pickle_as_onnx,
    torchscript_as_onnx,
    torch_export_as_onnx,
    random_numbers,
    other_input,
    old_opset,
    damaged,
)
"""Files that the checks refuse."""

STOPPED: tuple[Make, ...] = (huge_shape, long_work, constant_work)
"""Files that the checks let pass, and that the limits of a rollout stop."""


def write_a_file(path: str) -> str:
    """Try to write, as a model that found a way would."""
    forbid_files()
    try:
        Path(path).write_bytes(b"1")
    except OSError as error:
        return type(error).__name__
    return "written"
