"""The entry of a leaderboard: what its schema takes, what it refuses, and that YAML
round-trips.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from lagbench.board.entry import About, Entry, Meta
from lagbench.board.entry_file import (
    MAX_ENTRY_BYTES,
    entry_bytes,
    examine,
    read_entry,
    read_meta,
    schema_bytes,
)
from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError

LEADERBOARD = Path(__file__).parents[2] / "leaderboard"
HASH = "0123456789abcdef" * 4


def plain(**changes: Any) -> dict[str, Any]:
    """Return a valid entry as YAML holds it, with changes."""
    value: dict[str, Any] = {
        "format": 2,
        "split": "cavity",
        "size": "tiny",
        "method": "my-model",
        "name": "My model",
        "authors": ["A. Author"],
        "date": "2026-01-31",
        "command": "make predictions.nc",
        "dataset": {"version": "1.0.0", "sha256": HASH},
        "predictions": [{"sha256": HASH}],
        "score": {
            "lagbench": "0.1.0",
            "dataset_sha256": HASH,
            "ranking_metric": "vorticity_rmse",
            "files": [{"sha256": HASH, "predictions_sha256": HASH}],
            "metrics": {
                "vorticity_rmse": {"mean": 0.5, "std": None, "low": 0.25, "high": 1.0}
            },
        },
    }
    return value | changes


def seeded(*seeds: int | None) -> dict[str, Any]:
    """Return the changes that make an entry one of several seeds."""
    value = plain()
    made = [
        {"sha256": HASH} | ({} if seed is None else {"seed": seed}) for seed in seeds
    ]
    return {
        "predictions": made,
        "score": value["score"] | {"files": value["score"]["files"] * len(seeds)},
    }


def test_the_plain_entry_fits() -> None:
    """What the other tests change is valid, and says where its files lie."""
    entry, mistakes = examine(Entry, plain())
    assert not mistakes
    assert entry is not None
    assert entry.yaml_path == Path("submissions/cavity/tiny/my-model.yaml")
    assert entry.score_paths == (Path("scores/cavity/tiny/my-model.nc"),)
    several = Entry.model_validate(plain(**seeded(0, 12)))
    assert [path.name for path in several.score_paths] == [
        "my-model_0.nc",
        "my-model_12.nc",
    ]


LINKS = (
    *(
        "javascript:alert(1)",
        "JAVASCRIPT:alert(1)",
        "data:text/html,x",
        "ftp://a.org/x",
        "//a.org",
        "a.org",
    ),
    *(
        "https://",
        "https://a.org/ b",
        'https://a.org/"onload=x',
        "https://a.org/<x>",
        "https://a.org/'x",
    ),
    *(
        "https://a.org/\n",
        "https://a.org/`x`",
        "https://a.org/é",
        " https://a.org",
        "http:a.org",
    ),
    *(
        "https://user@a.org/",
        "https://user:pass@a.org",
        "https://xn--80ak6aa92e.com",
        "https://a.xn--p1ai/x",
    ),
    *(
        "http://localhost/x",
        "http://127.0.0.1/x",
        "https://[::1]/",
        "https://a..org/",
        "http://1/",
    ),
    f"https://a.org/{'x' * 300}",
)
PATHS = (
    "../x.nc",
    "/etc/passwd",
    "a/../../x",
    "a//b",
    "./x",
    "a\\..\\x",
    "",
    "a/./b",
    "x" * 201,
    "a\nb",
)
BLANKS = (
    "   ",
    "\u3164",
    "\u2800\u2800",
    "\u115f\u1160",
    "a\u3164b",
    "--",
    " a",
    "a ",
    "\ufe0f",
)
ZALGO = ("a" + "\u0301\u0302\u0303" * 2, "Z\u0351\u036b\u0343\u036a\u0302a\u036b")
TEXTS = (
    *(*BLANKS, *ZALGO, "", "n" * 10_000),
    *("a\x1b[2Jb", "a\x00b", "a\nb", "a\u202eb", "a\u2028b", 7, None, ["x"]),
)


@pytest.mark.parametrize(
    ("where", "changes"),
    [
        *((f"{key}", {key: link}) for key in ("code", "paper") for link in LINKS),
        *(
            ("predictions.0.url", {"predictions": [{"sha256": HASH, "url": link}]})
            for link in LINKS
        ),
        *(
            ("predictions.0.path", {"predictions": [{"sha256": HASH, "path": path}]})
            for path in PATHS
        ),
        *(("name", {"name": text}) for text in TEXTS),
        *(("authors.0", {"authors": [text]}) for text in TEXTS),
        ("authors", {"authors": []}),
        ("authors", {"authors": ["a"] * 51}),
        ("notes", {"notes": "n" * 1001}),
        ("command", {"command": ""}),
        ("method", {"method": "My Model"}),
        ("method", {"method": "../x"}),
        ("method", {"method": "a_1"}),
        ("method", {"method": "m" * 61}),
        ("split", {"split": "cavity/../../x"}),
        ("format", {"format": 1}),
        ("date", {"date": "31.1.2026"}),
        ("status", {"status": "best"}),
        ("parameters", {"parameters": -1}),
        ("parameters", {"parameters": True}),
        ("parameters", {"parameters": 1.5}),
        ("dataset.sha256", {"dataset": {"version": "1.0.0", "sha256": "abc"}}),
        ("dataset.version", {"dataset": {"version": "1.0", "sha256": HASH}}),
        (
            "cost.seconds_per_frame",
            {"cost": {"device": "cpu", "seconds_per_frame": 0.0}},
        ),
        (
            "cost.seconds_per_frame",
            {"cost": {"device": "cpu", "seconds_per_frame": float("inf")}},
        ),
        ("predictions", {"predictions": []}),
        ("the file", {"superseded_by": "other"}),
        ("the file", {"status": "superseded"}),
        ("the file", seeded(1, 1)),
        ("the file", seeded(None, 1)),
        ("the file", {"predictions": [{"sha256": HASH[::-1]}]}),
    ],
)
def test_what_does_not_fit_is_refused(where: str, changes: dict[str, Any]) -> None:
    """Links, paths, texts, numbers and their combinations: the mistake names the key,
    shortly.
    """
    entry, mistakes = examine(Entry, plain(**changes))
    assert entry is None
    assert where in {mistake.where for mistake in mistakes}
    assert all(
        str(mistake).isprintable() and len(str(mistake)) < 500 for mistake in mistakes
    )


@pytest.mark.parametrize(
    ("changes", "where", "fix"),
    [
        ({"licenze": "MIT"}, "licenze", "did you mean 'licence'?"),
        (
            {"dataset": {"version": "1.0.0", "sha256": HASH, "verion": 1}},
            "dataset.verion",
            "'version'",
        ),
        (
            {"predictions": [{"sha256": HASH, "urll": "x"}]},
            "predictions.0.urll",
            "'url'",
        ),
        (
            {"cost": {"device": "a", "seconds_per_frame": 1, "devise": "b"}},
            "cost.devise",
            "'device'",
        ),
    ],
)
def test_unknown_keys_name_the_nearest(
    changes: dict[str, Any], where: str, fix: str
) -> None:
    """At the top, in mappings and in lists."""
    _, (mistake,) = examine(Entry, plain(**changes))
    assert mistake.where == where
    assert mistake.what == "unknown key"
    assert fix in str(mistake.fix)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "<script>alert(1)</script>",
            "<img src=x onerror=alert(1)>",
            "Ünïcode 模型 😀",
            "'; DROP TABLE",
        ),
        *("{{x}}", "ไม่มีที่ติ", "नेटवर्क १", "Việt ngữ", "1e5", "0o17"),
    ],
)
def test_odd_names_are_text(name: str) -> None:
    """Markup in a name is neither refused nor changed: it is the page that escapes
    it.
    """
    assert Entry.model_validate(plain(name=name)).name == name


def acceptable(text: str) -> bool:
    """Tell whether a name is one that an entry may have."""
    return not examine(Entry, plain(name=text))[1]


PRINTABLE = st.text(min_size=1, max_size=100).filter(str.isprintable).filter(acceptable)


@settings(max_examples=60, deadline=None)
@given(
    name=PRINTABLE
    | st.from_regex(r"[-+]?[0-9_.:eExoab]{1,9}[0-9]", fullmatch=True).filter(acceptable)
)
def test_any_text_survives_yaml(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    """Written and read again, an entry is the same, and so are the bytes of its
    file.
    """
    entry = Entry.model_validate(plain(name=name, notes=name, affiliation=name))
    data = entry_bytes(entry)
    path = tmp_path_factory.getbasetemp() / "entry.yaml"
    path.write_bytes(data)
    again = read_entry(path)
    assert again == entry
    assert entry_bytes(again) == data


def bomb() -> str:
    """Return a few hundred bytes that aliases expand to 10^9 strings."""
    lines = ["a: &a [x, x, x, x, x, x, x, x, x, x]"]
    for last, name in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{name}: &{name} [{', '.join([f'*{last}'] * 10)}]")
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        *(
            bomb(),
            "!!python/object/apply:os.system ['touch ran']",
            "name: !!python/name:os.system",
        ),
        *(
            "[" * 5000,
            "name: a\nname: b",
            "name: \xff\xfe",
            "x" * (MAX_ENTRY_BYTES + 1),
        ),
    ],
)
def test_hostile_yaml_is_refused(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bombs, Python tags, deep nesting, double keys, other encodings, length:
    unreadable, nothing run.
    """
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "entry.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UnreadableFileError):
        read_entry(path)
    assert [found.name for found in tmp_path.iterdir()] == ["entry.yaml"]


