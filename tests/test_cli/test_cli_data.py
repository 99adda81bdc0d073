"""The commands about data sets: list, info, generate, verify, cite, doctor, clean."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tomllib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import SIZE, SPLIT
from exchange_readers import straight_runs
from typer.testing import Result

import lagbench
from lagbench.cli import doctor
from lagbench.cli.doctor import REQUIRED_LIBRARIES
from lagbench.data.registry import load
from lagbench.make.generate import GenerationResult
from lagbench.references.shipped import shipped

Run = Callable[..., Result]

CLONE = Path(lagbench.__file__).parents[1]


def files_below(folder: Path) -> set[str]:
    """Return the names of all files, relative to the folder."""
    names = set()
    for path in folder.rglob("*"):
        if path.is_file():
            names.add(path.relative_to(folder).as_posix())
    return names


def test_list_shows_every_size(run: Run, generated: GenerationResult) -> None:
    """The table has a row for each size of each split of the registry."""
    text = run("list", "--root", generated.root).stdout
    rows = [line for line in text.splitlines() if re.search(" (full|mini|tiny) ", line)]
    assert len(rows) == sum(len(split.sizes) for split in load().splits.values())


def test_list_has_counts_bytes_time_and_local_data_as_json(
    run: Run, generated: GenerationResult
) -> None:
    data = json.loads(run("list", "--root", generated.root, "--json").stdout)
    sizes = {(entry["split"], entry["size"]): entry for entry in data["sizes"]}
    local = sizes[SPLIT, SIZE]
    assert local["present"] == {"train": 2, "valid": 1, "test": 2}
    assert local["picture"].endswith("scenarios.png")
    full = sizes["cavity", "full"]
    assert full["frames"] == 50_400
    assert set(full["present"].values()) == {0}
    assert full["bytes"] == 50_400 * 8192 * 16 + 84 * 65536
    assert full["seconds"] > 60.0


def test_list_shows_one_split_with_its_references(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has the sizes, the version and the measured scores of the references."""
    monkeypatch.delenv("LAGBENCH_REGISTRY")
    text = run("list", "cavity", "--root", tmp_path).stdout
    assert text == run("list", "--split", "cavity", "--root", tmp_path).stdout
    entry = load().split("cavity")
    assert f"cavity {entry.version}" in text
    for size in entry.sizes:
        assert re.search(rf"^{size} +\d+/", text, re.MULTILINE)
    assert "curl-noise" not in text
    assert "vorticity_nrmse" in text

    command = ("list", "cavity", "--root", tmp_path, "--json")
    data = json.loads(run(*command).stdout)
    assert [overview["size"] for overview in data["sizes"]] == list(entry.sizes)
    measured = shipped(load().size("cavity", "mini"))
    assert measured is not None
    for name, value in data["references"]["mini"].items():
        assert value == pytest.approx(measured[name].scores["vorticity_nrmse"].mean)
    assert "persistence" in data["references"]["mini"]


def test_list_shows_a_local_split_by_its_folder(run: Run, tmp_path: Path) -> None:
    """The references of such a split are measured with each score."""
    np.save(tmp_path / "runs.npy", np.stack(straight_runs(3)))
    own = lagbench.adopt(
        tmp_path / "runs.npy",
        output=tmp_path / "own",
        radius=0.1,
        frame_interval=0.25,
    )
    result = run("list", f"{own.folder}/")
    assert result.exit_code == 0
    assert "with each score" in result.stdout
    result = run("list", "cavitty", "--root", tmp_path)
    assert result.exit_code == 2
    assert "'cavity'" in result.stderr


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

    data = json.loads(run("info", SPLIT, "--size", SIZE, "--json").stdout)
    size = data["sizes"][SIZE]
    assert size["parameters"]["modulus"]["unit"] == "mass/s^2"
    assert size["subsets"]["test"] == [3, 4]


def test_generate_and_verify_one_scenario(run: Run, tmp_path: Path) -> None:
    """Both print a report for people, JSON for machines, and nothing when quiet."""
    data_set = [SPLIT, "--size", SIZE, "--root", tmp_path]
    options = [*data_set, "--scenarios", "2"]
    plan = run("generate", *options, "--dry-run").stdout
    assert re.search(
        r"(?s)1 scenario to simulate.*disk .*bytes.*free.*time +about \d+ s", plan
    )
    first = run("generate", *options)
    assert first.exit_code == 0, first.output
    assert "missing 0-1,3-4" in first.stdout
    # progress, on a slow machine
    assert all("scenarios" in line for line in first.stderr.splitlines())

    second = json.loads(run("generate", *options, "--json").stdout)
    assert second["simulated"] == []
    assert second["kept"] == [2]
    assert second["complete"] is False
    assert run("generate", *options, "--quiet").output == ""

    verified = run("verify", *data_set)
    assert verified.exit_code == 0
    assert "train lacks 0-1" in verified.stderr
    assert run("verify", *data_set, "--complete").exit_code == 4


