"""Cards: valid Croissant, complete Markdown, true hashes, no dates, the same bytes
twice.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from conftest import PAINT_PICTURES
from hypothesis import given
from hypothesis import strategies as st
from rotating_disc import write_swirl

from lagbench.data import registry
from lagbench.data.layout import dataset_folder
from lagbench.data.manifest import Manifest, build_manifest, describe_file
from lagbench.data.registry import Size
from lagbench.figures.tables import escape, markdown
from lagbench.make import cards, painting
from lagbench.make.card_files import PICTURES
from lagbench.make.croissant import croissant_json

STATISTICS = {"position_mean": (0.5, 0.25), "velocity_std": (1.25e-3, 2.5e-3)}
LOADER = """
import json, sys, mlcroissant
data = mlcroissant.Dataset(sys.argv[1])
rows = []
for row in data.records("scenarios"):
    rows.append({k.split("/")[-1]: v for k, v in row.items()})
print(json.dumps(rows))
"""


def make(
    root: Path,
    split: str = "cavity",
    *,
    scenarios: tuple[int, ...] = (0, 1, 2, 3, 4),
) -> tuple[Size, Manifest]:
    """Write rotating_disc and their manifest."""
    size = registry.load().size(split, "tiny")
    entries = []
    for scenario in scenarios:
        write_swirl(root, split, scenario, frames=4)
        entry = describe_file(root, size.key(scenario))
        entries.append(
            entry.model_copy(
                update={"facts": {"kinetic_energy_first": 0.125 + scenario}}
            )
        )
    manifest = build_manifest(
        None,
        entries,
        split=split,
        size="tiny",
        version=size.version,
        subsets=size.subsets,
        environment={"python": "3"},
        statistics=STATISTICS,
    )
    return size, manifest


def write(root: Path, size: Size, manifest: Manifest) -> list[Path]:
    """Write cards with what our registry says of the split."""
    return cards.write_cards(root, size, registry.load().split(size.split), manifest)


def card(size: Size, manifest: Manifest, **update: object) -> str:
    """Return the card without pictures of a data set whose manifest has something
    else.
    """
    manifest = manifest.model_copy(update=update)
    return cards.dataset_card(
        size, registry.load().split(size.split), manifest, pictures=[]
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write cards of a complete made-up cavity tiny."""
    root = tmp_path_factory.mktemp("root")
    size, manifest = make(root)
    assert manifest.complete
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(painting, "paint_pictures", PAINT_PICTURES)
        written = write(root, size, manifest)
    folder = dataset_folder(root, "cavity", "tiny", 2)
    names = {p.relative_to(folder).as_posix() for p in written}
    assert names == {"README.md", "croissant.json", *PICTURES}
    return folder