def test_large_files_and_pipes_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 MB, a pipe without a writer, a folder, nothing: refused by looking at them,
    at once.
    """
    monkeypatch.setattr(Path, "read_text", pytest.fail)
    large = tmp_path / "large.yaml"
    pipe = tmp_path / "pipe.yaml"
    with large.open("wb") as stream:
        stream.truncate(100_000_000)
    os.mkfifo(pipe)
    started = time.perf_counter()
    for path in (large, pipe, tmp_path, tmp_path / "none.yaml"):
        with pytest.raises(UnreadableFileError):
            read_entry(path)
    assert time.perf_counter() - started < 1.0


def test_one_error_names_every_wrong_key_of_a_file(tmp_path: Path) -> None:
    """The error names every wrong key of the file."""
    path = tmp_path / "entry.yaml"
    path.write_text(
        yaml.safe_dump(plain(licenze="MIT", code="javascript:x", parameters=-1))
    )
    with pytest.raises(ChecksFailedError) as caught:
        read_entry(path)
    assert caught.value.where.endswith("entry.yaml")
    assert all(key in str(caught.value) for key in ("licenze", "code", "parameters"))


def objects(value: Any) -> Iterator[dict[str, Any]]:
    """Yield every object of a JSON schema that has properties."""
    if isinstance(value, dict):
        if "properties" in value:
            yield value
        for inner in value.values():
            yield from objects(inner)


def test_the_schema_is_the_committed_one_and_closed() -> None:
    """leaderboard/schema.json is generated; it takes no other keys than the model, at
    any depth.
    """
    assert (LEADERBOARD / "schema.json").read_bytes() == schema_bytes()
    schema = json.loads(schema_bytes())
    assert set(schema["properties"]) == set(Entry.model_fields)
    found = list(objects(schema))
    assert len(found) >= 7
    assert all(held["additionalProperties"] is False for held in found)


def test_options_win_over_the_file(tmp_path: Path) -> None:
    """Keys come from --from and from options; what is empty is not given; unknown keys
    are refused.
    """
    path = tmp_path / "meta.yaml"
    path.write_text("name: From file\nauthors: [A, B]\ndate: 2026-01-31\nmethod: a\n")
    meta = read_meta(path, {"method": "b", "authors": None, "urls": [], "notes": ""})
    assert meta.method == "b"
    assert meta.name == "From file"
    assert meta.authors == ("A", "B")
    assert meta.urls == ()
    path.write_text("- a list\n")
    with pytest.raises(UsageError) as caught:
        read_meta(path, {})
    assert caught.value.where.endswith("meta.yaml")
    with pytest.raises(UsageError) as caught:
        read_meta(None, {"coed": "x"})
    assert caught.value.where == "options"


def test_every_key_of_a_submitter_is_one_of_the_entry() -> None:
    """A description of a method lands in the entry under the same names."""
    assert set(About.model_fields) <= set(Entry.model_fields)
    assert set(About.model_fields) < set(Meta.model_fields)
