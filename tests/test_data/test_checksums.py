"""The content hash says what the values say, and nothing else."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from lagbench.data.checksums import (
    ContentHasher,
    VariableHasher,
    dataset_hash,
    file_sha256,
    subset_hash,
)
from lagbench.errors import DataError

FLOATS = hnp.arrays(
    st.sampled_from(["<f4", "<f8"]),
    hnp.array_shapes(min_dims=1, max_dims=3, max_side=5),
    elements={"allow_nan": True, "allow_subnormal": True},
)
IDENTITY = {
    "split": "cavity",
    "size": "tiny",
    "major": 1,
    "scenario": 3,
    "subset": "test",
    "seed": "s",
}
IDENTITY["parameters"] = {
    "dt": 0.002,
    "grid": 16,
    "name": "ä",
}


def letters(count: int) -> tuple[str, ...]:
    """Return names of dimensions."""
    return tuple("abcdef"[:count])


def digest(
    values: NDArray[Any],
    *,
    name: str = "position",
    dims: tuple[str, ...] | None = None,
) -> str:
    """Return the hash of values given in one piece."""
    values = np.asarray(values)
    hasher = VariableHasher(
        name,
        values.dtype,
        dims or letters(values.ndim),
        values.shape,
    )
    hasher.update(values)
    return hasher.hexdigest()


def sha256(content: bytes) -> str:
    """Return the hash of bytes."""
    return hashlib.sha256(content).hexdigest()


def identity_hash(**changes: object) -> str:
    """Return the hash of no variables under an identity with some changes."""
    hasher = ContentHasher(IDENTITY | changes)
    return hasher.hexdigest()


def test_hashes_of_variables_by_hand() -> None:
    """Header, newline and bytes as docs/format.md spells them out.

    Strings are UTF-8 joined by NUL, whatever type holds them.
    """
    header = b'{"dims":["frame"],"dtype":"float32","name":"x","shape":[2]}\n'
    data = bytes.fromhex("0000803f00000000")  # 1.0f, and 0.0f for -0.0f
    values = np.array([1.0, -0.0], np.float32)
    assert digest(values, name="x", dims=("frame",)) == sha256(header + data)
    header = b'{"dims":["space"],"dtype":"string","name":"s","shape":[2]}\n'
    expected = sha256(header + "x\0ä".encode())
    for kind in (None, object, np.dtypes.StringDType()):
        texts = np.array(["x", "ä"], kind)
        assert digest(texts, name="s", dims=("space",)) == expected


def test_content_hash_by_hand() -> None:
    """The content hash is the SHA-256 of one JSON text."""
    values = np.array([1, 2], np.int32)
    header = b'{"dims":["a"],"dtype":"int32","name":"v","shape":[2]}\n'
    variable_hash = sha256(header + values.tobytes())
    text = (
        '{"major":1,"parameters":{"dt":0.002,"grid":16,"name":"ä"},"scenario":3,"seed":"s","size":"tiny",'
        f'"split":"cavity","subset":"test","variables":{{"v":"{variable_hash}"}}}}'
    )
    hasher = ContentHasher(IDENTITY)
    hasher.declare("v", values.dtype, ("a",), values.shape)
    hasher.update("v", values)
    assert hasher.hexdigest() == sha256(text.encode())
    # another one is another scenario
    for key in (
        "split",
        "size",
        "major",
        "scenario",
        "subset",
        "seed",
    ):
        assert identity_hash(**{key: 7}) != identity_hash()


@given(FLOATS, st.data())
def test_pieces_order_and_endianness_do_not_matter(
    values: NDArray[Any], data: st.DataObject
) -> None:
    """Any cut into pieces, memory order and byte order gives the hash of the whole."""
    cut = data.draw(st.integers(0, values.shape[0]))
    dims = letters(values.ndim)
    hasher = VariableHasher("position", values.dtype, dims, values.shape)
    hasher.update(values[:cut])
    big_endian = values.dtype.newbyteorder(">")
    rest = np.asfortranarray(values[cut:])
    hasher.update(rest.astype(big_endian))
    assert hasher.hexdigest() == digest(values)


@given(FLOATS, st.data())
def test_any_change_of_a_value_changes_the_hash(
    values: NDArray[Any], data: st.DataObject
) -> None:
    """One flipped bit matters, except the sign of zero and what a NaN carries."""
    flat = values.reshape(-1).copy()
    last_place = flat.size - 1
    last_bit = 8 * flat.itemsize - 1
    place = data.draw(st.integers(0, last_place))
    bit = data.draw(st.integers(0, last_bit))
    before = flat[place].copy()
    bits = flat.view(f"<u{flat.itemsize}")
    unsigned = bits.dtype.type
    bits[place] ^= unsigned(1) << unsigned(bit)
    after = flat[place]
    are_zeros = before == 0 and after == 0
    are_nans = np.isnan(before) and np.isnan(after)
    changed = flat.reshape(values.shape)
    has_same_hash = digest(changed) == digest(values)
    assert has_same_hash == (are_zeros or are_nans)
    # The smallest integer is a value like any other, not a zero.
    whole = np.zeros((2, 3), np.int32)
    least = np.full((2, 3), -(2**31), np.int32)
    hashes = {digest(whole), digest(least), digest(whole + 1)}
    assert len(hashes) == 3


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_every_nan_is_one(dtype: Any) -> None:
    """NaN of any sign and payload, quiet or signalling, hashes as the canonical one."""
    item_bytes = np.dtype(dtype).itemsize
    quiet = np.full(4, np.nan, dtype)
    bits = quiet.view(f"u{item_bytes}").copy()
    unsigned = bits.dtype.type
    sign = 1 << (8 * item_bytes - 1)
    bits[1] |= unsigned(sign)
    bits[2] |= unsigned(5)
    exponent = np.array(np.inf, dtype).view(bits.dtype)
    bits[3] = exponent | unsigned(1)
    assert digest(bits.view(dtype)) == digest(quiet)


@given(FLOATS.filter(lambda values: values.dtype == np.float32))
def test_name_type_dims_and_shape_matter(values: NDArray[Any]) -> None:
    """Equal bytes under another header have another hash."""
    base = digest(values)
    with np.errstate(all="ignore"):
        wider = values.astype(np.float64)
    longer = values[None]
    as_integers = values.reshape(-1).view(np.int32)
    dims = letters(values.ndim)
    others = {
        digest(values, name="velocity"),
        digest(values, dims=tuple("zyxwvu"[: values.ndim])),
        digest(wider),
        digest(longer, dims=(*dims, "g")),
        digest(as_integers.reshape(values.shape)),
    }
    assert base not in others
    assert len(others) == 5


TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"))


@given(st.lists(TEXTS, min_size=2, max_size=5))
def test_string_borders_matter(texts: list[str]) -> None:
    """Moving a letter from one string to the next changes the hash."""
    first, second, *others = texts
    moved = [first + second, "", *others]
    is_same = moved == texts
    hash_of_moved = digest(np.array(moved, object))
    hash_of_texts = digest(np.array(texts, object))
    assert (hash_of_moved == hash_of_texts) == is_same


NUMBERS = st.floats(
    allow_nan=False,
    allow_infinity=False,
    allow_subnormal=False,
)


@given(
    st.dictionaries(
        st.text("abc", min_size=1, max_size=3),
        st.one_of(
            st.integers(-9, 9),
            NUMBERS,
            st.text("xyz", max_size=3),
        ),
        min_size=1,
    ),
    st.data(),
)
def test_any_change_of_a_parameter_matters(
    parameters: dict[str, Any], data: st.DataObject
) -> None:
    """Name and value of each parameter enter; their order does not."""
    expected = identity_hash(parameters=parameters)
    backwards = dict(reversed(parameters.items()))
    assert identity_hash(parameters=backwards) == expected
    names = sorted(parameters)
    name = data.draw(st.sampled_from(names))
    renamed = {**parameters, name + "d": parameters[name]}
    del renamed[name]
    assert identity_hash(parameters=renamed) != expected
    other_value = {**parameters, name: "other"}
    assert identity_hash(parameters=other_value) != expected


def test_variables_can_arrive_side_by_side() -> None:
    """Frames of two variables in turn hash as one variable after the other."""
    position = np.arange(12, dtype=np.float32).reshape(3, 2, 2)
    dims = ("frame", "particle", "space")
    hashes = []
    for pieces in (position, position[None]):
        hasher = ContentHasher(IDENTITY)
        for name in ("velocity", "position"):
            hasher.declare(name, np.float32, dims, position.shape)
        for piece in pieces:
            hasher.update("position", piece)
            hasher.update("velocity", -piece)
        hashes.append(hasher.hexdigest())
    first, second = hashes
    assert first == second


def test_hashes_of_subsets_data_sets_and_files_by_hand(tmp_path: Path) -> None:
    """Lines by id, then one JSON text; `extra` stays outside, a missing subset is an
    error.
    """
    (tmp_path / "f").write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file_sha256(tmp_path / "f") == known
    lines = f"0002 {'a' * 64}\n0010 {'b' * 64}\n"
    hashes = {10: "b" * 64, 2: "a" * 64}
    assert subset_hash(hashes) == sha256(lines.encode())
    subsets = {
        "valid": "1" * 64,
        "train": "0" * 64,
        "test": "2" * 64,
    }
    text = (
        '{"major":1,"size":"tiny","split":"cavity","subsets":'
        f'{{"test":"{"2" * 64}",'
        f'"train":"{"0" * 64}",'
        f'"valid":"{"1" * 64}"}}}}'
    )
    expected = sha256(text.encode())
    assert dataset_hash("cavity", "tiny", 1, subsets) == expected
    with_extra = {**subsets, "extra": "3" * 64}
    assert dataset_hash("cavity", "tiny", 1, with_extra) == expected
    del subsets["valid"]
    with pytest.raises(DataError) as caught:
        dataset_hash("cavity", "tiny", 1, subsets)
    assert caught.value.where == "cavity tiny"
