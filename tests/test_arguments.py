"""Public functions refuse arguments of a wrong kind in one way."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lagbench
from lagbench import exchange, submission
from lagbench import torch as lagbench_torch
from lagbench.arguments import (
    ALIASES,
    UNCHECKED,
    check_argument,
    find_kinds,
    list_members,
)
from lagbench.errors import LagbenchError, UsageError
from lagbench.models.export import export_onnx
from lagbench.models.registered import build_registered, export_safetensors

PUBLIC_MODULES = (lagbench, exchange, submission, lagbench_torch)

WITHOUT_ARGUMENTS = {"list_splits"}

INTERNAL = {
    "Batch",
    "Header",
    "Predictions",
    "TemplateResult",
    "ValidationIssue",
    "ValidationResult",
    "Window",
    "collate",
    "tensors",
}
"""What users receive and do not make, and what a DataLoader calls."""


def list_public_functions() -> dict[str, Callable[..., Any]]:
    """Return the functions, and classes to construct, that users call."""
    functions: dict[str, Callable[..., Any]] = {
        "export_onnx": export_onnx,
        "build_registered": build_registered,
        "export_safetensors": export_safetensors,
    }
    for module in PUBLIC_MODULES:
        for name in module.__all__:
            value = getattr(module, name)
            is_made = inspect.isfunction(value) or inspect.isclass(value)
            is_enum = inspect.isclass(value) and hasattr(value, "__members__")
            if is_made and not is_enum and name not in INTERNAL | WITHOUT_ARGUMENTS:
                functions[name] = value
    return functions


FUNCTIONS = list_public_functions()


def list_parameters() -> list[tuple[str, str]]:
    """Return functions and the names of their parameters that have a kind."""
    pairs = []
    for name, function in FUNCTIONS.items():
        for parameter in inspect.signature(function).parameters.values():
            if parameter.kind is inspect.Parameter.VAR_KEYWORD:
                continue
            if UNCHECKED.isdisjoint(list_members(str(parameter.annotation))):
                pairs.append((name, parameter.name))
    return pairs


class Wrong:
    """A value of no kind that a function takes."""

    def __repr__(self) -> str:
        """Return what messages say of it."""
        return "<wrong>"


def placeholder(annotation: str) -> Any:
    """Return a value of the first kind of an annotation."""
    kind = list_members(annotation)[0].partition("[")[0]
    values: dict[str, Any] = {"str": "cavity", "int": 1, "Callable": print}
    if kind in values:
        return values[kind]
    return type(kind, (), {})()


@pytest.mark.parametrize(("name", "wrong"), list_parameters())
def test_each_parameter_of_public_functions_has_a_checked_kind(
    name: str, wrong: str
) -> None:
    """Before any work, the message names the function and the argument."""
    function = FUNCTIONS[name]
    arguments: dict[str, Any] = {}
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name == wrong:
            arguments[wrong] = Wrong()
            break
        if parameter.default is inspect.Parameter.empty:
            arguments[parameter.name] = placeholder(str(parameter.annotation))
    for parameter in inspect.signature(function).parameters.values():
        is_needed = parameter.default is inspect.Parameter.empty
        is_named = parameter.kind is not inspect.Parameter.VAR_KEYWORD
        if is_needed and is_named and parameter.name not in arguments:
            arguments[parameter.name] = None

    with pytest.raises(UsageError) as caught:
        function(**arguments)
    error = caught.value
    assert error.where == f"{name}, {wrong}"
    assert error.expected
    assert error.got == "<wrong>"
    assert error.fix


@pytest.mark.parametrize(
    ("call", "where", "fix"),
    [
        (lambda: lagbench.score(3), "score, predictions", 'predictions="..."'),
        (lambda: lagbench.compare("p.nc", 3), "compare, second", 'second="..."'),
        (
            lambda: lagbench.generate("cavity", "tiny", subset=3),
            "generate, subset",
            "leave subset out",
        ),
        (
            lambda: lagbench.generate("cavity", "tiny", scenarios=3),
            "generate, scenarios",
            "put it into brackets: scenarios=[3]",
        ),
        (
            lambda: lagbench.verify("cavity", "tiny", regenerate="1"),
            "verify, regenerate",
            "without quotes: regenerate=1",
        ),
        (
            lambda: lagbench.verify("cavity", "tiny", regenerate=True),
            "verify, regenerate",
            "such a value: regenerate=2",
        ),
        (
            lambda: lagbench.verify("cavity", "tiny", complete="no"),
            "verify, complete",
            "complete=True",
        ),
        (
            lambda: lagbench.generate("cavity", "tiny", gather="folder"),
            "generate, gather",
            "brackets: gather=['folder']",
        ),
        (
            lambda: lagbench.generate("cavity", "tiny", scenarios=np.array(3)),
            "generate, scenarios",
            "brackets: scenarios=[3]",
        ),
        (
            lambda: lagbench.generate("cavity", "tiny", subset=np.array("train")),
            "generate, subset",
            "leave subset out",
        ),
        (
            lambda: lagbench.compare("p.nc", "q.nc", metrics=iter(["mse_end"])),
            "compare, metrics",
            "metrics=list(...)",
        ),
        (
            lambda: lagbench.verify("cavity", "tiny", regenerate="1.5"),
            "verify, regenerate",
            "a whole number without quotes, as in regenerate=2",
        ),
        (
            lambda: lagbench.open_split("cavity", subset=None),
            "open_split, subset",
            'subset="..."',
        ),
        (lambda: lagbench_torch.WindowDataset(3), "WindowDataset, split", "split="),
        (
            lambda: lagbench_torch.WindowDataset("cavity", history=True),
            "WindowDataset, history",
            "history=2",
        ),
        (
            lambda: lagbench.windows("cavity", future=2.0),
            "windows, future",
            "write future=2, not future=2.0",
        ),
        (
            lambda: lagbench.submission.write("p.nc", {}, split=3, method="m"),
            "write, split",
            "split=",
        ),
    ],
)
def test_arguments_of_a_wrong_kind_are_usage_errors(
    call: Callable[[], Any], where: str, fix: str
) -> None:
    """The message names the function, the argument and what to write."""
    with pytest.raises(UsageError) as caught:
        call()
    assert caught.value.where == where
    assert fix in str(caught.value.fix)


@pytest.mark.parametrize(
    ("value", "annotation"),
    [
        (np.int64(3), "int"),
        (np.float32(3), "float"),
        (3, "float"),
        (10**400, "float"),
        (np.True_, "bool"),
        (Path("a"), "str | Path"),
        (range(3), "Scenarios"),
        (np.arange(3), "Scenarios"),
        (iter([3]), "Scenarios"),
        (("train", "valid"), "Selection"),
        (print, "Callable[[int], None] | None"),
    ],
)
def test_values_of_the_right_kind_are_accepted(value: object, annotation: str) -> None:
    """Numbers of NumPy count as numbers; items of an iterator are not consumed."""
    check_argument("name", value, find_kinds(annotation), where="function")


@pytest.mark.parametrize(
    ("value", "annotation"),
    [
        (True, "int"),
        (np.True_, "int"),
        (True, "float"),
        ("3", "int | None"),
        (b"a", "str | Path"),
        (1, "bool"),
        ([3], "Selection"),
        ([True], "Scenarios"),
        (np.array(3), "Scenarios"),
        (np.array("train"), "Selection"),
        (iter(["train"]), "Selection"),
        (iter(["mse_end"]), "Collection[str]"),
        pytest.param(10**5000, "str | Path", id="too-long"),
        ([10**5000], "Selection"),
        (Fraction(10**400), "int"),
        (float("inf"), "int"),
        (float("nan"), "int"),
    ],
)
def test_values_of_a_wrong_kind_are_refused(value: object, annotation: str) -> None:
    """True is no number, and a list is no better than what it holds."""
    with pytest.raises(UsageError):
        check_argument("name", value, find_kinds(annotation), where="function")


@pytest.mark.parametrize(
    ("value", "annotation"),
    [
        ("1", "int"),
        ("007", "int"),
        ("2.0", "int | None"),
        ("1e3", "int"),
        ("1.5", "int"),
        ("1e400", "float"),
        ("0.5", "float"),
        ("9" * 5000, "int"),
        (1e300, "int"),
        (Fraction(10**400), "int"),
        (3, "Scenarios"),
        (np.int64(3), "Scenarios"),
        ("mse_end", "Sequence[str]"),
        (Path("a"), "Sequence[str | Path]"),
    ],
)
def test_advised_values_are_accepted(value: object, annotation: str) -> None:
    """Who types the advice is not refused again."""
    kinds = find_kinds(annotation)
    with pytest.raises(UsageError) as caught:
        check_argument("name", value, kinds, where="function")
    advice = re.search(r"name=([^,]+)", str(caught.value.fix))
    assert advice is not None
    check_argument("name", ast.literal_eval(advice[1]), kinds, where="function")


@pytest.mark.parametrize("annotation", ["str | Path | None", "Sequence[str | Path]"])
@pytest.mark.parametrize(
    "path", ["a" * 300, "a/" * 3000, "a\0b", "\ud800", Path("b" * 300), "\udcff" * 300]
)
def test_a_path_that_no_disk_can_hold_is_a_usage_error(
    path: str | Path, annotation: str
) -> None:
    """Paths are looked at before any work, those in lists too."""
    value = [path] if annotation.startswith("Sequence") else path
    with pytest.raises(UsageError, match="no file can have that name") as caught:
        check_argument("name", value, find_kinds(annotation), where="function")
    assert caught.value.where == "function, name"
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("path", ["a" * 255, "s3://bucket/" + "a" * 300, "\udcff"])
def test_a_path_that_a_disk_or_store_can_hold_is_accepted(path: str) -> None:
    """Keys of stores may be longer, and names need not be UTF-8."""
    check_argument("name", path, find_kinds("str | Path"), where="function")


def test_a_range_is_not_counted() -> None:
    """Its numbers are whole, however many there are."""
    check_argument("name", range(10**15), find_kinds("Scenarios"), where="function")


def test_advice_repeats_no_part_of_a_long_text() -> None:
    """Half a name cannot be typed."""
    with pytest.raises(UsageError) as caught:
        check_argument("name", "a" * 200, find_kinds("Sequence[str]"), where="function")
    assert str(caught.value.fix).endswith("name=[...]")


@pytest.mark.parametrize(
    ("value", "annotation"), [(72.5, "dpi"), (0, "device"), ("mse_end", "metrics")]
)
def test_values_with_two_kinds_are_accepted(value: object, annotation: str) -> None:
    """Pixels per inch have fractions, a device a number, and one metric is a text."""
    functions: dict[str, Any] = {
        "dpi": lagbench.plot,
        "device": lagbench_torch.predict,
        "metrics": lagbench.compare,
    }
    parameters = inspect.signature(functions[annotation]).parameters
    kinds = find_kinds(str(parameters[annotation].annotation))
    check_argument(annotation, value, kinds, where="function")


def test_one_extra_is_a_text() -> None:
    """The name of one extra needs no brackets; the error names the missing file."""
    with pytest.raises(LagbenchError) as caught:
        lagbench.score("p.nc", extras="transport")
    assert "extras" not in str(caught.value.where)


def test_folders_of_local_splits_may_be_paths() -> None:
    """A split is named by a text, or by the path of its folder."""
    for name, function in FUNCTIONS.items():
        parameters = inspect.signature(function).parameters
        if "split" in parameters:
            members = list_members(str(parameters["split"].annotation))
            assert "Path" in members, name


ANY: Any = lagbench
"""The package, for calls that a type checker refuses."""


@pytest.mark.parametrize(
    ("call", "where", "fix"),
    [
        (
            lambda: ANY.windows("cavity", "tiny", subsets="test"),
            "windows, subsets",
            "did you mean 'subset'?",
        ),
        (
            lambda: ANY.open_split("cavity", "tiny", "test"),
            "open_split",
            "one of: subset=, root=",
        ),
        (lambda: ANY.score("p.nc", "out"), "score", "output_dir="),
        (lambda: ANY.generate(), "generate, split", "add split=..."),
        (
            lambda: ANY.generate("cavity", "tiny", size="mini"),
            "generate, size",
            "leave one of the two out",
        ),
        (
            lambda: lagbench_torch.WindowDataset("cavity", "tiny", futur=2),  # type: ignore[call-arg]
            "WindowDataset, futur",
            "did you mean 'future'?",
        ),
        (
            lambda: lagbench.submission.write("p.nc", split="cavity"),  # type: ignore[call-arg]
            "write, positions",
            "add positions=...",
        ),
    ],
)
def test_calls_that_do_not_fit_are_errors_of_usage_and_of_type(
    call: Callable[[], Any], where: str, fix: str
) -> None:
    """The message names the function, the argument and what to write."""
    with pytest.raises(TypeError) as caught:
        call()
    error = caught.value
    assert isinstance(error, UsageError)
    assert error.where == where
    assert fix in str(error.fix)
    assert error.expected
    assert error.got
    assert error.__context__ is None


def test_size_is_the_second_argument_behind_split() -> None:
    """A call that works with generate works with what reads the data as well."""
    names = []
    for name, function in FUNCTIONS.items():
        parameters = list(inspect.signature(function).parameters.values())
        if parameters and parameters[0].name == "split":
            assert parameters[1].name == "size", name
            assert parameters[1].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD, name
            names.append(name)
    assert {"generate", "open_split", "windows", "WindowDataset"} <= set(names)


def test_the_result_of_a_validation_is_short_until_printed(tmp_path: Path) -> None:
    """Its repr has the verdict and counts; print shows all issues too."""
    path = tmp_path / "p.nc"
    path.write_text("no predictions")
    result = lagbench.validate(path, isolated=False)
    assert (
        repr(result) == f"<ValidationResult of {path}: not valid, 1 error, 0 warnings>"
    )
    assert str(result.errors[0]) in str(result)
    assert str(result).endswith(
        f"{path}: not valid, 1 error, 0 warnings, 0 checks passed"
    )


def test_aliases_are_those_of_the_modules() -> None:
    """The texts of selections are written once more here, so they are compared."""
    from lagbench.make import plan

    assert str(plan.Selection).replace("collections.abc.", "") == ALIASES["Selection"]
    assert str(plan.Scenarios).replace("collections.abc.", "") == ALIASES["Scenarios"]
