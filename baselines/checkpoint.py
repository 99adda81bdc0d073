"""Checkpoints: tensors and JSON text in a file that cannot run code.

A file of ``torch.save`` with plain entries: ``lagbench_checkpoint`` (format number),
``about`` (JSON: baseline, model options, facts of the data set, training so far),
``weights``, and, for resuming, ``optimizer``. It is read with ``weights_only=True``: a
file with any other object in it, which unpickling would run, is refused.

Options come with a checkpoint, which may be a stranger's: a few bytes of text can ask
for a model of any size. How large it would be is told before it takes any memory: built
on torch's device ``meta``, it has shapes and no numbers.
"""

from __future__ import annotations

import json
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook
from torch.nn.parameter import is_lazy

from lagbench.atomic import atomic_path
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
    check_regular,
)
from lagbench.submission.budget import Budget, parse_budget

from .baseline import Baseline, Facts
from .catalogue import find
from .facts import facts_of

# numbers that a model may have beside those of its file: buffers that are not stored
SPARE = 2**20


def check_footprint(
    model: type[Baseline],
    options: Mapping[str, object],
    facts: Facts,
    weights: Mapping[str, Tensor],
    *,
    where: str,
) -> None:
    """Refuse to build a model that is larger than the weights that are meant for it.

    A model that cannot be built without numbers, as a stranger's baseline may be,
    passes.
    """

    def too_large(expected: str, got: str) -> UnreadableFileError:
        return UnreadableFileError(
            "the options ask for a larger model than the weights that come with them",
            where=where,
            expected=expected,
            got=got,
            fix="do not trust the file, or train anew",
        )

    stored = {  # tensors that share their bytes count once
        value.untyped_storage().data_ptr(): value.untyped_storage().nbytes()
        // value.element_size()
        for value in weights.values()
    }
    held = sum(stored.values())
    parts = 0
    most = len(weights) + 1000

    def counted(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal parts
        parts += parameter is not None
        if parts > most:  # layers without number take memory too
            raise too_large(
                f"weights for {len(weights)} tensors", f"options for more than {most}"
            )

    hook = register_module_parameter_registration_hook(counted)
    try:
        with torch.device("meta"):
            built = model.build(options, facts)
        asked = sum(
            one.numel()
            for one in chain(built.parameters(), built.buffers())
            if not is_lazy(one)
        )
    except (RuntimeError, TypeError) as error:
        if "overflow" not in str(error):
            return
        raise too_large(
            f"weights of {held} numbers", str(error).split("\n")[0][:200]
        ) from None
    finally:
        hook.remove()
    if asked > held + SPARE:
        raise too_large(f"weights of {held} numbers", f"options for {asked}")


FORMAT = 1
KEY = "lagbench_checkpoint"
SAFE = "a checkpoint that lagbench train wrote"
RECIPE_NAME = r"^[A-Za-z0-9._/*-]{1,100}$"  # in a file of weights to start from
# how torch's refusal names what a pickle would call
_FOREIGN = re.compile(r"GLOBAL ([\w.]+)")


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A model with all that it needs to predict, and to be trained on."""

    baseline: str  # name of the baseline
    options: Mapping[str, Any]  # options of the model, plain values
    facts: Facts  # public figures of the data set that it was trained on
    weights: Mapping[str, Tensor]  # parameters and buffers by name
    # what training has done so far, plain values
    training: Mapping[str, Any] = field(default_factory=dict)
    # state of the optimiser; None in a file that is for predictions only
    optimizer: Mapping[str, Any] | None = None

    @property
    def budget(self) -> Budget | None:
        """What the training took; None where that is not known."""
        return parse_budget(json.dumps(self.training.get("budget")))


class _Read(BaseModel):
    """What a file says of a training, as far as it is read again; the rest passes as it
    is.
    """

    model_config = ConfigDict(extra="allow")


class _Options(_Read):
    seed: int = Field(default=0, ge=0, lt=2**63)
    windows: tuple[str, ...] = ("train",)


class _Start(_Read):
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    recipe: str = Field(pattern=RECIPE_NAME)


class _Recipe(_Read):
    name: str = Field(default="", max_length=200)
    training: _Options = _Options()
    start: _Start | None = None


class _Training(_Read):
    step: int = Field(default=0, ge=0)
    recipe: _Recipe = _Recipe()


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; it appears whole or not at all."""
    about = {
        "baseline": checkpoint.baseline,
        "options": dict(checkpoint.options),
        "facts": asdict(checkpoint.facts),
        "training": dict(checkpoint.training),
    }
    content: dict[str, Any] = {
        KEY: FORMAT,
        "about": json.dumps(about, sort_keys=True),
        "weights": {
            name: tensor.detach().cpu() for name, tensor in checkpoint.weights.items()
        },
    }
    if checkpoint.optimizer is not None:
        content["optimizer"] = dict(checkpoint.optimizer)
    with atomic_path(path, option="--output") as temporary:
        try:
            torch.save(content, temporary)
        except (
            RuntimeError
        ) as error:  # torch's name for whatever the operating system refuses
            raise WorkFailedError(
                "cannot write there",
                where=str(path),
                got=str(error).split("\n")[0][:200],
                fix="free disk space, or name a folder that you may write to: --output",
            ) from error


def load(path: str | Path) -> Checkpoint:
    """Read a checkpoint; nothing in the file is run."""
    file = Path(path)
    content = _content(file)
    try:
        if type(content[KEY]) is not int or content[KEY] != FORMAT:
            raise _unfit(file, f"format {FORMAT}", f"format {content[KEY]!r}")
        about = json.loads(content["about"])
        _Training.model_validate(about["training"])
        weights = content["weights"]
        if not isinstance(weights, Mapping):
            raise TypeError("weights are no mapping")
        for name, value in weights.items():
            fit = (
                isinstance(name, str)
                and isinstance(value, Tensor)
                and value.layout is torch.strided
            )
            fit = fit and not (
                value.is_quantized or value.is_complex() or value.is_meta
            )
            if (
                not fit
                or value.numel() * value.element_size()
                > value.untyped_storage().nbytes()
            ):
                raise TypeError(
                    f"weight {name!r} is no tensor of plain numbers that the file holds"
                )
        return Checkpoint(
            baseline=str(about["baseline"]),
            options=dict(about["options"]),
            facts=TypeAdapter(Facts).validate_python(about["facts"]),
            weights=dict(weights),
            training=dict(about["training"]),
            optimizer=content.get("optimizer"),
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise _unfit(
            file, SAFE, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        ) from None


def restore(checkpoint: Checkpoint, *, where: str = "the checkpoint") -> Baseline:
    """Return the model of a checkpoint, in float32, ready to predict."""
    options = checkpoint.options
    facts = checkpoint.facts
    try:
        entry = find(checkpoint.baseline)
    except UsageError as error:
        raise UsageError(
            error.what, where=where, fix="install the package that adds it"
        ) from error
    try:
        check_footprint(entry.model, options, facts, checkpoint.weights, where=where)
        model = entry.model.build(options, facts)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise UnreadableFileError(
            f"option {key!r} of the model does not fit",
            where=where,
            got=first["msg"],
            fix=f"it is from another version of {checkpoint.baseline}; train anew",
        ) from None
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise UnreadableFileError(
            "no model can be built from it",
            where=where,
            got=f"{type(error).__name__}: {error}",
        ) from None
    load_weights(model, checkpoint.weights, where=where)
    return model.eval()


def load_weights(
    model: nn.Module, weights: Mapping[str, Tensor], *, where: str
) -> None:
    """Copy weights into a model; those in bfloat16 become float32."""
    broken = [
        name
        for name, value in weights.items()
        if not value.to(torch.float32).isfinite().all()
    ]
    if broken:
        raise UnreadableFileError(
            "weights are not finite", where=where, got=", ".join(broken[:3])
        )
    try:
        model.load_state_dict(dict(weights))
    except RuntimeError as error:
        raise UnreadableFileError(
            "the weights do not fit the model",
            where=where,
            got=" ".join(str(error).split())[:300],
        ) from None


def rounded_weights(model: nn.Module) -> dict[str, Tensor]:
    """Return parameters in bfloat16, and buffers (statistics, closed forms) as they
    are.
    """
    trained = {name for name, _ in model.named_parameters()}
    return {
        name: value.detach().to(torch.bfloat16) if name in trained else value.detach()
        for name, value in model.state_dict().items()
    }


def rounded_parameters(checkpoint: Checkpoint) -> int:
    """Return how many parameters a file holds by :func:`rounded_weights`; 0 where they
    are not rounded.
    """
    return sum(
        value.numel()
        for value in checkpoint.weights.values()
        if value.dtype == torch.bfloat16
    )


def check_data(
    checkpoint: Checkpoint,
    *,
    root: Path,
    registry: Registry,
    size: str | None = None,
    where: str,
) -> Facts:
    """Check that a model can be run on the data at hand, of its own or another size;
    return their facts.
    """
    trained = checkpoint.facts
    try:
        registry.split(trained.split)
    except UsageError as error:
        what = f"{trained.split}, which the model was trained on, is not there"
        raise DataError(
            what, where=where, got=f"in {root}", fix="name its folder: --root"
        ) from error
    if size in (None, trained.size):
        here = facts_of(trained.split, trained.size, root=root, registry=registry)
        expected = trained.dataset_sha256
        got = here.dataset_sha256
    else:
        size = registry.size(trained.split, str(size)).name
        entry = find(checkpoint.baseline)
        train = f"train it there: lagbench train --baseline {entry.name} {trained.split} --size {size}"
        if not entry.model.any_size:
            message = f"{entry.model.method} has weights for the particles of one size"
            raise UsageError(
                message, where="--size", expected=trained.size, got=size, fix=train
            )
        here = facts_of(trained.split, size, root=root, registry=registry)
        if (here.bounds, here.frame_interval) != (
            trained.bounds,
            trained.frame_interval,
        ):
            raise UsageError(
                f"sizes {trained.size} and {size} of {trained.split} differ in more "
                f"than resolution",
                where="--size",
                expected=f"box {trained.bounds}, {trained.frame_interval:g} s "
                f"between frames",
                got=f"box {here.bounds}, {here.frame_interval:g} s",
                fix=train,
            )
        measured = registry.size(trained.split, trained.size).measured
        if measured is not None:
            expected = trained.dataset_sha256
            got = measured.dataset_sha256
        else:
            expected, got = (one.version.partition(".")[0] for one in (trained, here))
    if expected != got:
        raise DataError(
            "the model was trained on another version of the data set",
            where=where,
            expected=f"{trained.split} {trained.size} {trained.version}, {expected}",
            got=f"{here.version}, {got}",
            fix="train again on the data at hand, or generate the version that it was "
            "trained on",
        )
    return here


def _unsafe(file: Path, got: str) -> LagbenchError:
    return UnreadableFileError(
        "the file holds more than tensors and plain values, and was not opened",
        where=str(file),
        expected=SAFE,
        got=got,
        fix="do not load it otherwise either: such a file can run code",
    )


def _content(file: Path) -> dict[str, Any]:
    """Read what is an archive as torch writes them; what is none is refused before it
    is unpickled.

    Members are stored as they are, so all of them together are no longer than the file,
    and each has the checksum that it states: nothing unpacks to more, and no damaged
    byte is read.
    """
    try:
        if (file / "weights.pt").is_file():
            inside = f"name the file: {file / 'weights.pt'}"
        else:
            inside = None
        length = check_regular(file, fix=inside)
        if not zipfile.is_zipfile(file):
            with file.open("rb") as stream:
                head = stream.read(2)
            if head in {b"\x80" + bytes([protocol]) for protocol in range(2, 6)}:
                raise _unsafe(file, "a pickle of something else")
            raise _unfit(file, SAFE, "something else")
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            packed = [
                one.filename
                for one in members
                if one.compress_type != zipfile.ZIP_STORED
            ]
            total = sum(max(one.file_size, one.compress_size) for one in members)
            if (
                packed
                or total > length
                or len({one.filename for one in members}) < len(members)
            ):
                sizes = f"members of {total} bytes in {length}"
                if packed:
                    got = f"{packed[0][:100]!a} is compressed"
                else:
                    got = sizes
                raise _unfit(
                    file,
                    "an archive whose members are stored as they are, each once",
                    got,
                )
            broken = archive.testzip()
        if broken is not None:
            raise _unfit(
                file, SAFE, f"{broken[:100]!a} has another checksum than it states"
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(file, map_location="cpu", weights_only=True)
    except LagbenchError:
        raise
    except pickle.UnpicklingError as error:
        named = _FOREIGN.search(str(error))
        if named:
            got = f"a pickle that names {named[1][:100]!a}"
        else:
            got = "a pickle of something else"
        raise _unsafe(file, got) from None
    except Exception as error:  # damaged archives raise nearly any type
        raise _unfit(
            file, SAFE, f"{type(error).__name__}: {str(error)[:200]}"
        ) from None
    if not isinstance(content, dict) or KEY not in content:
        raise _unfit(file, SAFE, type(content).__name__)
    return content


def _unfit(file: Path, expected: str, got: str) -> LagbenchError:
    return UnreadableFileError(
        "not a checkpoint of lagbench", where=str(file), expected=expected, got=got
    )