def test_damage_of_a_data_set_exits_4(run: Run, copied: Callable[[], Path]) -> None:
    """It is described on stdout and named on stderr."""
    root = copied()
    path = root / SPLIT / SIZE / "v2" / "valid" / "0002.nc"
    path.write_bytes(path.read_bytes()[:-500])
    result = run("verify", SPLIT, "--size", SIZE, "--root", root, "--json")
    assert result.exit_code == 4
    assert json.loads(result.stdout)["subsets"][1]["wrong"] == [2]
    assert "0002.nc" in result.stderr


def test_a_picture_of_a_damaged_scenario_names_the_remedy(
    run: Run, copied: Callable[[], Path], tmp_path: Path
) -> None:
    root = copied()
    path = root / SPLIT / SIZE / "v2" / "test" / "0003.nc"
    path.write_text("no netCDF")
    picture = tmp_path / "x.png"
    result = run("plot", SPLIT, "--size", SIZE, "--root", root, "-o", picture)
    assert result.exit_code == 4
    assert "lagbench generate" in result.stderr


def test_citation_readme_and_changelog_have_the_version() -> None:
    version = project_version()
    citation = yaml.safe_load((CLONE / "CITATION.cff").read_text())
    assert citation["version"] == version
    assert f"version = {{{version}}}" in (CLONE / "README.md").read_text()


def project_version() -> str:
    project = tomllib.loads((CLONE / "pyproject.toml").read_text())["project"]
    version: str = project["version"]
    return version


