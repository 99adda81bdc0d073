"""Checkpoints: tensors and JSON text in a file that cannot run code.

A file of ``torch.save`` with plain entries: ``lagbench_checkpoint`` (format number),
``about`` (JSON: baseline, model options, dataset info, training log), ``weights``, and,
for resuming, ``optimizer``. It is read with ``weights_only=True``, which refuses a file
with any other object in it. So a stranger's file runs no code. The one threat that is
left is memory: an archive of a few kilobytes may unpack to more than the machine has.
So the size that its members state is limited. Options may ask for a model beyond all
memory, or for layers without end: :func:`restore` stops building a model that has far
more parameters than the file has numbers.

A file named ``.safetensors`` holds the weights and the text ``about``, see
:mod:`.safetensors_file`.
"""

from __future__ import annotations

import json
import pickle
import re
import threading
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from lagbench.atomic import atomic_path, explain_write_error
from lagbench.data.box import Box, parse_periodic
from lagbench.data.field_errors import describe_expectation, describe_input
from lagbench.data.hdf5 import SIGNATURE as HDF5_SIGNATURE
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    check_regular,
)
from lagbench.submission.budget import Budget, parse_budget

from .baseline import Baseline, DatasetInfo
from .catalogue import find
from .dataset_info import read_dataset_info
from .safetensors_file import SUFFIX, read_tensors, write_tensors

