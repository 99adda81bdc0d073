"""YAML from strangers: what is read, what is refused, and how it is said."""

import math
from pathlib import Path

import pytest

from lagbench.data.yamlfile import MAX_BYTES, format_yaml, read_yaml
from lagbench.errors import UnreadableFileError

BOMB = "a: &a [x, x, x]\nb: &b [*a, *a, *a]\nc: [*b, *b, *b]\n"


def _write(folder: Path, text: str | bytes) -> Path:
    path = folder / "file.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_plain_values_are_read(tmp_path: Path) -> None:
    """Mappings, lists, numbers and strings; a file that is missing or over the bound is
    named.
    """
    text = "a: [1, 2.5, x]\nb: {c: true}\n"
    assert read_yaml(_write(tmp_path, text)) == {"a": [1, 2.5, "x"], "b": {"c": True}}
    with pytest.raises(UnreadableFileError):
        read_yaml(_write(tmp_path, b"#" * (MAX_BYTES + 1)))
    with pytest.raises(UnreadableFileError) as caught:
        read_yaml(tmp_path / "absent.yaml")
    assert caught.value.where.endswith("absent.yaml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BOMB, "aliases"),
        ("a: 1\na: 2\n", "'a' is given twice"),
        ("a: !!python/object/apply:os.system ['true']\n", "tags"),
        ("a: !!set {x, y}\n", "tags"),
        ("date: 2026-13-45\n", "month must be in 1..12"),
        (f"a: {'9' * 5000}\n", "YAML"),
        ("? [a, b]\n: 1\n", "cannot be a key"),
        ("a: [1, 2\n", "YAML"),
        (b"\xff\xfe\x00", "YAML"),
        ("[" * 5000 + "]" * 5000, "nested deeper than 32"),
    ],
)
def test_what_is_not_plain_is_refused(
    tmp_path: Path, text: str | bytes, says: str
) -> None:
    """Bombs, doubled keys, Python objects and broken text end in one clear error."""
    with pytest.raises(UnreadableFileError, match=says):
        read_yaml(_write(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("59:59:59:1.5", "59:59:59:1.5"),
        ("-12", -12),
        ("0xfF", 255),
        ("1e-4", 1e-4),
        ("2.", 2.0),
        ("-.5E+1", -5.0),
        ("-.inf", -math.inf),
        ("1e999", math.inf),
        ("yes", True),
    ],
)
def test_floats_are_those_of_yaml_1_2(tmp_path: Path, text: str, value: object) -> None:
    """Those of base 60 are text, and an exponent needs no point."""
    found = read_yaml(_write(tmp_path, f"a: {text}\n"))["a"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "text",
    [
        "12e45678",
        "1e3",
        "0x10",
        "0o17",
        ".5",
        "59:59:1.5",
        "true",
        "-",
        "a: b",
        "é",
        "a\nb",
        "a\x85b",
        "a\u2028b\u2029",
        "\ufeffa",
    ],
)
def test_text_stays_text(text: str, tmp_path: Path) -> None:
    """Hashes that look like numbers among them: what is written is read as the same
    value.
    """
    path = tmp_path / "held.yaml"
    path.write_text(format_yaml({"held": [text, 1.5, 7]}), encoding="utf-8")
    assert read_yaml(path) == {"held": [text, 1.5, 7]}
