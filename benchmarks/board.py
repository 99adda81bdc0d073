"""Build a leaderboard of 50 made-up entries and say how long it takes and how large the page is.

    python benchmarks/board.py [--entries 50] [--output FOLDER] [--board leaderboard]

The entries are the committed floors of every `mini`, made better or worse: statistics are scaled per
scenario, films and maps get a random walk of their own, so that nothing of them compresses away
because two entries are alike. Every fifth has three seeds, some are superseded, withdrawn or
flagged, and their texts hold markup. The same call gives the same bytes. `lagbench leaderboard
check` passes on the result. Exit code 1 if the page has 2 MB or more, if the build takes 20 s of
processor time or more, or if a second build, in another order of files, gives other bytes.
"""

from __future__ import annotations

import argparse
import datetime
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from lagbench.board.build import build
from lagbench.board.check import check_board
from lagbench.board.entry import CostEntry, Entry, FlagEntry, PredictionEntry, ScoredFile, Status
from lagbench.board.entry_file import read_entry, spell_entry
from lagbench.board.folder import Folder, score_paths
from lagbench.board.scored import score_block
from lagbench.board.seeds import combine, summarise
from lagbench.board.stored import read_stored
from lagbench.cli.output import spell_bytes
from lagbench.data.checksums import file_sha256
from lagbench.floors import constant_velocity, persistence
from lagbench.scoring.scenario import SUBMISSION, as_stored
from lagbench.scoring.score_file import write_statistics

MOST_BYTES, MOST_SECONDS = 2_000_000, 20.0
SEEDS = 3
NAMES = ("Graph <b>network</b>", "Ünïcode & co.", "A model with a rather long name, as they have", "MLP")


