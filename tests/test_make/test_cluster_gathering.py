"""Data sets made in parts, as by the jobs of an array, and put together at the end."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from cluster_bench import everything
from conftest import PAINT_PICTURES, SIZE, SPLIT

from lagbench.data.manifest import build_manifest, read_manifest, write_manifest
from lagbench.data.registry import Registry
from lagbench.errors import DataError
from lagbench.make.generate import GenerationResult, generate

FOLDER = Path(SPLIT) / SIZE / "v2"
Gather = Callable[..., GenerationResult]


def part(
    generated: GenerationResult, root: Path, registry: Registry, ids: tuple[int, ...]
) -> Path:
    """Return a root that holds some scenarios only, as a job of an array leaves it."""
    size = registry.size(SPLIT, SIZE)
    whole = read_manifest(generated.root, SPLIT, SIZE, 2)
    assert whole is not None
    entries = [entry for entry in whole.files if entry.scenario in ids]
    for entry in entries:
        (root / FOLDER / entry.path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(generated.folder / entry.path, root / FOLDER / entry.path)
    names = {
        "split": SPLIT,
        "size": SIZE,
        "version": size.version,
        "subsets": size.subsets,
    }
    write_manifest(
        root, build_manifest(None, entries, **names, environment=whole.environments[0])
    )
    return root


@pytest.fixture
def parts(
    generated: GenerationResult, unmeasured: Registry, tmp_path: Path
) -> tuple[Path, Path]:
    """Two roots with scenarios 0-2 and 3-4."""
    first = (0, 1, 2)
    second = (3, 4)
    return (
        part(generated, tmp_path / "part-0", unmeasured, first),
        part(generated, tmp_path / "part-1", unmeasured, second),
    )


@pytest.fixture
def gather(tmp_path: Path, unmeasured: Registry) -> Gather:
    """Generate into a root, taking over what others hold."""
    options = {"root": tmp_path / "whole", "registry": unmeasured}
    return lambda *sources, **more: generate(
        SPLIT, SIZE, gather=sources, **(options | more)
    )


@pytest.mark.slow
def test_two_processes_and_a_last_call(
    tmp_path: Path,
    unmeasured_path: Path,
    unmeasured: Registry,
    copied: Callable[[], Path],
) -> None:
    """The recipe for job arrays: what two processes made is the one-machine data set,
    file for file.
    """
    alone = copied()
    manifest = read_manifest(alone, SPLIT, SIZE, 2)
    assert manifest is not None
    split = unmeasured.split(SPLIT)
    PAINT_PICTURES(alone, unmeasured.size(SPLIT, SIZE), split, manifest)

    def start(*options: str) -> subprocess.Popen[str]:
        command = [
            sys.executable,
            "-m",
            "lagbench",
            "generate",
            "--split",
            SPLIT,
            "--size",
            SIZE,
        ]
        there = {**os.environ, "LAGBENCH_REGISTRY": str(unmeasured_path)}
        return subprocess.Popen(
            [*command, *options], env=there, stdout=subprocess.PIPE, text=True
        )

    jobs = [
        start(
            "--scenarios", ids, "--root", str(tmp_path / f"part-{k}"), "--workers", "1"
        )
        for k, ids in enumerate(("0-2", "3,4"))
    ]
    assert [job.communicate()[0] and job.returncode for job in jobs] == [0, 0]
    sources = [str(tmp_path / f"part-{k}") for k in range(2)]
    last = start(
        "--gather",
        sources[0],
        "--gather",
        sources[1],
        "--root",
        str(tmp_path / "whole"),
    )
    output, _ = last.communicate()
    assert last.returncode == 0
    assert "nothing to simulate" in output
    assert everything(tmp_path / "whole" / FOLDER) == everything(alone / FOLDER)


def test_what_no_part_holds_is_simulated(
    parts: tuple[Path, Path],
    tmp_path: Path,
    gather: Gather,
    generated: GenerationResult,
) -> None:
    """A job that failed costs its scenarios only; files behind links are whole."""
    whole = tmp_path / "whole"
    linked = parts[1] / FOLDER / "test" / "0004.nc"
    linked.rename(parts[1] / "blob")
    linked.symlink_to(os.path.relpath(parts[1] / "blob", linked.parent))
    result = gather(parts[1], scenarios="1,3,4")
    assert result.simulated == (1,)
    assert result.kept == (3, 4)
    assert not (whole / FOLDER / "test" / "0004.nc").is_symlink()
    again = gather(*parts)
    assert again.simulated == ()
    assert again.dataset_sha256 == generated.dataset_sha256


def test_a_damaged_part_is_named(
    parts: tuple[Path, Path], tmp_path: Path, gather: Gather
) -> None:
    """A cut file, and one of another scenario under a false entry, are refused; nothing
    is taken.
    """
    path = parts[1] / FOLDER / "test" / "0004.nc"
    for harmful in (path.read_bytes()[:-2000], path.with_name("0003.nc").read_bytes()):
        path.write_bytes(harmful)
        with pytest.raises(DataError) as caught:
            gather(parts[1])
        assert caught.value.where.endswith("part-1/curl-noise/tiny/v2/test/0004.nc")
    assert not (tmp_path / "whole" / FOLDER / "test" / "0004.nc").exists()
