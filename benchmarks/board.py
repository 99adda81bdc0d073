"""Build a leaderboard of made-up entries, 50 by default, and say how long it takes and
how large the page is.

    python benchmarks/board.py [--entries 50] [--tabs N] [--output FOLDER]

Entries stand on every split's `mini`, or on that of the first N splits: errors grow
over the frames by a law of their own, films and maps are noise, so that nothing
compresses away because two entries are alike. Every fifth has three seeds, some are
superseded, withdrawn or flagged, and their texts hold markup. The same call gives the
same bytes. Exit code 1 if `lagbench leaderboard check` finds anything, a page built
again with other bytes included, if the page of 150 entries has more than 2 MB, or if
`build`, `show` or `check` takes more than 500 MB of memory or too much time: 10 s with
150 entries and 60 s with 1,000, three times as much for `check`, which forms all scores
of all entries again. It is the time that a user waits, so leave the machine idle. The
processor time stands beside it, with that of child processes. The memory is that of the
largest process.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lagbench.board.build import build
from lagbench.board.check import check_board
from lagbench.board.entry import (
    DataSet,
    Entry,
    EntryBudget,
    EntryCost,
    EntryFlag,
    Prediction,
    ScoreBlock,
    ScoredFile,
    Status,
)
from lagbench.board.entry_file import entry_bytes
from lagbench.board.folder import Folder, score_paths
from lagbench.board.ranking import combine, summarise, write_references
from lagbench.cli.output import format_bytes
from lagbench.data.checksums import file_sha256
from lagbench.data.grid import Grid, Placement
from lagbench.data.registry import Size, load
from lagbench.metrics import METRICS, Direction, Tally, TaskConfig, aggregate
from lagbench.metrics.aggregate import round_statistics
from lagbench.metrics.distributions import BINS
from lagbench.metrics.table import ranking_metric
from lagbench.references.table import NAIVE, REFERENCES
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import FRAMES, PARTICLES, SUBMISSION, Preview
from lagbench.scoring.score_file_checks import read_score_file, reported_frames
from lagbench.scoring.score_file_writer import write_statistics
from lagbench.scoring.skill import compute_skill
from lagbench.submission import Header
from lagbench.submission.task_checks import frames_to_predict

MOST_BYTES = 2_000_000
MOST_ENTRIES_OF_A_PAGE = 150  # more may make a longer page
MOST_MEMORY = 500_000_000  # of a command [bytes]
# time of a command [s], up to that many entries and beyond
MOST_SECONDS = 10.0
MOST_SECONDS_BEYOND = 60.0
MOST_TIMES_AS_LONG = {"build": 1.0, "show": 1.0, "check": 3.0}

# The greatest memory that the system counts for children contains that of this process
# before the child's program began, so the child states its own.
COMMAND_WITH_MEMORY = """
import re, resource, runpy, sys
from pathlib import Path

try:
    runpy.run_module("lagbench", run_name="__main__", alter_sys=True)
finally:
    status = Path("/proc/self/status").read_text()
    own = int(re.search(r"Vm(?:HWM|RSS):\\s+(\\d+) kB", status)[1])
    of_workers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    print(max(own, of_workers), file=sys.stderr)
