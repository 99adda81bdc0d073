"""Faults of the format: attributes, links, storage, coordinates."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from fault_registry import (
    DIMS,
    SHAPE,
    attribute,
    fault,
    positions,
    replace,
    simple,
    store,
)
from submission_data import PARTICLES, Bench

attribute("no_format_number", "lagbench_format", None, says="missing")
attribute("another_format_number", "lagbench_format", 2)
attribute("format_number_as_text", "lagbench_format", "1")
attribute("no_method", "method", None, says="missing")
attribute("blank_method", "method", "  ")
attribute("method_with_escape_codes", "method", "best\x1b[2Jmethod", says="\\x1b")
attribute("method_is_a_number", "method", 5)
attribute(
    "method_is_a_list",
    "method",
    np.array(["a", "b"], dtype=h5py.string_dtype()),
    says="single",
)
attribute("long_method", "method", "x" * 10_000)
attribute("method_as_bad_utf8", "method", np.bytes_(b"\xff\xfe"))
attribute("method_is_empty", "method", h5py.Empty("S1"), says="single")
attribute("seconds_negative", "seconds_per_frame", -1.0)
attribute("seconds_nan", "seconds_per_frame", np.nan)
attribute("parameters_negative", "parameters", -5)
attribute("seed_as_text", "seed", "seven")
attribute("no_split", "split", None, says="missing")
attribute(
    "attribute_is_compound", "training", np.zeros(1, [("a", "i4")]), says="neither"
)


@fault("format", says="single")
def huge_attribute(bench: Bench) -> Path:
    """An attribute of 64 MiB."""
    path = bench.copy("huge_attribute.nc")
    with h5py.File(path, "r+", libver="latest") as file:
        file.attrs.create("training", np.zeros(64 << 20, np.int8))
    return path


@fault("format", says="characters")
def huge_text(bench: Bench) -> Path:
    """A text of 8 MiB."""
    path = bench.copy("huge_text.nc")
    with h5py.File(path, "r+") as file:
        file.attrs["training"] = "x" * (8 << 20)
    return path


def _rename(file: h5py.File) -> None:
    file.move("position", "positions")


def _group(file: h5py.File) -> None:
    del file["position"]
    file.create_group("position")


def _named_type(file: h5py.File) -> None:
    del file["position"]
    file["position"] = np.dtype("f4")


def _soft_circle(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.SoftLink("/other")
    file["other"] = h5py.SoftLink("/position")


def _soft_alias(file: h5py.File) -> None:
    _rename(file)
    file["position"] = h5py.SoftLink("/positions")


def _external_link(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.ExternalLink("/etc/passwd", "/x")


def _stray_link(file: h5py.File) -> None:
    file["notes"] = h5py.ExternalLink("elsewhere.nc", "/position")


def _crowd(file: h5py.File) -> None:
    for number in range(1200):
        file.create_group(f"g{number}")


def _null(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.Empty("f4")


simple("format", "variable_misspelt", _rename, says="positions")
simple("format", "position_is_a_group", _group, says="group")
simple("format", "position_is_a_type", _named_type, says="type")
simple("format", "soft_links_in_a_circle", _soft_circle, says="soft link")
simple("format", "soft_link", _soft_alias, says="soft link")
simple("format", "external_link", _external_link, says="external link")
simple("format", "stray_external_link", _stray_link, says="external link")
simple("format", "too_many_groups", _crowd, says="too many")
simple("format", "position_without_values", _null)
simple(
    "format",
    "lzf_filter",
    lambda f: store(f, positions(f), compression="lzf"),
    says="lzf",
)
simple(
    "format",
    "scale_offset_filter",
    lambda f: store(f, positions(f), scaleoffset=6),
    says="filter",
)
simple("format", "no_scenario_ids", lambda f: f.pop("scenario"), says="scenario")
simple(
    "format",
    "ids_as_text",
    lambda f: replace(f, "scenario", (), np.array([b"3", b"4", b"5"])),
)
simple(
    "format",
    "ids_as_floats",
    lambda f: replace(f, "scenario", (), np.array([3.0, 4.0, 5.0])),
)
simple(
    "format",
    "ids_in_two_dimensions",
    lambda f: replace(f, "scenario", (), np.array([[3, 4, 5]])),
)
simple(
    "format",
    "tiny_chunks",
    lambda f: replace(
        f,
        "position",
        DIMS,
        shape=(3, 8, 5000, 2),
        chunks=(1, 1, 1, 1),
        dtype="f4",
    ),
    says="too many chunks",
)
simple(
    "format",
    "huge_chunk",
    lambda f: replace(
        f,
        "position",
        DIMS,
        shape=SHAPE,
        maxshape=(None,) * 4,
        chunks=(3, 8, 1 << 20, 8),
        dtype="f4",
    ),
    says="unpack",
)
simple(
    "format",
    "huge_chunk_of_ids",
    lambda f: replace(
        f,
        "scenario",
        (),
        shape=(3,),
        maxshape=(None,),
        chunks=(1 << 28,),
        dtype="i4",
        compression=1,
    ),
)


@fault("format", says="other files")
def virtual_dataset(bench: Bench) -> Path:
    """A virtual data set whose source is another file."""
    path = bench.copy("virtual_dataset.nc")
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[...] = h5py.VirtualSource(str(bench.valid), "position", SHAPE)
    with h5py.File(path, "r+") as file:
        del file["position"]
        file.create_virtual_dataset("position", layout)
    return path


@fault("format", says="other files")
def external_storage(bench: Bench) -> Path:
    """Raw values in a file that is not ours to read."""
    path = bench.copy("external_storage.nc")
    with h5py.File(path, "r+") as file:
        outside = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
        replace(
            file,
            "position",
            DIMS,
            shape=SHAPE,
            dtype="f4",
            external=outside,
        )
    return path


@fault("format", says="filter")
def unknown_filter(bench: Bench) -> Path:
    """A filter number that no library has."""
    path = bench.copy("unknown_filter.nc")
    with h5py.File(path, "r+") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((1, 1, PARTICLES, 2))
        plist.set_filter(511, h5py.h5z.FLAG_OPTIONAL, (1,))
        del file["position"]
        space = h5py.h5s.create_simple(SHAPE)
        h5py.h5d.create(file.id, b"position", h5py.h5t.IEEE_F32LE, space, plist)
    return path


def _filtered(name: str, codes: tuple[int, ...], variable: str) -> None:
    """Register a fault whose variable passes through filters in this order."""

    def change(file: h5py.File) -> None:
        shape, kind = (
            (SHAPE, h5py.h5t.IEEE_F32LE)
            if variable == "position"
            else ((3,), h5py.h5t.STD_I32LE)
        )
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((1, 1, PARTICLES, 2) if variable == "position" else shape)
        for code in codes:
            plist.set_filter(
                code,
                h5py.h5z.FLAG_OPTIONAL,
                (9,) if code == h5py.h5z.FILTER_DEFLATE else (),
            )
        del file[variable]
        h5py.h5d.create(
            file.id, variable.encode(), kind, h5py.h5s.create_simple(shape), plist
        )

    simple("format", name, change, says="more than once")


_filtered("deflated_thirty_one_times", (h5py.h5z.FILTER_DEFLATE,) * 31, "position")
_filtered(
    "shuffled_twice", (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE) * 2, "position"
)
_filtered("ids_deflated_twice", (h5py.h5z.FILTER_DEFLATE,) * 2, "scenario")
