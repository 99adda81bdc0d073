"""Checks on the layout of a file: its format, dimensions and types; no data set is needed."""

from __future__ import annotations

from lagbench.errors import nearest

from .anatomy import MAX_COORDINATE, MAX_LINKS, Anatomy, Odd
from .findings import Findings, quoted
from .header import DIMS, FORMAT, NEVER, OPTIONAL, REQUIRED, SPACE, fits, kind_of
from .storage import check_storage

__all__ = ["check_dims", "check_dtype", "check_format", "check_marks"]

MAX_NAME = 200
"""Longest required attribute [characters]."""

_START = "start from what `lagbench template` writes, or use lagbench.submission.write"


def check_format(anatomy: Anatomy, out: Findings) -> bool:
    """Check links, variables, storage and attributes; tell whether the values can be read."""
    out.made("format")
    _check_links(anatomy, out)
    for name in ("position", "scenario", "frame"):
        _check_variable(name, anatomy, out)
    for name, array in anatomy.arrays.items():
        stored = check_storage(array, out)
        if stored and name != "position" and name not in anatomy.integers:
            out.error(
                "format",
                "a coordinate cannot be read",
                where=f"variable {name!r}",
                expected=f"one dimension of at most {MAX_COORDINATE} integers",
                got=f"{array.kind}, shape {array.shape}, chunks {array.chunks}",
                fix=_START,
            )
    readable = not out.failed("format")
    _check_attributes(anatomy, out)
    return readable


def _check_links(anatomy: Anatomy, out: Findings) -> None:
    for name, kind in anatomy.links.items():
        if kind.endswith("link"):
            out.error(
                "format",
                f"there is a {kind}, which is not followed",
                where=quoted(name),
                expected="variables that lie in this file",
                got=kind,
                fix="store the values themselves",
            )
    if anatomy.link_count > MAX_LINKS:
        out.error(
            "format",
            "too many variables",
            where="/",
            expected=f"at most {MAX_LINKS}",
            got=anatomy.link_count,
            fix=_START,
        )


def _check_variable(name: str, anatomy: Anatomy, out: Findings) -> None:
    kind = anatomy.links.get(name)
    if kind == "variable" or (kind is not None and kind.endswith("link")):
        return
    known = [quoted(other) for other in anatomy.links][:10]
    fix = _START if kind else nearest(quoted(name), known)
    got = kind or f"{', '.join(known) or 'nothing'}"
    out.error("format", f"no variable {name!r}", where="/", expected=f"a variable {name!r}", got=got, fix=fix)


def _check_attributes(anatomy: Anatomy, out: Findings) -> None:
    number = anatomy.attributes["lagbench_format"]
    if isinstance(number, (str, Odd)) or number != FORMAT:
        _bad_attribute("lagbench_format", FORMAT, number, out)
    for name in REQUIRED:
        value = anatomy.attributes[name]
        if (
            not isinstance(value, str)
            or not value.strip()
            or len(value) > MAX_NAME
            or not value.isprintable()
        ):
            _bad_attribute(name, f"printable text of 1 to {MAX_NAME} characters", value, out)
    for name in OPTIONAL:
        value = anatomy.attributes[name]
        if value is not None and not fits(name, value):
            _bad_attribute(name, f"{kind_of(name)}, or no such attribute", value, out)


def _bad_attribute(name: str, expected: object, value: object, out: Findings) -> None:
    got = "no such attribute" if value is None else value.reason if isinstance(value, Odd) else quoted(value)
    what = "is missing" if value is None else "cannot be used"
    out.error(
        "format",
        f"the attribute {name!r} {what}",
        where="global attributes",
        expected=expected,
        got=got,
        fix=f"set it: file.{name} = ...",
    )


def check_dims(anatomy: Anatomy, out: Findings) -> bool:
    """Check names, order and lengths of the dimensions of ``position``."""
    array = anatomy.arrays.get("position")
    if array is None or array.shape is None:
        out.skip("'position' cannot be read", "dims")
        return False
    out.made("dims")
    where = "variable 'position'"
    if array.dims != DIMS:
        unnamed = not any(array.dims)
        fix = "transpose it" if sorted(array.dims) == sorted(DIMS) else _fix_dims(len(array.shape), unnamed)
        got = ", ".join(quoted(name) if name else "one without a name" for name in array.dims) or "none"
        expected = ", ".join(DIMS)
        out.error("dims", "the dimensions are others", where=where, expected=expected, got=got, fix=fix)
        return False
    lengths = (_length("scenario", anatomy), _length("frame", anatomy), array.shape[2], SPACE)
    if array.shape != lengths:
        swapped = array.shape[2] == SPACE and array.shape[3] > SPACE
        fix = "particle and space seem to be swapped: transpose them" if swapped else _START
        out.error("dims", "the lengths do not fit", where=where, expected=lengths, got=array.shape, fix=fix)
        return False
    return True


def _fix_dims(rank: int, unnamed: bool) -> str:
    if rank == len(DIMS) - 1:
        return "add the leading dimension 'scenario', also for a single scenario"
    if unnamed:
        return "attach dimension scales, as netCDF4 and xarray do; plain h5py does not"
    return _START


def _length(coordinate: str, anatomy: Anatomy) -> int | str:
    values = anatomy.integers.get(coordinate)
    return f"as many as {coordinate!r}" if values is None else len(values)


def check_dtype(anatomy: Anatomy, out: Findings) -> bool:
    """Check that positions are float32 and not packed as scaled numbers."""
    array = anatomy.arrays.get("position")
    if array is None:
        out.skip("there is no variable 'position'", "dtype")
        return False
    out.made("dtype")
    where = "variable 'position'"
    if array.kind != "float32":
        fix = "store positions as float32: positions.astype('float32')"
        out.error("dtype", "the type is another", where=where, expected="float32", got=array.kind, fix=fix)
    if array.packing:
        got = ", ".join(
            f"{n} = {v.reason if isinstance(v, Odd) else quoted(v)}" for n, v in array.packing.items()
        )
        out.error(
            "dtype",
            "the values are packed, and are not unpacked here",
            where=where,
            expected="no scale_factor and no add_offset",
            got=got,
            fix="store the positions themselves as float32",
        )
    return not out.failed("dtype")


def check_marks(anatomy: Anatomy, out: Findings) -> bool:
    """Check that ``diverged_at``, where it is there, has a predicted frame or -1 per scenario."""
    array = anatomy.arrays.get("diverged_at")
    if array is None:
        out.made("diverged_at")
        return True
    marks, frames = anatomy.integers.get("diverged_at"), anatomy.integers.get("frame")
    if marks is None or frames is None:
        out.skip("'diverged_at' or 'frame' cannot be read", "diverged_at")
        return False
    out.made("diverged_at")
    where = "variable 'diverged_at'"
    if array.dims != ("scenario",) or len(marks) != len(anatomy.integers.get("scenario", ())):
        out.error(
            "diverged_at",
            "it is not told per scenario",
            where=where,
            expected="one value per scenario, on the dimension 'scenario'",
            got=f"{len(marks)} on {quoted(array.dims[0]) if any(array.dims) else 'one without a name'}",
            fix="store it beside 'scenario', or leave it out",
        )
    wrong = sorted(set(marks) - {NEVER, *frames})
    if wrong:
        out.error(
            "diverged_at",
            "a rollout is frozen at no predicted frame",
            where=where,
            expected=f"absolute numbers of predicted frames, {NEVER} for a rollout that did not diverge",
            got=", ".join(map(str, wrong[:5])),
            fix=f"name the first frozen frame, or {NEVER}",
        )
    return not out.failed("diverged_at")
