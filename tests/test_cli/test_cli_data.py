"""The commands about data sets: list, info, generate, verify, cite, doctor."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from command_line import Result
from conftest import SIZE, SPLIT
from trajectories import straight_runs

import lagbench
from lagbench.data.registry import load
from lagbench.make.generate import GenerationResult

Run = Callable[..., Result]
Copied = Callable[[], Path]


def printed_data(run: Run, *words: object) -> dict[str, Any]:
    """Return what a command prints as JSON."""
    result = run(*words, "--json")
    data: dict[str, Any] = json.loads(result.stdout)
    return data


CLONE = Path(lagbench.__file__).parents[1]


def test_list_shows_every_size(run: Run, generated: GenerationResult) -> None:
    """The table has a row for each size of each split of the registry."""
    text = run("list", "--root", generated.root).stdout
    rows = re.findall(" (full|mini|tiny) ", text)
    size_count = sum(len(split.sizes) for split in load().splits.values())
    assert len(rows) == size_count


def test_list_has_counts_bytes_time_and_local_data_as_json(
    run: Run, generated: GenerationResult
) -> None:
    data = printed_data(run, "list", "--root", generated.root)
    sizes = {}
    for entry in data["sizes"]:
        sizes[entry["split"], entry["size"]] = entry
    local = sizes[SPLIT, SIZE]
    assert local["present"] == {"train": 2, "valid": 1, "test": 2}
    assert local["picture"].endswith("scenarios.png")
    full = sizes["cavity", "full"]
    frame_count = 50_400
    assert full["frames"] == frame_count
    assert set(full["present"].values()) == {0}
    assert full["bytes"] > frame_count * 8192 * 16
    assert full["seconds"] > 60.0


def test_what_strangers_say_of_a_split_commands_no_terminal(
    run: Run, tmp_path: Path
) -> None:
    """Title, description, licence and parameters: no escape codes, and no line breaks
    that would begin a line of their own.
    """
    runs = np.stack(straight_runs(3))
    np.save(tmp_path / "runs.npy", runs)
    own = lagbench.adopt(
        tmp_path / "runs.npy",
        output=tmp_path / "own",
        radius=0.1,
        frame_interval=0.25,
        axes="trajectory,frame,particle,space",
    )
    path = own.folder / "split.yaml"
    description = yaml.safe_load(path.read_text())
    words = "\x1b]0;red\x07\x1b[2J\nfake: all is well"
    split = description["splits"]["own"]
    for key in ("title", "description", "licence"):
        split[key] = words
    split["parameters"]["density"]["description"] = words
    path.write_text(yaml.safe_dump(description))
    result = run("info", own.folder)
    assert result.exit_code == 0
    assert not re.search("[\x00-\x09\x0b-\x1f]", result.stdout)
    assert "fake: all is well" in result.stdout
    lines = [line.strip() for line in result.stdout.splitlines()]
    assert not any(line.startswith("fake") for line in lines)


def test_info_shows_parameters_with_units_and_the_local_data(
    run: Run, generated: GenerationResult
) -> None:
    options = ["--size", SIZE, "--root", generated.root]
    by_argument = run("info", SPLIT, *options)
    by_option = run("info", "--split", SPLIT, *options)
    assert by_argument.exit_code == 0
    text = by_argument.stdout
    assert text == by_option.stdout
    assert re.search(r"velocity_scale +\S+ +\S+ +\S+ +\[length/s\]", text)
    assert str(generated.folder) in text
    assert "pictures/scenarios.png" in text

    data = printed_data(run, "info", SPLIT, "--size", SIZE)
    size = data["sizes"][SIZE]
    assert size["parameters"]["modulus"]["unit"] == "mass/s^2"
    assert size["subsets"]["test"] == [3, 4]


def test_generate_and_verify_one_scenario(run: Run, tmp_path: Path) -> None:
    """Both print a report for people, JSON for machines, and nothing when quiet."""
    data_set = [SPLIT, "--size", SIZE, "--root", tmp_path]
    options = [*data_set, "--scenarios", "2"]
    plan = run("generate", *options, "--dry-run").stdout
    pattern = r"(?s)1 scenario to simulate.*disk .*bytes.*free.*time +about \d+ s"
    assert re.search(pattern, plan)
    first = run("generate", *options)
    assert first.exit_code == 0, first.output
    assert "missing 0-1,3-4" in first.stdout
    # progress, on a slow machine
    for line in first.stderr.splitlines():
        assert "scenarios" in line

    second = printed_data(run, "generate", *options)
    assert second["simulated"] == []
    assert second["kept"] == [2]
    assert second["complete"] is False
    assert run("generate", *options, "--quiet").output == ""

    verified = run("verify", *data_set)
    assert verified.exit_code == 0
    assert "train lacks 0-1" in verified.stderr
    complete = run("verify", *data_set, "--complete")
    assert complete.exit_code == 4


def test_damage_of_a_data_set_exits_4(run: Run, copied: Copied) -> None:
    """It is described on stdout and named on stderr."""
    root = copied()
    path = root / SPLIT / SIZE / "v2" / "valid" / "0002.nc"
    content = path.read_bytes()
    path.write_bytes(content[:-500])
    result = run("verify", SPLIT, "--size", SIZE, "--root", root, "--json")
    assert result.exit_code == 4
    _, valid, _ = json.loads(result.stdout)["subsets"]
    assert valid["wrong"] == [2]
    assert "0002.nc" in result.stderr


def citation_file() -> dict[str, Any]:
    """Return the content of CITATION.cff."""
    text = (CLONE / "CITATION.cff").read_text()
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def test_citation_readme_and_changelog_have_the_version() -> None:
    version = project_version()
    assert citation_file()["version"] == version
    readme = (CLONE / "README.md").read_text()
    assert f"version = {{{version}}}" in readme


def project_version() -> str:
    text = (CLONE / "pyproject.toml").read_text()
    version: str = tomllib.loads(text)["project"]["version"]
    return version


def bibtex_fields(text: str) -> dict[str, str]:
    """Return the fields of a BibTeX entry."""
    assert text.count("{") == text.count("}")
    kind, _, _ = text.strip().partition("{")
    assert kind in {"@software", "@misc"}
    field = r"^  (\w+) = \{(.*)\},$"
    return dict(re.findall(field, text, re.MULTILINE))


def test_bibtex_of_lagbench_is_that_of_citation_cff(run: Run) -> None:
    citation = citation_file()
    bibtex = run("cite").stdout
    assert bibtex_fields(bibtex) == {
        "author": "{The lagbench authors}",
        "title": citation["title"],
        "version": citation["version"],
        "year": str(citation["date-released"].year),
    }


def test_a_citation_names_the_work_behind_the_split(run: Run) -> None:
    assert "Ghia" in run("cite", "cavity").stdout


def test_doctor_finds_this_machine_fit(run: Run, tmp_path: Path) -> None:
    data = printed_data(run, "doctor", "--root", tmp_path)
    states = {check["name"]: check["state"] for check in data["checks"]}
    for name in ("numpy", "registry", "data folder"):
        assert states[name] == "ok"


def test_a_broken_local_split_hides_no_other(run: Run, tmp_path: Path) -> None:
    """Each unreadable description gives a warning; all other splits are listed."""
    for name in ("mine", "pipe"):
        (tmp_path / name).mkdir()
    (tmp_path / "mine" / "split.yaml").write_text("splits: [")
    os.mkfifo(tmp_path / "pipe" / "split.yaml")
    result = run("list", "--root", tmp_path)
    assert result.exit_code == 0
    for name in ("mine", "pipe"):
        assert f"warning: {name} " in result.stderr
    assert "cavity" in result.stdout