def test_a_tag_names_the_version() -> None:
    """The tag of a release is v and the version, which heads the changelog too."""
    # Outside of git, and in an archive that was unpacked in another repository, there
    # are no tags of ours.
    if not (CLONE / ".git").exists() or shutil.which("git") is None:
        pytest.skip("no clone")
    command = ["git", "-C", str(CLONE), "tag", "--points-at", "HEAD"]
    command += ["--list", "v[0-9]*"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    tags = done.stdout.split()
    if not tags:
        pytest.skip("no tag at HEAD")
    version = project_version()
    assert tags == [f"v{version}"]
    changelog = (CLONE / "CHANGELOG.md").read_text()
    headings = re.findall(r"^## (.*)$", changelog, re.MULTILINE)
    assert version in headings[0]


def bibtex_fields(text: str) -> dict[str, str]:
    """Return the fields of a BibTeX entry."""
    assert text.count("{") == text.count("}")
    assert text.strip().partition("{")[0] in {"@software", "@misc"}
    return dict(re.findall(r"^  (\w+) = \{(.*)\},$", text, re.MULTILINE))


def test_bibtex_of_lagbench_is_that_of_citation_cff(run: Run) -> None:
    citation = yaml.safe_load((CLONE / "CITATION.cff").read_text())
    assert bibtex_fields(run("cite", "--bibtex").stdout) == {
        "author": "{The lagbench authors}",
        "title": citation["title"],
        "version": citation["version"],
        "year": str(citation["date-released"].year),
    }


def test_bibtex_of_a_split_has_its_version_and_every_hash(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LAGBENCH_REGISTRY")
    registry = load()
    fields = bibtex_fields(run("cite", "cavity", "--bibtex").stdout)
    assert fields["version"] == registry.split("cavity").version
    measured = registry.measured["cavity"]
    assert len(measured) == 3
    for size in measured.values():
        assert size.dataset_sha256 in fields["note"]


def test_without_a_split_lagbench_itself_is_cited(run: Run) -> None:
    result = run("cite")
    assert result.exit_code == 0
    assert lagbench.__version__ in result.stdout
    assert json.loads(run("cite", "--json").stdout)["version"] == lagbench.__version__


def test_a_citation_names_the_work_behind_the_split(run: Run) -> None:
    assert "Ghia" in run("cite", "cavity").stdout
    assert json.loads(run("cite", "cavity", "--json").stdout)["licence"] == "CC-BY-4.0"


@pytest.mark.parametrize("words", [("--bibtex",), ("cavity", "--bibtex")])
def test_bibtex_as_json_is_the_same_text(words: tuple[str, ...], run: Run) -> None:
    text = run("cite", *words).stdout
    data = json.loads(run("cite", *words, "--json").stdout)
    assert data == {"bibtex": text.removesuffix("\n")}


def test_doctor_checks_every_library_that_the_package_declares() -> None:
    declared = set()
    for requirement in requires("lagbench") or []:
        if "extra ==" not in requirement:
            declared.add(re.split(r"[^\w.-]", requirement)[0].lower())
    assert {name.lower() for name in REQUIRED_LIBRARIES} == declared


def test_doctor_names_one_command_for_all_that_is_missing(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says what cannot be done without it; nothing is broken."""
    installed_version = doctor.version

    def version(name: str) -> str:
        if name in ("taichi", "statsmodels"):
            raise PackageNotFoundError(name)
        return installed_version(name)

    monkeypatch.setattr(doctor, "version", version)
    result = run("doctor", "--root", tmp_path)
    assert result.exit_code == 0
    last_line = result.stdout.splitlines()[-1]
    assert "pip install" in last_line
    assert "[generate,baselines]" in last_line
    for extra in ("generate", "baselines"):
        assert doctor.PURPOSES[extra] in result.stdout


def test_doctor_knows_the_libraries_of_every_extra() -> None:
    declared = {}
    for requirement in requires("lagbench") or []:
        name, _, extra = requirement.partition("extra ==")
        library = re.split(r"[^\w.-]", name)[0].lower()
        if extra.strip(" \"'") in doctor.PURPOSES:
            declared[library] = extra.strip(" \"'")
    assert declared == doctor.OPTIONAL_LIBRARIES


def test_doctor_finds_this_machine_fit(run: Run, tmp_path: Path) -> None:
    data = json.loads(run("doctor", "--root", tmp_path, "--json").stdout)
    states = {check["name"]: check["state"] for check in data["checks"]}
    assert states["numpy"] == states["registry"] == states["data folder"] == "ok"


def test_doctor_finds_a_root_that_cannot_be_written(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = run("doctor", "--root", tmp_path / "file" / "data")
    assert result.exit_code == 1
    assert "broken: data folder" in result.stderr


STRANGE_FILES = ("notes.txt", "mine.png", "pictures/mine.png")


def add_strange_files(root: Path) -> set[str]:
    """Put a user's own files into a data set; return their names below the root."""
    names = {f"{SPLIT}/{SIZE}/v2/{name}" for name in STRANGE_FILES}
    for name in names:
        (root / name).write_bytes(b"mine")
    return names


def test_clean_removes_a_data_set_but_no_other_file(
    run: Run, copied: Callable[[], Path]
) -> None:
    root = copied()
    strange_files = add_strange_files(root)
    words = ["clean", SPLIT, "--size", SIZE, "--root", root]
    assert run(*words).exit_code == 0
    assert files_below(root) == strange_files

    for name in strange_files:
        (root / name).unlink()
    assert run(*words).exit_code == 0
    assert list(root.iterdir()) == []
    assert run(*words).exit_code == 0


def test_clean_may_remove_leftovers_only(run: Run, copied: Callable[[], Path]) -> None:
    root = copied()
    leftover = root / SPLIT / SIZE / "v2" / "test" / ".0003.nc.1.partial"
    leftover.write_text("")
    result = run(
        "clean", SPLIT, "--size", SIZE, "--root", root, "--leftovers", "--json"
    )
    assert json.loads(result.stdout)["removed"] == [str(leftover)]


def test_a_dry_run_of_clean_removes_nothing_and_takes_no_lock(
    run: Run,
    copied: Callable[[], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = copied()
    add_strange_files(root)
    names = files_below(root)
    monkeypatch.setattr("lagbench.make.clean.dataset_lock", None)
    result = run("clean", SPLIT, "--size", SIZE, "--root", root, "--dry-run")
    assert result.exit_code == 0, result.output
    assert "10 files" in result.stdout
    assert files_below(root) == names


def test_clean_leaves_links(
    run: Run, copied: Callable[[], Path], tmp_path: Path
) -> None:
    """A subset that lies on another disk loses its files, not its folder."""
    root = copied()
    folder = root / SPLIT / SIZE / "v2"
    elsewhere = tmp_path / "elsewhere"
    (folder / "train").rename(elsewhere)
    (folder / "train").symlink_to(elsewhere)
    assert run("clean", SPLIT, "--size", SIZE, "--root", root).exit_code == 0
    assert list(elsewhere.iterdir()) == []
    assert [path.name for path in folder.iterdir()] == ["train"]


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
