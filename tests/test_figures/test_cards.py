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
from rotating_disc import write_swirl

from lagbench.data import registry
from lagbench.data.layout import PICTURES, dataset_folder
from lagbench.data.manifest import (
    Manifest,
    build_manifest,
    describe_file,
)
from lagbench.data.registry import Size
from lagbench.figures.tables import escape
from lagbench.make import cards
from lagbench.make.croissant import croissant_json

STATISTICS = {
    "position_mean": (0.5, 0.25),
    "velocity_std": (1.25e-3, 2.5e-3),
}
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
        facts = {"kinetic_energy_first": 0.125 + scenario}
        entries.append(entry.model_copy(update={"facts": facts}))
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
    split = registry.load().split(size.split)
    return cards.write_cards(root, size, split, manifest)


def card(size: Size, manifest: Manifest, **update: object) -> str:
    """Return the card without pictures of a data set whose manifest has something
    else.
    """
    split = registry.load().split(size.split)
    changed = manifest.model_copy(update=update)
    return cards.dataset_card(size, split, changed, pictures=[])


def run_program(*command: str) -> subprocess.CompletedProcess[str]:
    """Run another program to its end."""
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write cards of a complete made-up cavity tiny."""
    root = tmp_path_factory.mktemp("root")
    size, manifest = make(root)
    assert manifest.complete
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cards, "paint_pictures", PAINT_PICTURES)
        written = write(root, size, manifest)
    folder = dataset_folder(root, "cavity", "tiny", 2)
    names = {path.relative_to(folder).as_posix() for path in written}
    assert names == {"README.md", "croissant.json", *PICTURES}
    return folder


@pytest.mark.slow
def test_mlcroissant_accepts_and_reads_the_document(folder: Path) -> None:
    """The reference validator only remarks on the missing date; records are what the
    manifest says.
    """
    document = str(folder / "croissant.json")
    tool = Path(sys.executable).parent / "mlcroissant"
    validation = run_program(str(tool), "validate", "--jsonld", document)
    assert validation.returncode == 0, validation.stderr
    remarks = re.findall(r"^ +-  .*$", validation.stderr, re.MULTILINE)
    for remark in remarks:
        assert "datePublished" in remark
    assert "Done" in validation.stderr
    reading = run_program(sys.executable, "-c", LOADER, document)
    assert reading.returncode == 0, reading.stderr
    rows = json.loads(reading.stdout)
    scenarios = [row["scenario"] for row in rows]
    assert scenarios == [0, 1, 2, 3, 4]
    subsets = {row["subset"] for row in rows}
    assert subsets == {"train", "valid", "test"}
    for row in rows:
        assert row["frames"] == 4
        assert row["particles"] == 324


def test_every_file_is_named_with_its_true_sha256(folder: Path) -> None:
    """Hash and length of each file object are those of the bytes on disk."""
    document = json.loads((folder / "croissant.json").read_text())
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    assert document["license"] == "https://creativecommons.org/licenses/by/4.0/"
    objects = {entry["contentUrl"]: entry for entry in document["distribution"]}
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*.nc")}
    assert set(objects) == files
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
    lines = body.splitlines()
    for name, parameter in size.parameters.items():
        rows = [line for line in lines if line.startswith(f"| `{name}` |")]
        row = rows[0]
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
    citation = " ".join(split.citation.split())
    assert escape(citation) in body


def written_cards(root: Path, size: Size, manifest: Manifest) -> dict[Path, bytes]:
    """Write cards and return the content of their files."""
    return {path: path.read_bytes() for path in write(root, size, manifest)}


@pytest.mark.slow
@pytest.mark.usefixtures("as_shipped")
def test_the_same_manifest_gives_the_same_bytes(tmp_path: Path) -> None:
    """Cards written twice, and by another process at another time, do not differ; no
    date is in them.
    """
    size, manifest = make(tmp_path)
    first = written_cards(tmp_path, size, manifest)
    second = written_cards(tmp_path, size, manifest)
    assert first == second
    text = ""
    for path, content in first.items():
        if path.suffix != ".png":
            text += content.decode()
    assert not re.search(r"\b20\d\d-\d\d-\d\d|\d\d:\d\d:\d\d", text)
    assert str(tmp_path) not in text
    assert not list(tmp_path.rglob("*.partial"))


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
    readme, croissant = write(tmp_path, size, manifest)
    assert readme.name == "README.md"
    assert croissant.name == "croissant.json"
    assert "![" not in readme.read_text()
    document = json.loads(croissant.read_text())
    assert len(document["distribution"]) == len(scenarios)


def test_the_predictability_limit_is_the_mean_over_test(tmp_path: Path) -> None:
    """Two perturbed runs drift to 2e-3 and 4e-3, so the limit is 3e-3 at the end."""
    size, manifest = make(tmp_path, scenarios=(3, 4))
    limits = ((1e-6, 2e-3), (3e-6, 4e-3))
    files = []
    for entry, limit in zip(manifest.files, limits, strict=True):
        files.append(entry.model_copy(update={"twin_floor": limit}))
    text = card(size, manifest, files=tuple(files))
    assert "2e-06 at the first predicted frame, 0.003 at the last" in text


def test_hostile_text_of_a_registry_stays_text() -> None:
    """Titles and citations of other packages can hold no links, HTML or table cells of
    their own.
    """
    size = registry.load().size("cavity", "tiny")
    split = registry.load().split("cavity")
    hostile_text = {
        "title": "<script>alert(1)</script>",
        "description": "a | b ![x](http://example.org) [y](z)\n---\n# head",
        "citation": 'quote " and \\ back `tick`',
    }
    hostile = split.model_copy(update=hostile_text)
    manifest = Manifest(split="cavity", size="tiny", version="1.0.0")
    text = cards.dataset_card(size, hostile, manifest, pictures=[])
    _, head, body = text.split("---\n", 2)
    assert yaml.safe_load(head)["pretty_name"].startswith("<script>")
    assert "<script>" not in body
    assert not re.search(r"(?<!\\)\]\((http|z)", body)
    assert "\n# head" not in body
    document = json.loads(croissant_json(size, hostile, manifest))
    assert document["citeAs"] == hostile.citation