FORMAT = 1
KEY = "lagbench_checkpoint"
EXPECTED = "a checkpoint that lagbench train wrote"
RECIPE_NAME = r"^[A-Za-z0-9._/*-]{1,100}$"  # in a file of weights to start from
MOST_BYTES = 4 << 30  # of an unpacked checkpoint
# beyond twice the numbers of a file: layers that are built and not kept
FREE_PARAMETERS = 100_000
# the name of a foreign function in torch's refusal of a pickle
_FOREIGN_NAME = re.compile(r"GLOBAL ([\w.]+)")
# the first bytes of a pickle
_PICKLE_HEADS = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A model with all that it needs to predict, and to train on."""

    baseline: str  # name of the baseline
    options: Mapping[str, Any]  # options of the model, plain values
    info: DatasetInfo  # public figures of the data set of its training
    weights: Mapping[str, Tensor]  # parameters and buffers by name
    # log of the training so far, plain values
    training: Mapping[str, Any] = field(default_factory=dict)
    # state of the optimiser; None in a file that is for predictions only
    optimizer: Mapping[str, Any] | None = None

    @property
    def budget(self) -> Budget | None:
        """Budget of the training; None where it is unknown."""
        return parse_budget(json.dumps(self.training.get("budget")))


class _LogPart(BaseModel):
    """The keys of a training log that are read again; other keys pass unchecked."""

    model_config = ConfigDict(extra="allow")


class _LoggedOptions(_LogPart):
    seed: int = Field(default=0, ge=0, lt=2**63)
    windows: tuple[str, ...] = ("train",)


class _LoggedStart(_LogPart):
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    recipe: str = Field(pattern=RECIPE_NAME)


class _LoggedRecipe(_LogPart):
    name: str = Field(default="", max_length=200)
    training: _LoggedOptions = _LoggedOptions()
    start: _LoggedStart | None = None


class _LoggedTraining(_LogPart):
    step: int = Field(default=0, ge=0)
    recipe: _LoggedRecipe = _LoggedRecipe()


def save(path: Path, checkpoint: Checkpoint, *, replaced: Iterable[Path] = ()) -> None:
    """Write a checkpoint; it appears whole or not at all.

    Args:
        path: the file; weights alone may have the ending of safetensors.
        checkpoint: what to write.
        replaced: other files that it replaces; they are removed once it is written.

    Raises:
        UsageError: a weight is no tensor of plain numbers, or a file of safetensors
            would hold the state of an optimiser.
        WorkFailedError: the disk is full, or nobody may write there.
    """
    check_weights(checkpoint.weights, where=f"{path}, weights of {checkpoint.baseline}")
    facts = asdict(checkpoint.info)
    if not checkpoint.info.periodic:
        # Without the key the bytes of a box with walls are those of older versions.
        del facts["periodic"]
    about = {
        "baseline": checkpoint.baseline,
        "options": dict(checkpoint.options),
        "facts": facts,
        "training": dict(checkpoint.training),
    }
    if path.suffix == SUFFIX:
        if checkpoint.optimizer is not None:
            raise UsageError(
                "a file of safetensors holds weights only",
                where=str(path),
                expected="weights without the state of an optimiser",
                got="the state of an optimiser too",
                fix="save the weights without it",
            )
        write_tensors(path, json.dumps(about, sort_keys=True), checkpoint.weights)
        return
    weights = {}
    for name, tensor in checkpoint.weights.items():
        value = tensor.detach().cpu()
        if value.untyped_storage().nbytes() != value.numel() * value.element_size():
            # torch would store the memory that it is a view of.
            value = value.clone(memory_format=torch.contiguous_format)
        weights[name] = value
    content: dict[str, Any] = {
        KEY: FORMAT,
        "about": json.dumps(about, sort_keys=True),
        "weights": weights,
    }
    if checkpoint.optimizer is not None:
        content["optimizer"] = dict(checkpoint.optimizer)
    with atomic_path(path, option="--output", replaced=replaced) as temporary:
        try:
            torch.save(content, temporary)
        except RuntimeError as error:  # torch raises it for any error of the system
            raise explain_write_error(path, error, option="--output") from error


def check_weights(weights: Mapping[str, object], *, where: str) -> None:
    """Refuse weights that no file can hold.

    Args:
        weights: parameters, buffers and perhaps other values of a model by name.
        where: place of the weights, for the message.

    Raises:
        UsageError: a weight is no tensor of plain numbers.
    """
    for name, value in weights.items():
        got = type(value).__name__
        if isinstance(value, Tensor):
            if _has_plain_numbers(value):
                continue
            got = f"{value.dtype}, {value.layout} on {value.device}"
        raise UsageError(
            f"no file of weights can hold {name!r}",
            where=where,
            expected="a dense tensor of real numbers",
            got=got,
            fix="store real numbers, as those of torch.view_as_real; or register a "
            "buffer with persistent=False",
        )


def load(path: str | Path) -> Checkpoint:
    """Read a checkpoint; nothing in the file is run.

    Raises:
        UnreadableFileError: the file is no checkpoint, damaged, or too large.
    """
    file = Path(path)
    content: dict[str, Any]
    if file.suffix == SUFFIX:
        recipe_text, tensors = read_tensors(file)
        content = {KEY: FORMAT, "about": recipe_text, "weights": tensors}
    else:
        content = _load_content(file)
    try:
        if type(content[KEY]) is not int or content[KEY] != FORMAT:
            raise _unreadable(file, f"format {FORMAT}", f"format {content[KEY]!r}")
        about = json.loads(content["about"])
        _LoggedTraining.model_validate(about["training"])
        optimizer = content.get("optimizer")
        if optimizer is not None and not isinstance(optimizer, Mapping):
            raise TypeError("the state of the optimiser is no mapping")
        return Checkpoint(
            baseline=str(about["baseline"]),
            options=dict(about["options"]),
            info=_parse_info(about["facts"]),
            weights=_check_tensors(content["weights"]),
            training=dict(about["training"]),
            optimizer=optimizer,
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        one_line = " ".join(str(error).split())
        got = f"{type(error).__name__}: {one_line[:200]}"
        raise _unreadable(file, EXPECTED, got) from None


def _parse_info(facts: object) -> DatasetInfo:
    """Return the public figures of a data set, whose box is one.

    Raises:
        ValueError: a figure does not fit, a statistic does not have one number for each
            axis, or the box is none.
    """
    info: DatasetInfo = TypeAdapter(DatasetInfo).validate_python(facts)
    axes = len(info.bounds)
    for name, row in info.statistics.items():
        if len(row) != axes:
            raise ValueError(f"{name} has {len(row)} numbers for {axes} axes")
    try:
        Box.from_bounds(info.bounds, parse_periodic(info.periodic, len(info.bounds)))
    except UsageError as error:
        raise ValueError(f"{error.what}: {error.got}") from None
    return info


def _has_plain_numbers(tensor: Tensor) -> bool:
    """Return whether a tensor is dense and holds real numbers."""
    is_dense = tensor.layout is torch.strided and not tensor.is_meta
    return is_dense and not tensor.is_quantized and not tensor.is_complex()


def _check_tensors(weights: object) -> dict[str, Tensor]:
    """Return weights that are plain tensors by name.

    Raises:
        TypeError: they are something else, or a tensor states more numbers than it has.
    """
    if not isinstance(weights, Mapping):
        raise TypeError("weights are no mapping")
    for name, value in weights.items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise TypeError(f"weight {name!r} is no tensor")
        if not _has_plain_numbers(value):
            raise TypeError(f"weight {name!r} is no tensor of plain numbers")
        stated_bytes = value.numel() * value.element_size()
        if stated_bytes > value.untyped_storage().nbytes():
            raise TypeError(f"weight {name!r} has more numbers than the file holds")
    return dict(weights)


def _load_content(file: Path) -> dict[str, Any]:
    """Return the content of a file, if it is a dict with the key of checkpoints."""
    _check_archive(file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        foreign = _FOREIGN_NAME.search(str(error))
        if foreign is None:
            raise _unsafe(file, "a pickle of something else") from None
        raise _unsafe(file, f"a pickle that names {foreign[1][:100]!a}") from None
    except Exception as error:  # damaged archives raise nearly any type
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise _unreadable(file, EXPECTED, reason) from None
    if not isinstance(content, dict) or KEY not in content:
        raise _unreadable(file, EXPECTED, type(content).__name__)
    return content


def _check_archive(file: Path) -> None:
    """Refuse a file that is no archive, is damaged, or unpacks to too much memory."""
    hint = None
    # A path that the system refuses is an error of the check below.
    with suppress(OSError, ValueError):
        if (file / "weights.pt").is_file():
            hint = f"name the file: {file / 'weights.pt'}"
    check_regular(file, longest=MOST_BYTES, fix=hint)
    try:
        if not zipfile.is_zipfile(file):
            with file.open("rb") as stream:
                head = stream.read(len(HDF5_SIGNATURE))
            if head[:2] in _PICKLE_HEADS:
                raise _unsafe(file, "a pickle of something else")
            if head == HDF5_SIGNATURE:
                raise _unreadable(file, EXPECTED, "an HDF5 file, as predictions are")
            raise _unreadable(file, EXPECTED, "something else")
        with zipfile.ZipFile(file) as archive:
            unpacked_bytes = sum(member.file_size for member in archive.infolist())
            if unpacked_bytes > MOST_BYTES:
                raise _unreadable(
                    file, f"at most {MOST_BYTES} bytes", f"{unpacked_bytes} bytes"
                )
            damaged_member = archive.testzip()
    except LagbenchError:
        raise
    except Exception as error:  # damaged archives raise nearly any type
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise _unreadable(file, EXPECTED, reason) from None
    if damaged_member is not None:
        reason = f"{damaged_member[:100]!a} has another checksum than it states"
        raise _unreadable(file, EXPECTED, reason)


def _unsafe(file: Path, got: str) -> UnreadableFileError:
    return UnreadableFileError(
        "the file holds more than tensors and plain values, and was not opened",
        where=str(file),
        expected=EXPECTED,
        got=got,
        fix="do not load it otherwise either: such a file can run code",
    )


def _unreadable(file: Path, expected: str, got: str) -> UnreadableFileError:
    return UnreadableFileError(
        "not a checkpoint of lagbench",
        where=str(file),
        expected=expected,
        got=got,
        fix="name weights.pt or checkpoint.pt of a run, a .safetensors or an ONNX file",
    )


def restore(checkpoint: Checkpoint, *, where: str = "the checkpoint") -> Baseline:
    """Return the model of a checkpoint, in float32, ready to predict.

    Raises:
        UsageError: the baseline is not installed.
        UnreadableFileError: options or weights do not fit the model.
    """
    try:
        entry = find(checkpoint.baseline)
    except UsageError as error:
        raise UsageError(
            error.what,
            where=where,
            expected=error.expected,
            got=error.got,
            fix="install the package that adds it",
        ) from error
    file_numbers = sum(value.numel() for value in checkpoint.weights.values())
    try:
        with _limited_parameters(2 * file_numbers + FREE_PARAMETERS):
            model = entry.model.build(checkpoint.options, checkpoint.info)
    except ValidationError as error:
        detail = error.errors()[0]
        key = ".".join(map(str, detail["loc"]))
        raise UnreadableFileError(
            f"option {key!r} of the model does not fit",
            where=where,
            expected=describe_expectation(detail),
            got=describe_input(detail),
            fix=f"it is from another version of {checkpoint.baseline}; train anew",
        ) from None
    except (
        KeyError,
        TypeError,
        ValueError,
        ArithmeticError,
        MemoryError,
        RuntimeError,
    ) as error:
        first_line = str(error).split("\n")[0]
        raise UnreadableFileError(
            "no model can be built from it",
            where=where,
            expected=f"options of {checkpoint.baseline}",
            got=f"{type(error).__name__}: {first_line[:200]}",
            fix="train anew with this version of lagbench",
        ) from None
    load_weights(model, checkpoint.weights, where=where)
    return model.eval()


@contextmanager
def _limited_parameters(limit: int) -> Iterator[None]:
    """Stop the building of a model in this thread once it has too many parameters.

    Layers register a parameter before they draw its numbers. So memory that is asked
    for is not touched yet, and no time is lost with it.

    Raises:
        ValueError: the layers that are built within have more numbers than ``limit``.
    """
    thread = threading.get_ident()
    count = 0

    def count_numbers(module: nn.Module, name: str, parameter: nn.Parameter) -> None:
        nonlocal count
        if threading.get_ident() != thread or nn.parameter.is_lazy(parameter):
            return
        count += parameter.numel()
        if count > limit:
            raise ValueError(
                "the options ask for more parameters than the file has numbers"
            )

    handle = register_module_parameter_registration_hook(count_numbers)
    try:
        yield
    finally:
        handle.remove()


def load_weights(
    model: nn.Module, weights: Mapping[str, Tensor], *, where: str
) -> None:
    """Copy weights into a model; those in bfloat16 become float32.

    Raises:
        UnreadableFileError: weights are not finite, or do not fit the model.
    """
    infinite = []
    for name, value in weights.items():
        is_finite = value.to(torch.float32).isfinite()
        if not is_finite.all():
            infinite.append(name)
    if infinite:
        raise UnreadableFileError(
            "weights are not finite",
            where=where,
            expected="finite numbers",
            got=_list_first(infinite, count=3),
            fix="train anew, or take an earlier checkpoint",
        )
    try:
        model.load_state_dict(dict(weights))
    except RuntimeError as error:
        one_line = " ".join(str(error).split())
        raise UnreadableFileError(
            "the weights do not fit the model",
            where=where,
            expected=f"weights of {type(model).__name__} with the options of the file",
            got=one_line[:300],
            fix="train anew with this version of lagbench",
        ) from None


def _list_first(names: Sequence[str], *, count: int) -> str:
    """Return the first names in one line, and how many more there are."""
    line = ", ".join(names[:count])
    more = len(names) - count
    if more > 0:
        return f"{line} and {more} more"
    return line


def round_weights(model: nn.Module) -> dict[str, Tensor]:
    """Return parameters in bfloat16; buffers (statistics, closed forms) stay exact."""
    parameter_names = {name for name, _ in model.named_parameters()}
    rounded = {}
    for name, value in model.state_dict().items():
        if name in parameter_names:
            rounded[name] = value.detach().to(torch.bfloat16)
        else:
            rounded[name] = value.detach()
    return rounded


def count_rounded_parameters(checkpoint: Checkpoint) -> int:
    """Return how many parameters of a file :func:`round_weights` has rounded."""
    count = 0
    for value in checkpoint.weights.values():
        if value.dtype == torch.bfloat16:
            count += value.numel()
    return count


def check_data(
    checkpoint: Checkpoint,
    *,
    root: Path,
    registry: Registry,
    size: str | None = None,
    where: str,
) -> DatasetInfo:
    """Check that a model can be run on the data at hand, and return their info.

    ``size`` may be another size than that of the training.

    Raises:
        DataError: the data set is missing, or of another version than the training's.
        UsageError: the model cannot be run at that size.
    """
    trained = checkpoint.info
    try:
        registry.split(trained.split)
    except UsageError as error:
        raise DataError(
            f"{trained.split}, which the model was trained on, is not there",
            where=where,
            expected="its data, or its description",
            got=f"in {root}: no such split",
            fix="name the folder of the local split: --split FOLDER; or the folder "
            "that holds it: --root FOLDER",
        ) from error
    if size is None or size == trained.size:
        target = read_dataset_info(
            trained.split, trained.size, root=root, registry=registry
        )
        expected = trained.dataset_sha256
        got = target.dataset_sha256
    else:
        target = _check_other_size(checkpoint, size, root=root, registry=registry)
        expected, got = _versions_of_training(trained, target, registry)
    if expected != got:
        raise DataError(
            "the model was trained on another version of the data set",
            where=where,
            expected=f"{trained.split} {trained.size} {trained.version}, {expected}",
            got=f"{target.version}, {got}",
            fix="train again on the data at hand, or generate the version of the "
            "training",
        )
    return target


def _check_other_size(
    checkpoint: Checkpoint, size: str, *, root: Path, registry: Registry
) -> DatasetInfo:
    """Return the info of another size, if the model can be run there."""
    trained = checkpoint.info
    size = registry.size(trained.split, size).name
    entry = find(checkpoint.baseline)
    command = f"lagbench train --baseline {entry.name} {trained.split} --size {size}"
    advice = (
        f"train it there: {command}; if the model has no recipe for this size, write "
        "one and add --recipe FILE.yaml (docs/baselines.md)"
    )
    if not entry.model.any_size:
        raise UsageError(
            f"{entry.model.method} predicts only the size that it was trained on",
            where="--size",
            expected=trained.size,
            got=size,
            fix=advice,
        )
    target = read_dataset_info(trained.split, size, root=root, registry=registry)
    same_box = target.box == trained.box
    same_interval = target.frame_interval == trained.frame_interval
    if not same_box or not same_interval:
        raise UsageError(
            f"sizes {trained.size} and {size} of {trained.split} differ in more than "
            f"resolution",
            where="--size",
            expected=f"box {trained.bounds}, {trained.frame_interval:g} s between "
            f"frames",
            got=f"box {target.bounds}, {target.frame_interval:g} s",
            fix=advice,
        )
    return target


def _versions_of_training(
    trained: DatasetInfo, target: DatasetInfo, registry: Registry
) -> tuple[str, str]:
    """Return two versions to compare when a model runs at another size than its own.

    The first is that of the data it was trained on. Where datasets.yaml records a hash
    for the size of the training, both are hashes, and the second is the recorded one.
    Else both are major versions, and the second is that of ``target``.
    """
    measured = registry.size(trained.split, trained.size).measured
    if measured is not None:
        return trained.dataset_sha256, measured.dataset_sha256
    trained_major, _, _ = trained.version.partition(".")
    target_major, _, _ = target.version.partition(".")
    return trained_major, target_major