"""
SEEDS = 3
FIRST_DATE = datetime.date(2026, 1, 1)
SIZE = "mini"
NAMES = (
    "Graph <b>network</b>",
    "Ünïcode & co.",
    "A model with a rather long name, as they have",
    "MLP",
)


def main() -> int:
    """Make the folder, build and check, print times and sizes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--entries", type=int, default=50)
    parser.add_argument("--tabs", type=int, help="number of data sets; all by default")
    parser.add_argument(
        "--output", type=Path, help="folder to make; a temporary one by default"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        target = options.output or Path(scratch) / "board"
        return _measure(target, options.entries, options.tabs)


def _measure(target: Path, entries: int, tabs: int | None) -> int:
    registry = load()
    splits = []
    for name, split in registry.splits.items():
        if SIZE in split.sizes:
            splits.append(name)
    splits = splits[:tabs]
    for number in range(entries):
        split_number = number % len(splits)
        size = registry.size(splits[split_number], SIZE)
        make_entry(size, target, number, first=split_number)

    times = {}
    memory = {}  # [bytes]
    for command in MOST_TIMES_AS_LONG:
        cpu, wall, peak = _measure_command(command, target)
        times[command] = (cpu, wall)
        memory[command] = peak
    result = build(target)
    findings = check_board(target, page=True).findings
    for finding in findings:
        print(finding, file=sys.stderr)
    file_sizes = []  # [bytes]
    for path in target.glob("scores/*/*/*.nc"):
        file_sizes.append(path.stat().st_size)
    print(f"entries      {result.rows} on {result.tabs} tabs")
    print(f"score files  {len(file_sizes)}, at most {max(file_sizes)} bytes")
    print(
        f"page         {format_bytes(result.bytes)} ({result.bytes} bytes; limit "
        f"{MOST_BYTES})"
    )
    is_beyond = result.rows > MOST_ENTRIES_OF_A_PAGE
    most_seconds = MOST_SECONDS
    if is_beyond:
        most_seconds = MOST_SECONDS_BEYOND
    is_fast = True
    for command, (cpu, wall) in times.items():
        limit = MOST_TIMES_AS_LONG[command] * most_seconds
        if wall > limit:
            is_fast = False
        print(
            f"{command:12s} {wall:.1f} s (limit {limit:.0f} s), {cpu:.1f} s of "
            f"processor time, {format_bytes(memory[command])}"
        )
    print(f"memory       limit {format_bytes(MOST_MEMORY)}")
    print(f"findings     {len(findings)}")
    is_short = result.bytes <= MOST_BYTES or is_beyond
    is_small = max(memory.values()) <= MOST_MEMORY
    if not findings and is_short and is_fast and is_small:
        return 0
    return 1


def _measure_command(command: str, target: Path) -> tuple[float, float, int]:
    """Return processor time [s], time [s] and greatest memory [bytes] of a command of
    the group leaderboard.
    """
    words = [sys.executable, "-c", COMMAND_WITH_MEMORY, "leaderboard", command]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall_start = time.perf_counter()
    done = subprocess.run(
        [*words, "--board", str(target)],
        check=command != "check",  # a check that finds something ends with 1
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    wall = time.perf_counter() - wall_start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime - before.ru_utime
    last_word = done.stderr.split()[-1]
    memory = 1000 * int(last_word)
    return cpu, wall, memory


def make_entry(size: Size, target: Path, number: int, *, first: int) -> None:
    """Write a made-up entry, its score files and the references beside it.

    Args:
        size: its data set.
        target: the leaderboard's folder.
        number: the entry.
        first: number of the first entry on that data set, which supersedes others.
    """
    rng = np.random.Generator(np.random.PCG64(number))
    method = f"model-{number}"
    seeds: list[int | None] = [None]
    if number % 5 == 0:
        seeds = list(range(SEEDS))

    cards = []
    for i in range(len(seeds)):
        quality = 10.0 ** rng.uniform(-1.5, 0.3)
        card_seed = number * SEEDS + i
        card = make_card(size, method, card_seed, quality)
        cards.append(card)
    predictions = []
    for seed, card in zip(seeds, cards, strict=True):
        prediction = Prediction(
            seed=seed,
            sha256=card.predictions_sha256,
            url="https://example.org/x.nc",
            bytes=1_000_000,
        )
        predictions.append(prediction)
    place = (size.split, size.name, method)
    paths = []
    for inner_path in score_paths(place, seeds):
        paths.append(target / inner_path)
    score = write_scores(cards, paths, number)
    if number == first:
        write_references(cards[0], Folder(target))

    status, successor, reason = make_status(number, first=first)
    header = cards[0].header
    dataset = DataSet(
        version=header.dataset_version,
        sha256=header.dataset_sha256,
    )
    age = datetime.timedelta(days=number % 300)
    magnitude = rng.uniform(4, 8)
    cost = make_cost(rng, number)
    entry = Entry(
        format=2,
        split=size.split,
        size=size.name,
        method=method,
        name=f"{NAMES[number % len(NAMES)]} {number}",
        authors=("A. Author", "B. <script>alert(1)</script>", f"C. {number}"),
        affiliation="An institute",
        code=f"https://example.org/{method}",
        date=FIRST_DATE + age,
        notes="Made up. " * (number % 9),
        training="a little noise",
        budget=EntryBudget(windows=1000 * number, cpu_hours=0.25),
        parameters=int(10.0**magnitude),
        hardware="none",
        command=f"python benchmarks/board.py  # number {number}",
        cost=cost,
        status=status,
        superseded_by=successor,
        reason=reason,
        dataset=dataset,
        predictions=tuple(predictions),
        score=score,
    )
    path = target / entry.yaml_path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(entry_bytes(entry))


def write_scores(
    cards: Sequence[ScoreCard],
    paths: Sequence[Path],
    number: int,
) -> ScoreBlock:
    """Write the score files of a made-up entry; return what the entry says of them."""
    flags: tuple[EntryFlag, ...] = ()
    if number % 7 == 0:
        flag = EntryFlag(name="physics", reasons=("made up",))
        flags = (flag,)
    files = []
    tallies = []
    for card, path in zip(cards, paths, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_statistics(card, path)
        score_file = read_score_file(path)
        tallies.append(score_file.scores.tallies)
        scored_file = ScoredFile(
            sha256=file_sha256(path),
            predictions_sha256=card.predictions_sha256,
            flags=flags,
        )
        files.append(scored_file)
    return ScoreBlock(
        lagbench="0.0.0",
        dataset_sha256=cards[0].header.dataset_sha256,
        ranking_metric=cards[0].ranking,
        files=tuple(files),
        metrics=summarise(combine(tallies)),
    )


def make_status(number: int, *, first: int) -> tuple[Status, str | None, str]:
    """Return the status of a made-up entry, its successor and the reason.

    Most entries are active, some superseded by the first one, some withdrawn.
    """
    if number % 13 == 12:
        return Status.SUPERSEDED, f"model-{first}", "made up"
    if number % 11 == 10:
        return Status.WITHDRAWN, None, "made up"
    return Status.ACTIVE, None, ""


def make_cost(rng: np.random.Generator, number: int) -> EntryCost:
    """Return the cost of a made-up entry; a third have no time of the solver."""
    solver_seconds = None
    if number % 3:
        solver_seconds = 0.05
    seconds = 10.0 ** rng.uniform(-3, 0)
    return EntryCost(
        seconds_per_frame=float(f"{seconds:.4g}"),
        device="a machine",
        solver_seconds_per_frame=solver_seconds,
    )


def make_card(size: Size, method: str, seed: int, quality: float) -> ScoreCard:
    """Return a score card without predictions: errors grow, pictures are noise."""
    rng = np.random.Generator(np.random.PCG64(seed))
    qualities = {SUBMISSION: quality}
    for i, name in enumerate(REFERENCES):
        qualities[name] = 3.0 + i

    task = size.task
    frames = tuple(frames_to_predict(size))
    ranking = ranking_metric(size)
    ranking_metrics = [METRICS[ranking]]
    tallies = {}
    scores = {}
    for row, row_quality in qualities.items():
        if row == SUBMISSION:
            tallies[row] = _tallies(size, row_quality)
        else:
            tallies[row] = _reference_tallies(size.split, row_quality)
        scores[row] = aggregate(ranking_metrics, tallies[row])

    sha256 = "0" * 64
    if size.measured:
        sha256 = size.measured.dataset_sha256
    header = Header(
        split=size.split,
        size=size.name,
        dataset_version=size.version,
        dataset_sha256=sha256,
        method=method,
        scenarios=size.subsets["test"],
        frames=frames,
        particles=size.particles,
        seconds_per_frame=None,
        device=None,
        seed=None,
        parameters=None,
        training=None,
        diverged_at={},
    )
    placement = Placement(task.score_grid.placement)
    grid = Grid(task.score_grid.cells, placement)
    own_score = scores[SUBMISSION][ranking]
    naive_scores = {}
    for row, row_scores in scores.items():
        if row in NAIVE:
            naive_scores[row] = row_scores[ranking]
    return ScoreCard(
        header=header,
        predictions_sha256=f"{seed:064x}",
        config=TaskConfig(
            grid=grid,
            input_frames=task.input_frames,
            horizon=task.horizon,
            frames_of_interest=task.frames_of_interest,
            attribute_std=(1.0, 1.0, 1.0, 1.0),
            radius=task.radius,
            materials=(),
        ),
        ranking=ranking,
        tallies=tallies,
        scores=scores,
        against_classical=None,
        skill=compute_skill([own_score], naive_scores),
        flags=(),
        warnings=(),
        preview=_preview(size, rng),
    )


@functools.cache
def _reference_tallies(split: str, quality: float) -> dict[int, Tally]:
    """Return statistics of a reference predictor, which are those of every entry."""
    size = load().size(split, SIZE)
    return _tallies(size, quality)


def _tallies(size: Size, quality: float) -> dict[int, Tally]:
    """Return statistics by scenario."""
    frames = tuple(frames_to_predict(size))
    millionths = int(1e6 * quality)
    tallies = {}
    for scenario in size.subsets["test"]:
        bits = np.random.PCG64([scenario, millionths])
        rng = np.random.Generator(bits)
        tallies[scenario] = _tally(frames, quality, rng)
    return tallies


def _tally(frames: tuple[int, ...], quality: float, rng: np.random.Generator) -> Tally:
    """Return statistics that grow with the frames; correlations fall."""
    names = []
    is_falling = []
    for metric in METRICS.values():
        if metric.statistic is not None and metric.extra is None:
            names.append(metric.name)
            is_falling.append(metric.direction is Direction.HIGHER)

    frame_count = len(frames)
    share = np.linspace(0.01, 1.0, frame_count)  # of the error at the last frame
    shape = (len(names), frame_count)
    decades = rng.uniform(-0.1, 0.1, shape)
    scatter = 10.0**decades
    total = 1e-3 * quality * scatter * share
    error = quality * share
    total[is_falling] = 1.0 / (1.0 + error)
    weight = np.ones(total.shape, np.int64)
    undefined = np.zeros(total.shape, np.int64)
    tally = Tally(tuple(names), frames, total, weight, undefined)
    return round_statistics(tally)


def _preview(size: Size, rng: np.random.Generator) -> Preview:
    """Return a made-up preview: maps, histograms and a film of truth and prediction.

    Side 0 is the truth, side 1 the prediction. The maps and the film of the prediction
    are those of the truth with noise. The histograms of both sides are independent.
    """
    frames = tuple(frames_to_predict(size))
    maps = reported_frames(size)
    map_count = len(maps)
    truth = np.random.Generator(np.random.PCG64(size.particles))
    map_shape = size.field_grid.section.shape
    true_maps = truth.normal(size=(1, map_count, *map_shape))
    true_vorticity = 0.1 * true_maps
    vorticity = np.repeat(true_vorticity, 2, axis=0)
    map_noise = rng.normal(size=vorticity[1].shape)
    vorticity[1] += 0.02 * map_noise

    frame_count = min(FRAMES, len(frames))
    last = len(frames) - 1
    even_places = np.linspace(0, last, frame_count)
    film_frames = [frames[i] for i in even_places.astype(int)]
    # shape [side, frame, particle, axis]
    true_position = truth.random((1, 1, PARTICLES, size.dimension))
    both_sides = np.ones((2, frame_count, 1, 1))
    film = true_position * both_sides
    predicted_film = film[1]
    steps = rng.normal(0.0, 1e-3, predicted_film.shape)
    predicted_film += np.cumsum(steps, axis=0)
    film = np.clip(film, -0.5, 1.5)

    shares = rng.random((2, map_count, BINS))
    share_sums = shares.sum(axis=-1, keepdims=True)
    histogram = shares / share_sums
    map_range = [-0.3, 0.3]
    ranges = [map_range] * map_count
    return Preview(
        scenario=min(size.subsets["test"]),
        map_frames=maps,
        vorticity=vorticity.astype(np.float32),
        histogram=histogram.astype(np.float32),
        histogram_range=np.array(ranges, np.float32),
        film_frames=tuple(film_frames),
        particles=tuple(range(PARTICLES)),
        material=np.zeros(PARTICLES, np.int8),
        film=film.astype(np.float32),
    )


if __name__ == "__main__":
    raise SystemExit(main())
