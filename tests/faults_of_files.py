"""Faults of files that are no netCDF4, are damaged, or shall stop the reader."""

from __future__ import annotations

import gzip
import os
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import netCDF4
from fault_registry import FAULTS, Fault, fault
from submission_data import Bench


@fault("readable", 3, says="no such file")
def missing_file(bench: Bench) -> Path:
    """No such file."""
    return bench.folder / "nowhere.nc"


@fault("readable", 3, says="folder")
def folder(bench: Bench) -> Path:
    """A folder of that name."""
    path = bench.folder / "folder.nc"
    path.mkdir(exist_ok=True)
    return path


@fault("readable", 3, says="pipe")
def fifo(bench: Bench) -> Path:
    """A named pipe that nobody writes to: opening it would wait for ever."""
    path = bench.folder / "fifo.nc"
    if not path.exists():
        os.mkfifo(path)
    return path


@fault("readable", 3, says="device")
def endless_device(bench: Bench) -> Path:
    """A link to a device that never ends."""
    path = bench.folder / "zero.nc"
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")
    return path


@fault("readable", 3)
def broken_symlink(bench: Bench) -> Path:
    """A link to nowhere."""
    path = bench.folder / "broken.nc"
    path.unlink(missing_ok=True)
    path.symlink_to(bench.folder / "nowhere.nc")
    return path


@fault("readable", 3)
def symlink_to_itself(bench: Bench) -> Path:
    """A link that leads to itself."""
    path = bench.folder / "circle.nc"
    path.unlink(missing_ok=True)
    path.symlink_to(path)
    return path


def _bytes(name: str, content: Callable[[bytes], bytes], says: str = "") -> None:
    def make(bench: Bench) -> Path:
        path = bench.folder / f"{name}.nc"
        path.write_bytes(content(bench.valid.read_bytes()))
        return path

    FAULTS[name] = Fault(make, "readable", 3, says=says)


def _with_byte(data: bytes, place: int, value: int) -> bytes:
    return data[:place] + bytes([value]) + data[place + 1 :]


_bytes("empty_file", lambda _: b"", "empty")
_bytes("text_renamed", lambda _: b"scenario,frame,x,y\n3,6,0.1,0.2\n", "text")
_bytes("short_lines_renamed", lambda _: b"---\nsplit: cavity\n", "text")
_bytes("zip_renamed", lambda _: b"PK\x03\x04" + bytes(100), "npz")
_bytes("numpy_renamed", lambda _: b"\x93NUMPY\x01\x00" + bytes(100), ".npy")
_bytes("pickle_renamed", lambda _: pickle.dumps([1.0] * 100), "pickle")
_bytes("gzipped", gzip.compress, "gzip")
_bytes("truncated_half", lambda data: data[: len(data) // 2])
_bytes("truncated_last_byte", lambda data: data[:-1])
_bytes("signature_only", lambda data: data[:8])
_bytes("superblock_zeroed", lambda data: data[:8] + bytes(88) + data[96:])
_bytes("superblock_of_the_future", lambda data: _with_byte(data, 8, 77))
_bytes("user_block_before", lambda data: bytes(512) + data, "bytes of another format")
_bytes("windows_newlines", lambda data: data.replace(b"\n", b"\r\n"))


@fault("readable", 3, says="netCDF-3")
def netcdf3(bench: Bench) -> Path:
    """The format before HDF5."""
    path = bench.folder / "netcdf3.nc"
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
        file.split = "cavity"
    return path


@fault("readable", 3, says="HDF5 cannot read")
def chunk_damaged(bench: Bench) -> Path:
    """A compressed chunk with eight bytes overwritten."""
    path = bench.copy("chunk_damaged.nc")
    with h5py.File(path) as file:
        info = file["position"].id.get_chunk_info(7)
    data = bytearray(path.read_bytes())
    data[info.byte_offset : info.byte_offset + 8] = b"\xff" * 8
    path.write_bytes(data)
    return path


def _stream(gibibytes: int) -> bytes:
    """Return a zlib stream that unpacks to so much nothing."""
    packer = zlib.compressobj(9)
    zeros = bytes(1 << 24)
    blocks = [
        packer.compress(zeros) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2)
    ]
    return blocks[0] + (64 * gibibytes - 1) * blocks[1]


@fault("format", says="longer packed")
def small_chunk_bomb(bench: Bench) -> Path:
    """A chunk of 768 bytes whose zlib stream unpacks to 2 GiB."""
    path = bench.copy("small_chunk_bomb.nc")
    with h5py.File(path, "r+") as file:
        file["position"].id.write_direct_chunk((1, 1, 0, 0), _stream(2))
    return path
