"""Generate a data set: simulate what is missing, crash-safe, resumable, on all cores.

A scenario's file appears whole or not at all, and the manifest is brought up to date
after each, so that an interrupted generation goes on where it stopped and ends with the
same bytes as an uninterrupted one.

The parent process plans, hands scenarios to workers and keeps the manifest; it never
simulates, so that Ctrl-C reaches it at once and a crash of the solver cannot take it
along.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from lagbench.atomic import remove_leftovers
from lagbench.data.checksums import round_digits
from lagbench.data.layout import MANIFEST_NAME, expand_path
from lagbench.data.local import locate_new
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    describe_file,
    merge_entries,
    read_or_empty,
    record_entry_hashes,
    write_manifest,
)
from lagbench.data.registry import Registry, Size, Split, format_ids
from lagbench.data.statistics import file_moments, statistics
from lagbench.errors import UsageError, check_installed, suggest_name
from lagbench.generators.batch import SimulationJob
from lagbench.generators.simulate import (
    Pace,
    Simulated,
    simulate,
    twin_floors,
    twin_substeps,
)
from lagbench.generators.solver import Device
from lagbench.store.copy import gather, list_gatherable
from lagbench.store.publication import (
    Publication,
    check_address,
    inspect_store,
    publish,
)
from lagbench.work.cluster import Cluster, await_file
from lagbench.work.machine import describe_machine, promises_bits
from lagbench.work.pool import Pool, Report, WorkItem, worker_count
from lagbench.work.progress import Meter, Progress
from lagbench.work.run import ONE_THREAD, read_many

from .cards import card_texts, write_cards
from .inventory import compare, examine, look
from .plan import (
    Estimate,
    Scenarios,
    Selection,
    check_disk,
    estimate,
    free_bytes,
    note_pace,
    select,
)

Job = TypeVar("Job")
Result = TypeVar("Result")

# particles that a parallel device advances together at the most
BATCH_PARTICLES = 1 << 19


class Generation:
    """Brings a data set folder to the state that its size describes."""

    def __init__(
        self,
        size: Size,
        root: Path,
        device: Device,
        workers: int,
        meter: Meter,
        *,
        split: Split,
        scheduler: str | None = None,
        sources: Sequence[Path] = (),
    ) -> None:
        self.size = size
        self.root = root
        self.device = device
        self.folder = size.folder(root)
        self.workers = workers
        self.scheduler = scheduler  # processes here, or a Dask scheduler's workers
        self.sources = sources  # other root folders to take finished scenarios from
        # which the root folder is a working copy of; None if plain
        self.store: Publication | None = None
        # what the folder holds, as far as is known
        self.manifest = merge_entries(self.size, None)
        # files that were there and right, just hashed
        self._hashed: list[FileEntry] = []
        self.kept: list[int] = []  # ids whose files were there and right
        self.to_do: Estimate = estimate(size, ())  # ids to simulate and what that takes
        self.verdict = ""  # how the hashes compare with datasets.yaml, in words
        self._meter = meter  # counts the work
        self._split = split  # the split that the size belongs to
        self._promised: list[int] = []
        self._paces: list[Pace] = []  # how fast scenarios were simulated here

    def survey(
        self,
        wanted: Sequence[int],
        *,
        force: bool = False,
        gathered: Collection[int] | None = None,
    ) -> None:
        """Find out what is there and what is to do; with ``gathered``, what would be
        there, it only tells.
        """
        old = read_or_empty(self.size, self.root)
        if self.store:
            held = self.store.stored_entries
        else:
            held = {}
        local = [i for i in self.size.scenarios if i not in held]
        # A file that came, went, or has another length than the manifest says is looked
        # at too.
        lengths = {
            i: path.stat().st_size for i in local if (path := self._path(i)).exists()
        }
        stated = {entry.scenario: entry.bytes for entry in old.files}
        suspects = [i for i in local if i in wanted or lengths.get(i) != stated.get(i)]
        self._meter.begin("checking", total=len(suspects), scenarios=len(suspects))
        quick = partial(
            examine, self.root, self.size, quick=True, trusting=gathered is not None
        )
        looks = {
            f"scenario {i}": partial(quick, i, manifest=old.only(i)) for i in suspects
        }
        findings = self._read(look, looks, map(self._path, suspects))
        self._hashed = [finding.entry for finding in findings if finding.entry]
        bad = set(suspects) - {entry.scenario for entry in self._hashed}
        kept = tuple(e for e in old.files if e.scenario not in bad)
        there = [*self._hashed, *held.values()]
        self.manifest = merge_entries(
            self.size, old.model_copy(update={"files": kept}), there
        )
        self.kept = [
            i for i in wanted if (i not in bad or i in (gathered or ())) and not force
        ]
        on_cores = self.device is Device.CPU and self.scheduler is None
        self.to_do = estimate(
            self.size, [i for i in wanted if i not in self.kept], on_cores=on_cores
        )

    def run(self, wanted: Sequence[int], *, force: bool = False) -> None:
        """Simulate what is missing or wrong; write the manifest, compare, write
        cards.
        """
        remove_leftovers(self.folder)
        for source in self.sources:
            self._keep(
                gather(
                    self.size, self.root, source, read_or_empty(self.size, self.root)
                )
            )
        self.survey(wanted, force=force)
        record_entry_hashes(self.folder, self._hashed)
        check_disk(self.root, self.to_do.bytes)
        self._keep(self.manifest)
        try:
            self._simulate()
        finally:
            # The workers are gone by now; what they had not finished goes too.
            remove_leftovers(self.folder)
        note_pace(self.size, self._paces)
        manifest = self.manifest
        train = self.size.subsets["train"]
        measured = self.size.measured
        # Statistics of other bits differ from datasets.yaml by right.
        doubted = (
            measured
            and manifest.identity == "bitwise"
            and manifest.statistics != measured.statistics
        )
        if "train" in manifest.subset_sha256 and (doubted or not manifest.statistics):
            self._bring(train)
            self._meter.begin("statistics", total=len(train), scenarios=len(train))
            paths = {f"scenario {i}": self._path(i) for i in train}
            moments = self._read(file_moments, paths, paths.values())
            manifest = manifest.model_copy(update={"statistics": statistics(moments)})
        self._keep(manifest)
        self.verdict = compare(self.size, self.manifest, promised=self._promised)
        self._meter.begin("cards", total=1, scenarios=len(self.manifest.files))
        described = self.size, self._split, self.manifest
        if self.store and self.store.is_settled(self.manifest, card_texts(*described)):
            return
        self._bring(self.size.scenarios)
        cards = write_cards(self.root, *described)
        if self.store:
            self.store.finish(self.manifest, cards)

    def _read(
        self,
        function: Callable[[Job, Report], Result],
        jobs: Mapping[str, Job],
        files: Iterable[Path],
    ) -> list[Result]:
        """Run a function that reads files, here or by the workers; the meter counts
        files.
        """

        def count(done: int) -> None:
            self._meter.count(done, scenarios=done)

        return read_many(
            function, jobs, files, count, workers=self.workers, scheduler=self.scheduler
        )

    def _path(self, scenario: int) -> Path:
        return self.size.path(self.root, scenario)

    def _simulate(self) -> None:
        """Run everything that is to do in workers, and the twins of test scenarios."""
        with_twin = {
            entry.scenario for entry in self.manifest.files if entry.twin_floor
        }
        tested = self.size.subsets.get("test", ())
        twins = [i for i in self.kept if i in tested and i not in with_twin]
        self._bring(twins)
        costs = dict(zip(self.to_do.scenarios, self.to_do.substeps, strict=True))
        # Scenarios of similar length share a batch.
        longest_first = sorted(costs, key=lambda i: (-costs[i], i))
        if self.device is Device.CPU:
            width = 1
        else:
            width = max(1, BATCH_PARTICLES // self.size.particles)
        batches = [
            tuple(longest_first[k : k + width])
            for k in range(0, len(longest_first), width)
        ]
        tasks = [
            self._task(
                f"scenario {format_ids(ids)}", simulate, ids, sum(costs[i] for i in ids)
            )
            for ids in batches
        ]
        tasks += map(self._twin, twins)
        if not tasks:
            return
        total = round(sum(task.cost for task in tasks))
        total += sum(
            twin_substeps(self.size, i) for i in self.to_do.scenarios if i in tested
        )
        self._meter.begin(
            "simulating", total=total, scenarios=len(self.to_do.scenarios)
        )
        if self.device is Device.CPU:
            environment = ONE_THREAD
        else:
            environment = {}
        here = Pool(min(self.workers, len(tasks)), environment)
        with (
            here
            if self.scheduler is None
            else Cluster(self.scheduler, folder=self.folder) as team
        ):
            for task in tasks:
                team.submit(task)
            for event in team.events():
                if event.kind != "done":  # it went on, or is lost
                    self._meter.count(
                        event.value if event.kind == "progress" else -event.value
                    )
                elif event.item.function is simulate:
                    self._take(
                        event.value,
                        team,
                        event.machine or describe_machine(self.device),
                    )
                else:
                    floors = {
                        i: tuple(map(round_digits, floor))
                        for i, floor in event.value.items()
                    }
                    files = [
                        entry
                        for entry in self.manifest.files
                        if entry.scenario in floors
                    ]
                    files = [
                        e.model_copy(update={"twin_floor": floors[e.scenario]})
                        for e in files
                    ]
                    self._keep(merge_entries(self.size, self.manifest, files))

    def _task(
        self,
        what: str,
        function: Callable[..., Any],
        scenarios: tuple[int, ...],
        cost: float,
    ) -> WorkItem:
        job = SimulationJob(
            size=self.size, scenarios=scenarios, root=self.root, device=self.device
        )
        name = f"{self.size.split} {self.size.name}, {what}"
        return WorkItem(name=name, function=function, arguments=(job,), cost=cost)

    def _twin(self, scenario: int) -> WorkItem:
        what = f"twin of scenario {scenario}"
        cost = twin_substeps(self.size, scenario)
        return self._task(what, twin_floors, (scenario,), cost)

    def _take(
        self,
        outcomes: Sequence[Simulated],
        team: Pool | Cluster,
        machine: Mapping[str, str],
    ) -> None:
        """Note simulated scenarios whose files are there, and send the twins of those
        of test after them.
        """
        environment = {**machine, "device": self.device.value}
        if promises_bits(environment):
            self._promised += [outcome.scenario for outcome in outcomes]
        if self.device is Device.CPU and self.scheduler is None:
            self._paces += [outcome.pace for outcome in outcomes if outcome.pace]
        for outcome in outcomes:
            await_file(self._path(outcome.scenario))
        entries = [
            describe_file(self.root, self.size.key(outcome.scenario))
            for outcome in outcomes
        ]
        record_entry_hashes(self.folder, entries)
        self._keep(merge_entries(self.size, self.manifest, entries, environment))
        self._meter.count(scenarios=len(entries))
        for entry in entries:
            if entry.subset == "test":
                team.submit(self._twin(entry.scenario))

    def _keep(self, manifest: Manifest) -> None:
        self.manifest = manifest
        if manifest.files or (self.folder / MANIFEST_NAME).exists():
            write_manifest(self.root, manifest)
            if self.store:
                self.store.put_files(manifest)

    def _bring(self, scenarios: Iterable[int]) -> None:
        """Have files of scenarios here that only the store holds."""
        if self.store:
            self.store.fetch(scenarios)


@dataclass(frozen=True, kw_only=True)
class GenerationResult:
    """What a generation did, or would do."""

    split: str  # name of the split
    size: str  # name of the size
    version: str  # semantic version
    root: Path  # folder of all data sets
    folder: Path  # folder of this one
    device: str  # where the solver ran
    workers: int  # worker processes
    simulated: tuple[int, ...]  # ids that were (dry run: would be) simulated
    # ids whose files were there and right (dry run: or would be gathered)
    kept: tuple[int, ...]
    missing: tuple[int, ...]  # ids of the size that are still not there
    bytes_needed: int  # disk space of 'simulated' before compression [bytes]
    bytes_free: int  # free disk space before the start [bytes]
    seconds_expected: float  # expected time [s], for reference_seconds
    measured: bool  # whether it is expected at a rate that this machine has measured
    seconds: float = 0.0  # time that it took [s]
    complete: bool = False  # whether train, valid and test are all there
    dataset_sha256: str | None = None  # data set hash, once complete
    verdict: str = ""  # how the hashes compare with datasets.yaml, in words
    dry_run: bool = False  # whether nothing was done


def generate(
    split: str | Path,
    size: str | None = None,
    *,
    subset: Selection = None,
    scenarios: Scenarios = None,
    root: str | Path | None = None,
    workers: int | None = None,
    device: str = "cpu",
    scheduler: str | None = None,
    gather: Sequence[str | Path] = (),
    force: bool = False,
    dry_run: bool = False,
    progress: Callable[[Progress], None] | None = None,
    on_wait: Callable[[str], None] | None = None,
    registry: Registry | None = None,
) -> GenerationResult:
    """Simulate the scenarios of a split that are not on disk yet, and check their
    hashes.

    Args:
        split: name of the split.
        size: name of the size; mini when None, or the only one that the split has.
        subset: some subsets only.
        scenarios: some ids only, as numbers or as text such as "0,3-5".
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder. With a URL (``s3://bucket/prefix``) files are written to its working
            copy and put into the store, see docs/scaling.md.
        workers: worker processes; one per core, or one for the parallel devices.
        device: "cpu", "parallel" or "cuda"; the bits do not depend on it.
        scheduler: address of a Dask scheduler whose workers simulate instead; they must
            see the root folder under the same path.
        gather: other root folders, from which finished scenarios are taken first.
        force: simulate anew what is there and right.
        dry_run: only say what it would take.
        progress: called as the work advances.
        on_wait: called with the holder in words when another process holds the lock.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset, scenario or device, fewer than one
            worker, or Taichi is not installed; or nothing can be gathered from a
            folder.
        WorkFailedError: disk full or not writable, a scenario blew up, workers keep
            dying, the cluster is lost or does not see the root folder; or the store
            refuses or does not answer.
        DataError: the result has other hashes than datasets.yaml, or there is no such
            bucket.
    """
    started = time.monotonic()
    check_address(root)
    tier, folder, splits = locate_new(split, size, root=root, registry=registry)
    wanted = select(tier, subset=subset, scenarios=scenarios)
    devices = [known.value for known in Device]
    if device not in devices:
        raise UsageError(
            f"no device {device!r}", where="--device", fix=suggest_name(device, devices)
        )
    target = Device(device)
    cores = worker_count(workers, default=None if target.value == "cpu" else 1)
    free = free_bytes(tier.folder(folder))
    generation = Generation(
        tier,
        folder,
        target,
        cores,
        Meter(progress),
        split=splits.split(tier.split),
        scheduler=scheduler,
        sources=[expand_path(source, "--gather") for source in gather],
    )
    if dry_run:
        generation.store = inspect_store(tier, folder)
        there = {
            i
            for source in generation.sources
            for i in list_gatherable(tier, folder, source)
        }
        generation.survey(wanted, force=force, gathered=there)
    else:
        if scheduler is None:
            check_installed("taichi", extra="generate")
        with (
            dataset_lock(folder, tier.split, tier.name, tier.major, on_wait=on_wait),
            publish(tier, folder) as generation.store,
        ):
            generation.run(wanted, force=force)
    manifest = generation.manifest
    return GenerationResult(
        split=tier.split,
        size=tier.name,
        version=tier.version,
        root=folder,
        folder=generation.folder,
        device=target.value,
        workers=cores,
        simulated=generation.to_do.scenarios,
        kept=tuple(generation.kept),
        missing=tuple(
            i
            for i in tier.scenarios
            if not manifest.entry(i) and i not in generation.kept
        ),
        bytes_needed=generation.to_do.bytes,
        bytes_free=free,
        seconds_expected=generation.to_do.seconds(cores),
        measured=generation.to_do.measured,
        seconds=time.monotonic() - started,
        complete=manifest.complete,
        dataset_sha256=manifest.dataset_sha256,
        verdict=generation.verdict,
        dry_run=dry_run,
    )
