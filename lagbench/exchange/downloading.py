"""Download a data set from the first store that has it, and simulate what none has."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.layout import MANIFEST_NAME, scenario_path
from lagbench.data.local import locate_new
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    MANIFEST_LIMIT,
    FileEntry,
    Manifest,
    describe_file,
    merge_entries,
    read_manifest,
    read_or_empty,
    record_entry_hashes,
    write_manifest,
)
from lagbench.data.registry import Registry, Size, format_ids
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.make.cards import write_cards
from lagbench.make.generate import generate
from lagbench.make.inventory import (
    DataSetState,
    compare_hashes,
    inspect_scenario,
)
from lagbench.make.plan import Scenarios, Selection, check_disk, select
from lagbench.store.archive import (
    RELEASES,
    RELEASES_VARIABLE,
    fetch_archive,
    list_releases,
)
from lagbench.store.copy import object_address, parse_manifest, refuse_foreign_hashes
from lagbench.store.fetch import CONNECTIONS, FetchRequest, fetch_scenarios, fetch_text
from lagbench.store.objects import NotInStoreError, StoreUnreachableError
from lagbench.store.publication import publish
from lagbench.work.progress import Meter, Progress

REMEDY = "try again; if it stays so, name another store: --from"
# why something could not be downloaded
Reason = DataError | WorkFailedError | UsageError


@dataclass(frozen=True, kw_only=True)
class DownloadResult:
    """What a download did."""

    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the data set
    # store that files came from; None where none was needed or reached
    mirror: str | None
    downloaded: tuple[int, ...]  # ids that were downloaded
    kept: tuple[int, ...]  # ids whose files were there and right
    generated: tuple[int, ...]  # ids that were simulated instead
    bytes: int  # bytes that came from stores
    seconds: float  # time that it took [s]
    complete: bool  # whether train, valid and test are all there
    dataset_sha256: str | None  # data set hash, once complete
    verdict: str  # how the hashes compare with datasets.yaml, in words


def download(
    split: str | Path,
    size: str | None = None,
    *,
    mirror: str | None = None,
    subset: Selection = None,
    scenarios: Scenarios = None,
    root: str | Path | None = None,
    connections: int = CONNECTIONS,
    or_generate: bool = True,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    announce: Callable[[str], None] | None = None,
    on_wait: Callable[[str], None] | None = None,
    registry: Registry | None = None,
) -> DownloadResult:
    """Fetch the scenarios of a split that are not on disk yet; simulate those no store
    has.

    Every file has a temporary name until its content hash is that of datasets.yaml.
    What was fetched before an interruption is not fetched again.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; mini when None, or the only one that the split has.
        mirror: URL of a copy of a root folder, or of a folder of archives, see
            :mod:`lagbench.store.archive`; else the mirrors of datasets.yaml in order,
            then releases.
        subset: some subsets only.
        scenarios: some ids only.
        root: folder of all data sets, see :func:`lagbench.data.local.resolve_root`.
        connections: files that are fetched side by side.
        or_generate: whether to simulate what no store has, or when none answers.
        workers: worker processes of the simulation.
        progress: called as the work advances.
        announce: told in a sentence when the simulation takes over, and why.
        on_wait: called with the holder in words when another process holds the lock.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset or scenario, or no store is known and
            nothing may be simulated.
        DataError: the store sent what is no data or has another length or content, see
            :mod:`lagbench.store.objects`; the file is gone, all that were right stay.
        WorkFailedError: the connection kept breaking, the disk is full, no store
            answers or is fast enough and nothing may be simulated.
    """
    started = time.monotonic()
    if connections < 1:
        raise UsageError(
            "no file comes without a connection", where="--connections", expected=">= 1"
        )
    tier, folder, splits = locate_new(split, size, root=root, registry=registry)
    wanted = select(tier, subset=subset, scenarios=scenarios)
    urls = (
        (mirror,)
        if mirror
        else (*splits.split(tier.split).mirrors, *list_releases(tier))
    )
    with (
        dataset_lock(folder, tier.split, tier.name, tier.major, on_wait=on_wait),
        publish(tier, folder) as store,
    ):
        held = [i for i in wanted if store and i in store.stored_entries]
        work = _Download(
            tier,
            folder,
            [i for i in wanted if i not in held],
            Meter(progress),
            connections,
        )
        try:
            reason = work.run(urls)
        finally:
            manifest = work.record()
            if store:
                store.put_files(manifest, at_once=True)
        if not work.missing:
            verdict = compare_hashes(tier, manifest)
            if work.downloaded and tier.simulated:
                if store:
                    store.fetch(held)
                cards = write_cards(folder, tier, splits.split(tier.split), manifest)
                if store:
                    store.finish(manifest, cards)
    if work.missing:
        if not or_generate:
            raise reason
        if announce is not None:
            if reason.where:
                place = f" ({reason.where})"
            else:
                place = ""
            announce(
                f"{reason.what}{place}: simulating scenarios {format_ids(work.missing)}"
            )
        rest = generate(
            tier.split,
            tier.name,
            scenarios=work.missing,
            root=folder,
            workers=workers,
            progress=progress,
            registry=splits,
        )
        verdict = rest.verdict
        manifest = read_manifest(folder, tier.split, tier.name, tier.major) or manifest
    return DownloadResult(
        split=tier.split,
        size=tier.name,
        folder=tier.folder(folder),
        mirror=work.url,
        downloaded=tuple(sorted(work.downloaded)),
        kept=tuple(sorted((*held, *work.kept))),
        generated=tuple(work.missing),
        bytes=work.bytes,
        seconds=time.monotonic() - started,
        complete=manifest.complete,
        dataset_sha256=manifest.dataset_sha256,
        verdict=verdict,
    )


class _Download:
    """What is there, what is fetched, what is recorded."""

    def __init__(
        self,
        size: Size,
        root: Path,
        wanted: Sequence[int],
        meter: Meter,
        connections: int,
    ) -> None:
        self.size = size
        self.root = root
        self._meter = meter
        self._connections = connections
        self.url: str | None = None  # store that files came from
        self.downloaded: list[int] = []
        self.bytes = 0
        if size.measured:
            self._recorded = dict(size.measured.scenario_sha256)
        else:
            self._recorded = {}
        self._old = read_or_empty(size, root)
        meter.begin("checking", total=len(wanted), scenarios=len(wanted))
        findings = [
            inspect_scenario(root, size, i, manifest=self._old, quick=True)
            for i in wanted
        ]
        self._entries = [finding.entry for finding in findings if finding.entry]
        self.kept = [f.scenario for f in findings if f.state is DataSetState.GOOD]
        self.missing = [
            f.scenario for f in findings if f.state is not DataSetState.GOOD
        ]

    def run(self, urls: Iterable[str]) -> Reason:
        """Fetch what is missing from stores in turn, unless one lies; return why
        something still is.
        """
        place = f"{self.size.split} {self.size.name}"
        reason: Reason = UsageError(
            "no store is known to download from",
            where=place,
            got=f"{RELEASES}, a placeholder" if self.size.simulated else None,
            fix=f"name one: --from URL, or {RELEASES_VARIABLE}=URL; or leave out "
            f"--no-generate",
        )
        unknown = [i for i in self.missing if i not in self._recorded]
        if unknown:
            what = "datasets.yaml has no hash to check downloads against"
            return DataError(what, where=f"{place}, scenarios {format_ids(unknown)}")
        for url in urls:
            if self.missing:
                try:
                    reason = self._fetch_from(url.rstrip("/")) or reason
                except StoreUnreachableError as error:
                    reason = error
        return reason

    def _fetch_from(self, url: str) -> NotInStoreError | None:
        """Fetch what one store has; return the error of the last file that it has
        not.
        """
        check_disk(self.root, sum(map(self.size.file_bytes, self.missing)))
        # What its manifest says of the files that datasets.yaml means; None without
        # one.
        claims: dict[int, FileEntry] | None = None
        last: NotInStoreError | None = None
        place = object_address(self.size, url, MANIFEST_NAME)
        with suppress(NotInStoreError):
            text = fetch_text(place, limit=MANIFEST_LIMIT, hint=REMEDY)
            manifest = parse_manifest(self.size, text, where=place, hint=REMEDY)
            claims = {entry.scenario: entry for entry in manifest.files}
            other = [
                i
                for i in self.missing
                if i in claims and not claims[i].has_hash(self._recorded[i])
            ]
            refuse_foreign_hashes(manifest, other, where=place, hint=REMEDY)
        wanted = {}
        for i in self.missing:
            key = self.size.key(i)
            claim = (claims or {}).get(i)
            wanted[i] = FetchRequest(
                url=object_address(self.size, url, f"{key.subset}/{i:04d}.nc"),
                target=scenario_path(self.root, key),
                limit=self.size.longest_file(i),
                content_sha256=self._recorded[i],
                length=claim.bytes if claim else None,
                file_sha256=claim.file_sha256 if claim else None,
                hint=REMEDY,
            )
        total = sum(one.length or self.size.file_bytes(i) for i, one in wanted.items())
        self._meter.begin("downloading", total=total, scenarios=len(wanted))
        try:
            if claims is None:  # it may have the archive of the data set instead
                limit = (
                    sum(map(self.size.longest_file, self.size.scenarios))
                    + MANIFEST_LIMIT
                )
                archive = fetch_archive(
                    self.size, url, wanted, self._count, limit=limit, hint=REMEDY
                )
                with suppress(NotInStoreError), closing(archive) as arrived:
                    for claim in arrived:
                        self._take(url, claim.scenario, claim)
                    return None
                claims = {}
                wanted = {
                    i: one for i, one in wanted.items() if i not in self.downloaded
                }
            with closing(
                fetch_scenarios(wanted, self._count, connections=self._connections)
            ) as arrivals:
                for scenario, absent in arrivals:
                    if absent is None:
                        self._take(url, scenario, claims.get(scenario))
                    last = absent or last
        finally:
            self.missing = [i for i in self.missing if i not in self.downloaded]
        return last

    def _take(self, url: str, scenario: int, claim: FileEntry | None) -> None:
        """Note a new file; what cannot be told from it is the store's word."""
        entry = describe_file(self.root, self.size.key(scenario))
        if claim is not None:  # files of earlier versions state no facts
            facts = entry.facts or claim.facts
            entry = entry.model_copy(
                update={"facts": facts, "twin_floor": claim.twin_floor}
            )
        self._entries.append(entry)
        self.downloaded.append(scenario)
        self.url = url
        self._meter.count(scenarios=1)

    def _count(self, count: int) -> None:
        self.bytes += count
        self._meter.count(count)

    def record(self) -> Manifest:
        """Write the manifest of what is there now; return it."""
        record_entry_hashes(self.size.folder(self.root), self._entries)
        kept = tuple(
            entry for entry in self._old.files if entry.scenario not in self.missing
        )
        manifest = merge_entries(
            self.size, self._old.model_copy(update={"files": kept}), self._entries
        )
        if self.size.measured and "train" in manifest.subset_sha256:
            rows = {
                name: tuple(row) for name, row in self.size.measured.statistics.items()
            }
            manifest = manifest.model_copy(update={"statistics": rows})
        if manifest.files:
            write_manifest(self.root, manifest)
        return manifest
