"""YAML from strangers: what is read, what is refused, and how it is said."""

from pathlib import Path

import pytest

from lagbench.data.yamlfile import MAX_BYTES, read_yaml
from lagbench.errors import UnreadableFileError

BOMB = "a: &a [x, x, x]\nb: &b [*a, *a, *a]\nc: [*b, *b, *b]\n"


def _write(folder: Path, text: str | bytes) -> Path:
    path = folder / "file.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_plain_values_are_read(tmp_path: Path) -> None:
    """Mappings, lists, numbers and strings come back as plain Python."""
    assert read_yaml(_write(tmp_path, "a: [1, 2.5, x]\nb: {c: true}\n")) == {
        "a": [1, 2.5, "x"],
        "b": {"c": True},
    }


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BOMB, "aliases are not allowed"),
        ("a: 1\na: 2\n", "'a' is given twice"),
        ("a: !!python/object/apply:os.system ['true']\n", "tags are not allowed"),
        ("a: !!set {x, y}\n", "tags are not allowed"),
        ("date: 2026-13-45\n", "month must be in 1..12"),
        (f"a: {'9' * 5000}\n", "not a plain YAML file"),
        ("? [a, b]\n: 1\n", "cannot be a key"),
        ("a: [1, 2\n", "not a plain YAML file"),
        (b"\xff\xfe\x00", "not a plain YAML file"),
        ("[" * 5000 + "]" * 5000, "nested deeper than 32"),
    ],
)
def test_what_is_not_plain_is_refused(tmp_path: Path, text: str | bytes, says: str) -> None:
    """Bombs, doubled keys, Python objects and broken text end in one clear error."""
    with pytest.raises(UnreadableFileError, match=says):
        read_yaml(_write(tmp_path, text))


def test_large_files_are_not_even_opened(tmp_path: Path) -> None:
    """A file over the bound is refused by its size."""
    with pytest.raises(UnreadableFileError, match=f"at most {MAX_BYTES} bytes"):
        read_yaml(_write(tmp_path, b"#" * (MAX_BYTES + 1)))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    """The path stands in the message."""
    with pytest.raises(UnreadableFileError, match=r"absent\.yaml"):
        read_yaml(tmp_path / "absent.yaml")