def test_mlcroissant_accepts_and_reads_the_document(folder: Path) -> None:
    """The reference validator only remarks on the missing date; records are what the
    manifest says.
    """
    tool = Path(sys.executable).parent / "mlcroissant"
    command = [str(tool), "validate", "--jsonld", str(folder / "croissant.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    remarks = re.findall(r"^ +-  .*$", done.stderr, re.MULTILINE)
    assert all("datePublished" in remark for remark in remarks), remarks
    assert "Done" in done.stderr
    command = [sys.executable, "-c", LOADER, str(folder / "croissant.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout)
    assert [row["scenario"] for row in rows] == [0, 1, 2, 3, 4]
    assert {row["subset"] for row in rows} == {"train", "valid", "test"}
    assert all((row["frames"], row["particles"]) == (4, 324) for row in rows)


def test_every_file_is_named_with_its_true_sha256(folder: Path) -> None:
    """Hash and length of each file object are those of the bytes on disk."""
    document = json.loads((folder / "croissant.json").read_text())
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    assert document["license"] == "https://creativecommons.org/licenses/by/4.0/"
    objects = {entry["contentUrl"]: entry for entry in document["distribution"]}
    assert set(objects) == {
        p.relative_to(folder).as_posix() for p in folder.rglob("*.nc")
    }
    for name, entry in objects.items():
        data = (folder / name).read_bytes()
        assert entry["sha256"] == hashlib.sha256(data).hexdigest()
        assert entry["contentSize"] == f"{len(data)} B"


def test_the_card_says_all_that_it_must(folder: Path) -> None:
    """Head, hashes, subsets, statistics, parameters with units, commands, licence,
    citation.
    """
    text = (folder / "README.md").read_text()
    _, head, body = text.split("---\n", 2)
    assert yaml.safe_load(head)["license"] == "cc-by-4.0"
    size = registry.load().size("cavity", "tiny")
    split = registry.load().split("cavity")
    manifest = json.loads((folder / "croissant.json").read_text())
    for record in manifest["recordSet"][0]["data"]:
        assert record["scenarios/content_sha256"] in body
    for name, parameter in size.parameters.items():
        row = next(
            line for line in body.splitlines() if line.startswith(f"| `{name}` |")
        )
        assert escape(parameter.unit) in row
        assert escape(parameter.description) in row
    command = "lagbench generate --split cavity --size tiny"
    for part in (
        "velocity std | 0.00125 | 0.0025",
        "CC-BY-4.0",
        command,
        "--regenerate 2",
    ):
        assert part in body
    assert escape(" ".join(split.citation.split())) in body


def test_every_picture_of_the_card_is_there(folder: Path) -> None:
    """Links resolve, and each picture has words in its place."""
    links = re.findall(r"!\[([^\]]+)\]\(([^)]+)\)", (folder / "README.md").read_text())
    assert [target for _, target in links] == list(PICTURES)
    for words, target in links:
        assert len(words) > 10
        assert (folder / target).stat().st_size < 300_000
        assert (folder / target).read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("as_shipped")
def test_the_same_manifest_gives_the_same_bytes(tmp_path: Path) -> None:
    """Cards written twice, and by another process at another time, do not differ; no
    date is in them.
    """
    size, manifest = make(tmp_path)
    first = {path: path.read_bytes() for path in write(tmp_path, size, manifest)}
    second = {path: path.read_bytes() for path in write(tmp_path, size, manifest)}
    assert first == second
    text = "".join(
        data.decode() for path, data in first.items() if path.suffix != ".png"
    )
    assert not re.search(r"\b20\d\d-\d\d-\d\d|\d\d:\d\d:\d\d", text)
    assert str(tmp_path) not in text
    assert not list(tmp_path.rglob("*.partial"))


def test_tables_have_as_many_cells_as_their_heads(folder: Path) -> None:
    """No value breaks a table: every row of a block has the same number of unescaped
    bars.
    """
    for block in (folder / "README.md").read_text().split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) <= 1, block


@pytest.mark.parametrize("scenarios", [(0, 1, 2, 3, 4), ()])
def test_without_matplotlib_or_files_there_are_no_pictures(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    scenarios: tuple[int, ...],
) -> None:
    """The card is written all the same, names the files that are there and links no
    picture.
    """
    size, manifest = make(tmp_path, scenarios=scenarios)
    if scenarios:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    written = write(tmp_path, size, manifest)
    assert [path.name for path in written] == ["README.md", "croissant.json"]
    assert "![" not in written[0].read_text()
    assert len(json.loads(written[1].read_text())["distribution"]) == len(scenarios)


def test_a_partial_data_set_says_so(tmp_path: Path) -> None:
    """Before it is complete there is no data set hash, and subsets count what is
    there.
    """
    text = card(*make(tmp_path, scenarios=(0, 3)))
    assert "none before it is complete" in text
    assert "| train | 0-1 | 1 of 2 |" in text
    assert "Statistics of train" not in text


def test_a_copy_of_tolerant_identity_does_not_promise_equal_bits(
    tmp_path: Path,
) -> None:
    """The sentence about equal bits depends on the manifest."""
    size, manifest = make(tmp_path, scenarios=(0,))
    assert "same bits on every" in card(size, manifest)
    assert "same bits on every" not in card(size, manifest, identity="tolerance")


def test_snow_snow_comes_to_rest_and_its_card_says_so() -> None:
    """The note of multimaterial is on its card and on no other."""
    for name in registry.load().splits:
        size = registry.load().size(name, "tiny")
        text = card(size, Manifest(split=name, size="tiny", version=size.version))
        assert ("Pairs with snow come to rest first" in text) == (
            name == "multimaterial"
        )


@pytest.mark.parametrize(
    ("split", "variables", "axes"),
    [
        ("cavity", {"velocity", "wall_velocity"}, "none"),
        ("poiseuille", {"velocity", "body_force"}, "x, y"),
        ("curl-noise-3d", set(), "x, y, z"),
    ],
)
def test_a_card_lists_the_variables_of_its_files(
    split: str, variables: set[str], axes: str
) -> None:
    """What drives the flow, and velocities where they are stored; one column of the
    statistics for each axis.
    """
    size = registry.load().size(split, "tiny")
    measured = size.measured
    assert measured is not None
    manifest = Manifest(split=split, size="tiny", version=size.version)
    text = card(size, manifest, statistics=measured.statistics)
    for name in ("velocity", "wall_velocity", "body_force"):
        assert (f"| `{name}` |" in text) == (name in variables)
    assert f"| periodic axes | {axes} |" in text
    header = "|  | " + " | ".join("xyz"[: size.dimension]) + " |"
    assert header in text


def test_the_twin_floor_is_the_mean_over_test(tmp_path: Path) -> None:
    """Two twins that drift to 2e-3 and 4e-3 have a floor of 3e-3 at the last frame."""
    size, manifest = make(tmp_path, scenarios=(3, 4))
    floors = ((1e-6, 2e-3), (3e-6, 4e-3))
    files = tuple(
        e.model_copy(update={"twin_floor": f})
        for e, f in zip(manifest.files, floors, strict=True)
    )
    assert "2e-06 at the first predicted frame, 0.003 at the last" in card(
        size, manifest, files=files
    )


def test_hostile_text_of_a_registry_stays_text() -> None:
    """Titles and citations of other packages can hold no links, HTML or table cells of
    their own.
    """
    size = registry.load().size("cavity", "tiny")
    split = registry.load().split("cavity")
    hostile = split.model_copy(
        update={
            "title": "<script>alert(1)</script>",
            "description": "a | b ![x](http://example.org) [y](z)\n---\n# head",
            "citation": 'quote " and \\ back `tick`',
        }
    )
    manifest = Manifest(split="cavity", size="tiny", version="1.0.0")
    text = cards.dataset_card(size, hostile, manifest, pictures=[])
    _, head, body = text.split("---\n", 2)
    assert yaml.safe_load(head)["pretty_name"].startswith("<script>")
    assert "<script>" not in body
    assert not re.search(r"(?<!\\)\]\((http|z)", body)
    assert "\n# head" not in body
    assert (
        json.loads(croissant_json(size, hostile, manifest))["citeAs"]
        == hostile.citation
    )


@given(st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Zl", "Zp"])))
def test_escaping_only_adds_backslashes(text: str) -> None:
    """Taking the backslashes away gives the text on one line; no special character
    stands bare.
    """
    escaped = escape(text)
    assert re.sub(r"\\([\\`*_\[\]<>|#&~$])", r"\1", escaped) == " ".join(text.split())
    assert not re.search(r"[`*_\[\]<>|#&~$]", re.sub(r"\\.", "", escaped))


def test_tables_set_numbers_flush_right() -> None:
    """Whole columns of numbers are flush right, with thousands apart; code stays
    code.
    """
    assert markdown(("n", "`code`|"), [(1234, "`a_b`"), (5, "c_d")]).splitlines() == [
        r"| n | \`code\`\| |",
        "| ---: | --- |",
        "| 1,234 | `a_b` |",
        r"| 5 | c\_d |",
    ]