def main() -> int:
    """Make the folder, build twice, print times and sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--entries", type=int, default=50)
    parser.add_argument("--output", type=Path, help="folder to make; a temporary one by default")
    parser.add_argument("--board", type=Path, default=Path(__file__).parent.parent / "leaderboard")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        return _measured(given.board, given.output or Path(scratch) / "board", given.entries)


def _measured(source: Path, target: Path, entries: int) -> int:
    make_board(source, target, entries)
    wall, cpu = time.perf_counter(), time.process_time()
    result = build(target)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    again = target.with_name(f"{target.name}-again")
    _copy_backwards(target, again)
    same = build(again).page.read_bytes() == result.page.read_bytes()
    shutil.rmtree(again)
    findings = check_board(target).findings
    for finding in findings:
        print(finding, file=sys.stderr)
    files = [path.stat().st_size for path in target.glob("scores/*/*/*.nc")]
    print(f"entries      {result.rows} on {result.tabs} tabs")
    print(f"score files  {len(files)}, at most {max(files)} bytes")
    print(f"page         {spell_bytes(result.bytes)} ({result.bytes} bytes; limit {MOST_BYTES})")
    print(f"build        {cpu:.1f} s of processor time, {wall:.1f} s (limit {MOST_SECONDS:.0f} s)")
    print(f"second build {'the same bytes' if same else 'OTHER BYTES'}")
    print(f"check        {len(findings)} findings")
    return 0 if same and not findings and result.bytes < MOST_BYTES and cpu < MOST_SECONDS else 1


def make_board(source: Path, target: Path, count: int) -> None:
    """Copy the floors of every mini and add made-up entries until there are so many.

    Args:
        source: a leaderboard's folder with both floors on every mini.
        target: folder to make.
        count: entries in all.
    """
    held = [read_entry(source / path) for path in Folder(source).entries()]
    floors = [entry for entry in held if entry.floor and entry.size == "mini"]
    for entry in floors:
        for path in (entry.yaml_path, *entry.score_paths):
            (target / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / path, target / path)
    bases = {entry.split: entry for entry in floors if entry.method == constant_velocity.FLOOR.name}
    splits = sorted(bases)
    for number in range(count - len(floors)):
        _make(bases[splits[number % len(splits)]], target, number)


def _make(base: Entry, target: Path, number: int) -> None:
    """Write a made-up entry and its score files."""
    rng = np.random.Generator(np.random.PCG64(number))
    place = (base.split, base.size, f"model-{number}")
    seeds: Sequence[int | None] = [None] if number % 5 else list(range(SEEDS))
    paths = [target / path for path in score_paths(place, seeds)]
    hashes = [f"{number * SEEDS + i:064x}" for i in range(len(seeds))]
    quality = 10.0 ** rng.uniform(-1.5, 0.3)
    for i, (path, sha256) in enumerate(zip(paths, hashes, strict=True)):
        near = quality * 10.0 ** rng.uniform(-0.05, 0.05)
        _write(target / base.score_paths[0], path, near, sha256, place[2], number * SEEDS + i)
    made = tuple(
        PredictionEntry(
            seed=seed, sha256=sha256, url=f"https://example.org/{sha256[-6:]}.nc", bytes=1_000_000
        )
        for seed, sha256 in zip(seeds, hashes, strict=True)
    )
    entry = _described(base, place, number, made, rng)
    scores = combine([read_stored(path).scores for path in paths])
    flags = (FlagEntry(name="physics", reasons=("made up",)),) if number % 7 == 0 else ()
    files = [
        ScoredFile(sha256=file_sha256(path), predictions_sha256=sha256, flags=flags)
        for path, sha256 in zip(paths, hashes, strict=True)
    ]
    block = score_block(
        place,
        base.dataset,
        made,
        files,
        summarise(scores),
        about=entry,
        ranking=base.score.ranking_metric,
        scored_by="nobody",
    )
    entry = entry.model_copy(update={"score": block})
    (target / entry.yaml_path).write_bytes(spell_entry(entry))


def _described(
    base: Entry,
    place: tuple[str, str, str],
    number: int,
    made: tuple[PredictionEntry, ...],
    rng: np.random.Generator,
) -> Entry:
    status = Status.WITHDRAWN if number % 11 == 10 else Status.ACTIVE
    superseded = number % 13 == 12
    return base.model_copy(
        update={
            "method": place[2],
            "name": f"{NAMES[number % len(NAMES)]} {number}",
            "authors": ("A. Author", "B. <script>alert(1)</script>", f"C. {number}"),
            "affiliation": "An institute",
            "code": f"https://example.org/{place[2]}",
            "date": datetime.date(2026, 1, 1) + datetime.timedelta(days=number),
            "notes": "Made up. " * (number % 9),
            "training": "a little noise",
            "parameters": int(10.0 ** rng.uniform(4, 8)),
            "hardware": "none",
            "command": f"python benchmarks/board.py  # number {number}",
            "cost": CostEntry(
                seconds_per_frame=float(f"{10.0 ** rng.uniform(-3, 0):.4g}"),
                device="a machine",
                solver_seconds_per_frame=0.05 if number % 3 else None,
            ),
            "status": Status.SUPERSEDED if superseded else status,
            "superseded_by": persistence.FLOOR.name if superseded else None,
            "reason": "made up" if superseded or status is Status.WITHDRAWN else "",
            "predictions": made,
        }
    )


def _write(base: Path, path: Path, quality: float, sha256: str, method: str, seed: int) -> None:
    """Write a score file with the errors of another one scaled, and a noise of its own in the pictures."""
    rng = np.random.Generator(np.random.PCG64(seed))
    held = read_stored(base)
    names = next(iter(held.scores.tallies.values())).names
    errors = np.array(
        [name.endswith(("_mse", "_mae")) or "_mse_" in name or "_mae_" in name for name in names]
    )
    tallies = {}
    for scenario, tally in held.scores.tallies.items():
        factor = quality * 10.0 ** rng.uniform(-0.1, 0.1, (1, len(tally.frames)))
        tallies[scenario] = as_stored(
            replace(tally, total=tally.total * np.where(errors[:, None], factor, 1.0))
        )
    preview = held.preview
    film, vorticity = preview.film.copy(), preview.vorticity.copy()
    film[1] += np.cumsum(rng.normal(0.0, 1e-3, film[1].shape), axis=0).astype(np.float32)
    vorticity[1] += rng.normal(0.0, 0.1 * np.nanstd(vorticity[0]), vorticity[1].shape).astype(np.float32)
    card: Any = SimpleNamespace(
        header=SimpleNamespace(**{**held.scores.identity, "method": method}),
        predictions_sha256=sha256,
        ranking=held.scores.ranking,
        scenarios=tuple(sorted(tallies)),
        tallies={SUBMISSION: tallies},
        preview=replace(preview, film=film, vorticity=vorticity),
    )
    write_statistics(card, path)


def _copy_backwards(source: Path, target: Path) -> None:
    """Copy entries and score files in descending order of their names."""
    for path in sorted((p for p in source.rglob("*.*") if p.suffix in (".yaml", ".nc")), reverse=True):
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)


if __name__ == "__main__":
    raise SystemExit(main())
