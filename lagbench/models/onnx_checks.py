"""The checks of an ONNX file, before anything in it is run.

A model may hold only operators of the standard domain that compute a fixed number of
steps on numbers: no loops, no functions, no operators of other domains, no data outside
the file. The file is parsed in a child process with limits, see :mod:`.onnx_model`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .formats import require_onnx_bytes

if TYPE_CHECKING:
    from onnx import GraphProto, NodeProto, TensorProto

MOST_BYTES = 16_000_000
"""Longest ONNX file [bytes]."""

LEAST_OPSET = 18
MOST_NODES = 20_000
STANDARD_DOMAINS = ("", "ai.onnx")

_OPERATOR_NAMES = (
    "Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh AveragePool "
    "BatchNormalization BitShift BitwiseAnd BitwiseNot BitwiseOr BitwiseXor Cast "
    "CastLike Ceil Celu Clip Compress Concat Constant ConstantOfShape Conv "
    "ConvTranspose Cos Cosh CumSum DepthToSpace Div Einsum Elu Equal Erf Exp Expand "
    "EyeLike Flatten Floor GRU Gather GatherElements GatherND Gelu Gemm "
    "GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual GridSample "
    "GroupNormalization HardSigmoid HardSwish Hardmax Identity InstanceNormalization "
    "IsInf IsNaN LSTM LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax "
    "MatMul Max MaxPool Mean Min Mish Mod Mul Neg NonZero Not OneHot Or PRelu Pad Pow "
    "RNN Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax "
    "ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize "
    "ReverseSequence Round ScatterElements ScatterND Selu Shape Sigmoid Sign Sin Sinh "
    "Size Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tan "
    "Tanh ThresholdedRelu Tile TopK Transpose Trilu Unique Unsqueeze Where Xor "
)

OPERATORS = frozenset(_OPERATOR_NAMES.split())
"""Operators that a model may use: those of the standard domain that neither loop nor
branch, draw random numbers, work on text, sequences or images, or call functions.
"""

SIGNATURE = {
    "position": (("float32", "float64"), 3),
    "material": (("int64",), 1),
    "bounds": (("float32", "float64"), 2),
    "periodic": (("bool",), 1),
    "wall_velocity": (("float32", "float64"), 3),
    "viscosity": (("float32", "float64"), 0),
    "body_force": (("float32", "float64"), 3),
    "obstacle": (("float32", "float64"), 1),
    "edges": (("int64",), 2),
}
"""Inputs that a model may have, by name: element types and number of axes."""

REQUIRED = "position"
OUTPUT = "next_position"
OUTPUT_TYPES = ("float32", "float64")

SPLIT_KEY = "lagbench_split"
SIZE_KEY = "lagbench_size"
"""Keys of the metadata that state the data set of a model."""

MOST_NAME = 64
"""Longest name of a split or size; of a longer one only the beginning is returned."""

TYPE_NAMES = {1: "float32", 7: "int64", 9: "bool", 11: "float64"}
"""Element types of the signature by their number in ONNX."""


class RefusedError(Exception):
    """A model breaks a rule of the checks."""


def examine(path: str) -> dict[str, Any]:
    """Return what an ONNX file declares, or why it is refused.

    It is run in a child process: the parser of a stranger's file is code in C.

    Returns:
        ``refused`` with the reason; else ``inputs`` (element type by name), ``output``
        (its element type), ``parameters`` (numbers in the initialisers), ``split`` and
        ``size`` (the data set that the metadata state, unchecked, or None).
    """
    import onnx

    try:
        require_onnx_bytes(Path(path), longest=MOST_BYTES)
        try:
            model = onnx.load(path, load_external_data=False)
        except Exception as error:  # protobuf raises its own types
            raise RefusedError(
                f"it cannot be parsed: {type(error).__name__}"
            ) from error
        _check_versions(model)
        parameters = _check_graph(model.graph)
        inputs = _check_inputs(model.graph)
        output = _check_output(model.graph)
        split = _stated_name(model, SPLIT_KEY)
        size = _stated_name(model, SIZE_KEY)
    except RefusedError as error:
        return {"refused": str(error)[:300]}
    return {
        "refused": None,
        "inputs": inputs,
        "output": output,
        "parameters": parameters,
        "split": split,
        "size": size,
    }


def _stated_name(model: Any, key: str) -> str | None:  # noqa: ANN401
    """Return the name that the metadata of a model have under a key, or None."""
    for entry in model.metadata_props:
        if entry.key == key:
            return str(entry.value[: MOST_NAME + 1])
    return None


def _check_versions(model: Any) -> None:  # noqa: ANN401
    if len(model.functions) > 0:
        raise RefusedError("functions of its own, which may call each other")
    if len(model.training_info) > 0:
        raise RefusedError("graphs of a training")
    opsets = {}
    for opset in model.opset_import:
        if opset.domain not in STANDARD_DOMAINS:
            raise RefusedError(f"operators of the domain {opset.domain!a}")
        opsets[opset.domain] = opset.version
    newest = max(opsets.values(), default=0)
    if newest < LEAST_OPSET:
        raise RefusedError(f"opset {newest}, expected at least {LEAST_OPSET}")


def _check_graph(graph: GraphProto) -> int:
    """Check nodes and tensors of a graph; return how many numbers its tensors hold."""
    if len(graph.node) > MOST_NODES:
        raise RefusedError(f"{len(graph.node)} operators, at most {MOST_NODES}")
    if len(graph.sparse_initializer) > 0:
        raise RefusedError("sparse tensors")
    for node in graph.node:
        if node.domain not in STANDARD_DOMAINS:
            raise RefusedError(f"an operator of the domain {node.domain!a}")
        if node.op_type not in OPERATORS:
            raise RefusedError(f"the operator {node.op_type[:60]!a}")
    count = 0
    for tensor in _tensors(graph):
        count += _check_tensor(tensor)
    return count


def _tensors(graph: GraphProto) -> Iterator[TensorProto]:
    """Yield initialisers and constants; refuse graphs inside operators."""
    yield from graph.initializer
    for node in graph.node:
        yield from _constants(node)


def _constants(node: NodeProto) -> Iterator[TensorProto]:
    for attribute in node.attribute:
        has_graph = attribute.HasField("g") or len(attribute.graphs) > 0
        has_sparse = attribute.HasField("sparse_tensor")
        if has_graph or has_sparse or len(attribute.sparse_tensors) > 0:
            raise RefusedError("a graph or a sparse tensor inside an operator")
        if attribute.HasField("t"):
            yield attribute.t
        yield from attribute.tensors


def _check_tensor(tensor: TensorProto) -> int:
    """Check that a tensor lies in the file; return how many numbers it holds."""
    if tensor.data_location != 0 or len(tensor.external_data) > 0:
        raise RefusedError(f"data outside the file: tensor {tensor.name[:60]!a}")
    count = 1
    for length in tensor.dims:
        if length < 0:
            raise RefusedError(f"a negative length: tensor {tensor.name[:60]!a}")
        count *= length
    # eight numbers of one bit are the most that a byte can hold
    if count > 8 * MOST_BYTES:
        raise RefusedError(f"a tensor of {count} numbers: {tensor.name[:60]!a}")
    return count


def _check_inputs(graph: GraphProto) -> dict[str, str]:
    initialisers = {tensor.name for tensor in graph.initializer}
    inputs = {}
    for value in graph.input:
        if value.name in initialisers:
            continue
        if value.name not in SIGNATURE:
            known = ", ".join(SIGNATURE)
            raise RefusedError(f"the input {value.name[:60]!a}; known are {known}")
        types, axes = SIGNATURE[value.name]
        inputs[value.name] = _check_value(value, types, axes)
    if REQUIRED not in inputs:
        raise RefusedError(f"no input {REQUIRED}")
    return inputs


def _check_output(graph: GraphProto) -> str:
    names = [value.name for value in graph.output]
    if names != [OUTPUT]:
        shown = ", ".join(ascii(name)[:60] for name in names[:5])
        raise RefusedError(f"the outputs {shown}; expected one, {OUTPUT}")
    return _check_value(graph.output[0], OUTPUT_TYPES, None)


def _check_value(value: Any, types: tuple[str, ...], axes: int | None) -> str:  # noqa: ANN401
    """Check element type and number of axes of an input or output; return the type."""
    tensor_type = value.type.tensor_type
    name = TYPE_NAMES.get(tensor_type.elem_type, f"type {tensor_type.elem_type}")
    if name not in types:
        raise RefusedError(f"{value.name} of {name}, expected {' or '.join(types)}")
    if axes is not None and tensor_type.HasField("shape"):
        got = len(tensor_type.shape.dim)
        if got != axes:
            raise RefusedError(f"{value.name} with {got} axes, expected {axes}")
    return name
