"""Cards: valid Croissant, complete Markdown, true hashes, equal bytes, no dates."""

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
from conftest import DRAW
from swirls import write_swirl

from lagbench.data import registry
from lagbench.data.layout import dataset_folder
from lagbench.data.manifest import Manifest, describe_file, merge
from lagbench.data.registry import Size
from lagbench.figures.tables import escape
from lagbench.make import cards
from lagbench.make.cards import croissant_json

STATISTICS = {"position_mean": (0.5, 0.25), "velocity_std": (1.25e-3, 2.5e-3)}
LOADER = """
import json, sys, mlcroissant
rows = []
for record in mlcroissant.Dataset(sys.argv[1]).records("scenarios"):
    rows.append({name.split("/")[-1]: value for name, value in record.items()})
print(json.dumps(rows))
"""
DATE_OR_TIME = re.compile(r"\b20\d\d-\d\d-\d\d|\d\d:\d\d:\d\d")
BAR = re.compile(r"(?<!\\)\|")  # between cells of a Markdown table


def make(
    root: Path, split: str = "cavity", *, scenarios: tuple[int, ...] = (0, 1, 2, 3, 4)
) -> tuple[Size, Manifest]:
    """Write swirls and their manifest."""
    size = registry.load().size(split, "tiny")
    entries = []
    for scenario in scenarios:
        write_swirl(root, split, scenario, frames=4)
        entry = describe_file(root, size.key(scenario))
        facts = {"kinetic_energy_first": 0.125 + scenario}
        entries.append(entry.model_copy(update={"facts": facts}))
    manifest = merge(
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
    """Return the card of a changed manifest, without pictures."""
    split = registry.load().split(size.split)
    changed = manifest.model_copy(update=update)
    return cards.dataset_card(size, split, changed, pictures=[])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write cards of a complete made-up cavity tiny."""
    root = tmp_path_factory.mktemp("root")
    size, manifest = make(root)
    assert manifest.complete
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cards, "_draw", DRAW)
        written = write(root, size, manifest)
    folder = dataset_folder(root, "cavity", "tiny", 2)
    names = {p.relative_to(folder).as_posix() for p in written}
    assert names == {"README.md", "croissant.json", *cards.PICTURES}
    return folder


def test_mlcroissant_accepts_and_reads_the_document(folder: Path) -> None:
    """The reference validator only remarks on the missing date."""
    tool = Path(sys.executable).parent / "mlcroissant"
    document = str(folder / "croissant.json")
    command = [str(tool), "validate", "--jsonld", document]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    remarks = re.findall(r"^ +-  .*$", done.stderr, re.MULTILINE)
    assert all("datePublished" in remark for remark in remarks), remarks
    assert "Done" in done.stderr

    command = [sys.executable, "-c", LOADER, document]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout)
    assert [row["scenario"] for row in rows] == [0, 1, 2, 3, 4]
    assert {row["subset"] for row in rows} == {"train", "valid", "test"}
    assert {row["frames"] for row in rows} == {4}
    assert {row["particles"] for row in rows} == {324}


def test_every_file_is_named_with_its_true_sha256(folder: Path) -> None:
    """Hash and length of each file object are those of the bytes on disk."""
    document = json.loads((folder / "croissant.json").read_text())
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    assert document["license"] == "https://creativecommons.org/licenses/by/4.0/"
    objects = {entry["contentUrl"]: entry for entry in document["distribution"]}
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*.nc")}
    assert set(objects) == files
    for name, entry in objects.items():
        data = (folder / name).read_bytes()
        assert entry["sha256"] == hashlib.sha256(data).hexdigest()
        assert entry["contentSize"] == f"{len(data)} B"


def test_the_card_says_all_that_it_must(folder: Path) -> None:
    """Hashes, statistics, parameters with units, commands, licence and citation."""
    text = (folder / "README.md").read_text()
    _, head, body = text.split("---\n", 2)
    assert yaml.safe_load(head)["license"] == "cc-by-4.0"
    size = registry.load().size("cavity", "tiny")
    split = registry.load().split("cavity")
    manifest = json.loads((folder / "croissant.json").read_text())
    for record in manifest["recordSet"][0]["data"]:
        assert record["scenarios/content_sha256"] in body
    lines = body.splitlines()
    for name, parameter in size.parameters.items():
        (row,) = [line for line in lines if line.startswith(f"| `{name}` |")]
        assert escape(parameter.unit) in row
        assert escape(parameter.description) in row
    assert "velocity std | 0.00125 | 0.0025" in body
    assert "CC-BY-4.0" in body
    assert "lagbench generate --split cavity --size tiny" in body
    assert "--regenerate 2" in body
    assert escape(split.citation) in body


def test_every_picture_of_the_card_is_there(folder: Path) -> None:
    """Links resolve, and each picture has words in its place."""
    text = (folder / "README.md").read_text()
    links = re.findall(r"!\[([^\]]+)\]\(([^)]+)\)", text)
    assert [target for _, target in links] == list(cards.PICTURES)
    for words, target in links:
        picture = (folder / target).read_bytes()
        assert len(words) > 10
        assert len(picture) < 300_000
        assert picture.startswith(b"\x89PNG")


@pytest.mark.usefixtures("as_shipped")
def test_the_same_manifest_gives_the_same_bytes(tmp_path: Path) -> None:
    """No date and no folder is in the cards."""
    size, manifest = make(tmp_path)
    first = {path: path.read_bytes() for path in write(tmp_path, size, manifest)}
    second = {path: path.read_bytes() for path in write(tmp_path, size, manifest)}
    assert first == second
    for path, data in first.items():
        if path.suffix != ".png":
            assert not DATE_OR_TIME.search(data.decode())
            assert str(tmp_path) not in data.decode()
    assert not list(tmp_path.rglob("*.partial"))


def test_tables_have_as_many_cells_as_their_heads(folder: Path) -> None:
    """No value breaks a table: all its lines have as many bars."""
    for block in (folder / "README.md").read_text().split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        bar_counts = {len(BAR.findall(line)) for line in lines}
        assert len(bar_counts) <= 1, block


@pytest.mark.parametrize("scenarios", [(0, 1, 2, 3, 4), ()])
def test_without_matplotlib_or_files_there_are_no_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenarios: tuple[int, ...]
) -> None:
    """The card is written all the same, and names the files that exist."""
    size, manifest = make(tmp_path, scenarios=scenarios)
    if scenarios:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    written = write(tmp_path, size, manifest)
    assert [path.name for path in written] == ["README.md", "croissant.json"]
    assert "![" not in written[0].read_text()
    assert len(json.loads(written[1].read_text())["distribution"]) == len(scenarios)


def test_a_partial_data_set_says_so(tmp_path: Path) -> None:
    """Before it is complete there is no data set hash, and subsets are counted."""
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
    noted = []
    for name in registry.load().splits:
        size = registry.load().size(name, "tiny")
        manifest = Manifest(split=name, size="tiny", version=size.version)
        if "Pairs with snow come to rest first" in card(size, manifest):
            noted.append(name)
    assert noted == ["multimaterial"]


def test_the_predictability_limit_is_the_mean_over_test(tmp_path: Path) -> None:
    """Two perturbed runs that drift to 2e-3 and 4e-3 have a limit of 3e-3."""
    size, manifest = make(tmp_path, scenarios=(3, 4))
    limits = ((1e-6, 2e-3), (3e-6, 4e-3))
    files = []
    for entry, limit in zip(manifest.files, limits, strict=True):
        files.append(entry.model_copy(update={"twin_floor": limit}))
    text = card(size, manifest, files=tuple(files))
    assert "2e-06 at the first predicted frame, 0.003 at the last" in text


def test_hostile_text_of_a_registry_stays_text() -> None:
    """Titles and citations of other packages hold no links, HTML or table cells."""
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
    document = json.loads(croissant_json(size, hostile, manifest))
    assert document["citeAs"] == hostile.citation
