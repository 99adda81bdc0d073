"""One download: what is there, what is fetched side by side, what is checked and recorded."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from pathlib import Path

from pydantic import ValidationError

from lagbench.atomic import remove_leftovers
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME, ScenarioKey, dataset_folder, scenario_path
from lagbench.data.manifest import FileEntry, Manifest, describe_file, merge, read_manifest, write_manifest
from lagbench.data.registry import Size, spell_ids
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.make.plan import check_disk, scenario_bytes
from lagbench.make.verify import State, examine
from lagbench.store.mirror import Fetch, fetch, fetch_text
from lagbench.store.mirror_errors import (
    ConnectionLostError,
    MirrorUnreachableError,
    NotDataError,
    NotOnMirrorError,
    WrongContentError,
)
from lagbench.work.progress import Meter

__all__ = ["Errand", "Reason"]

Reason = DataError | WorkFailedError | UsageError
"""Why something could not be downloaded."""

MANIFEST_LIMIT = 64 << 20
"""Longest manifest that is read [bytes]."""

SLACK = 1.25
"""Share by which a compressed file may be longer than its values."""


class Errand:
    """One download: what is there, what is fetched, what is recorded."""

    def __init__(self, size: Size, root: Path, wanted: Sequence[int], meter: Meter, connections: int) -> None:
        self.size, self.root, self._meter, self._connections = size, root, meter, connections
        self.mirror: str | None = None  # base URL that files came from
        self.downloaded: list[int] = []  # ids that were fetched
        self.bytes = 0  # bytes that arrived
        self._recorded = dict(size.measured.scenario_sha256) if size.measured else {}
        self._claims: dict[int, FileEntry] = {}
        self._old = self._read_old()
        meter.begin("checking", total=len(wanted), scenarios=len(wanted))
        findings = [examine(root, size, i, manifest=self._old, quick=True) for i in wanted]
        self._entries = [finding.entry for finding in findings if finding.entry]
        # ids whose files were there and right
        self.kept = [f.scenario for f in findings if f.state is State.GOOD]
        # ids that still are not there
        self.missing = [f.scenario for f in findings if f.state is not State.GOOD]

    def run(self, bases: Sequence[str]) -> Reason:
        """Fetch what is missing from the mirrors in turn; return why something still is."""
        place = f"{self.size.split} {self.size.name}"
        reason: Reason = UsageError(
            "no mirror is known",
            where=place,
            fix="name one: --from URL; or let it be simulated: leave out --no-generate",
        )
        unknown = [i for i in self.missing if i not in self._recorded]
        if unknown:
            what = "datasets.yaml has no hash to check downloads against"
            return DataError(what, where=f"{place}, scenarios {spell_ids(unknown)}")
        for base in bases:
            if not self.missing:
                break
            try:
                absent = self._fetch_from(base.rstrip("/"))
                reason = absent or reason
            except MirrorUnreachableError as error:
                reason = error
        return reason

    def _fetch_from(self, base: str) -> NotOnMirrorError | None:
        """Fetch what one mirror has; return the error of the last file that it has not."""
        folder = (
            f"{base}/{dataset_folder(Path(), self.size.split, self.size.name, self.size.major).as_posix()}"
        )
        self._claims = self._read_claims(f"{folder}/{MANIFEST_NAME}")
        check_disk(self.root, sum(scenario_bytes(self.size, i) for i in self.missing))
        fetches = {i: self._fetch(folder, i) for i in self.missing}
        total = sum(f.length or scenario_bytes(self.size, i) for i, f in fetches.items())
        self._meter.begin("downloading", total=total, scenarios=len(fetches))
        absent: NotOnMirrorError | None = None
        place = dataset_folder(self.root, self.size.split, self.size.name, self.size.major)
        with _swept(place), closing(_side_by_side(fetches, self._count, self._connections)) as arrivals:
            for scenario, arrival in arrivals:
                try:
                    self._accept(scenario, fetches[scenario], arrival.result())
                except NotOnMirrorError as error:
                    absent = error
                else:
                    self.mirror = base
        self.missing = [i for i in self.missing if i not in self.downloaded]
        return absent

    def _fetch(self, folder: str, scenario: int) -> Fetch:
        key, claim = self._key(scenario), self._claims.get(scenario)
        return Fetch(
            url=f"{folder}/{key.subset}/{scenario:04d}.nc",
            target=scenario_path(self.root, key),
            limit=round(SLACK * scenario_bytes(self.size, scenario)) + (1 << 20),
            length=claim.bytes if claim else None,
            sha256=claim.file_sha256 if claim else None,
        )

    def _count(self, count: int) -> None:
        self.bytes += count
        self._meter.count(count)

    def _read_claims(self, url: str) -> dict[int, FileEntry]:
        """Return what the mirror's manifest says of the files that datasets.yaml means."""
        try:
            text = fetch_text(url, limit=MANIFEST_LIMIT)
        except NotOnMirrorError:
            return {}
        try:
            manifest = Manifest.model_validate_json(text)
        except ValidationError as error:
            raise NotDataError(
                "the mirror's manifest is none",
                where=url,
                expected="a manifest.json as lagbench generate writes it",
                got=ascii(text[:80].decode("utf-8", "replace")),
                fix="another mirror: --from",
            ) from error
        found = {entry.scenario: entry for entry in manifest.files}
        other = [i for i in self.missing if i in found and not found[i].has_hash(self._recorded[i])]
        if other:
            raise WrongContentError(
                "the mirror holds another data set",
                where=f"{url}, scenarios {spell_ids(other)}",
                expected="the content hashes of datasets.yaml",
                got=f"version {manifest.version}, data set hash {manifest.dataset_sha256}",
                fix="another mirror: --from",
            )
        return found

    def _accept(self, scenario: int, wanted: Fetch, partial: Path) -> None:
        """Give a file its name once its content is right."""
        try:
            # The bytes first: HDF5 is best not given what a bad line has garbled.
            if wanted.sha256 is not None and file_sha256(partial) != wanted.sha256:
                raise DataError("its bytes are not those of the mirror's manifest")
            check_scenario(partial, self._recorded[scenario])
        except DataError as error:
            partial.unlink(missing_ok=True)
            raise WrongContentError(
                "a file from the mirror has other content",
                where=wanted.url,
                expected=f"content hash {self._recorded[scenario]} of datasets.yaml",
                got=error.what if error.got is None else f"{error.what}: {error.got}",
                fix="try again; if it stays so, the mirror is wrong: --from names another",
            ) from error
        with partial.open("rb") as stream:
            os.fsync(stream.fileno())
        partial.replace(wanted.target)
        self._entries.append(self._entry(scenario))
        self.downloaded.append(scenario)
        self._meter.count(scenarios=1)

    def _entry(self, scenario: int) -> FileEntry:
        """Return the manifest entry of a new file; what cannot be told from it is the mirror's word."""
        entry = describe_file(self.root, self._key(scenario))
        claim = self._claims.get(scenario)
        if claim is None:
            return entry
        return entry.model_copy(update={"facts": claim.facts, "twin_floor": claim.twin_floor})

    def record(self) -> Manifest:
        """Write the manifest of what is there now; return it."""
        size = self.size
        there = {entry.scenario for entry in self._entries}
        kept = [e for e in self._old.files if e.scenario not in self.missing or e.scenario in there]
        manifest = merge(
            self._old.model_copy(update={"files": tuple(kept)}),
            self._entries,
            split=size.split,
            size=size.name,
            version=size.version,
            subsets=size.subsets,
            recorded=self._recorded,
            statistics=size.measured.statistics if size.measured else None,
        )
        if manifest.files:
            write_manifest(self.root, manifest)
        return manifest

    def _read_old(self) -> Manifest:
        """Return the manifest on disk, an empty one where there is none that can be read."""
        size = self.size
        empty = Manifest(split=size.split, size=size.name, version=size.version)
        try:
            return read_manifest(self.root, size.split, size.name, size.major) or empty
        except DataError:  # it is written anew from the files
            return empty

    def _key(self, scenario: int) -> ScenarioKey:
        size = self.size
        return ScenarioKey(
            split=size.split,
            size=size.name,
            version=size.version,
            scenario=scenario,
            subset=size.subset_of(scenario),
        )


class _StoppedError(Exception):
    """Another file has failed."""


def _side_by_side(
    fetches: dict[int, Fetch], report: Callable[[int], None], connections: int
) -> Generator[tuple[int, Future[Path]], None, None]:
    """Yield files as they arrive; whatever ends the loop stops those under way."""
    stop, lock = threading.Event(), threading.Lock()

    def count(arrived: int) -> None:
        if stop.is_set():
            raise _StoppedError
        with lock:
            report(arrived)

    with ThreadPoolExecutor(max_workers=connections) as pool:
        pending = {pool.submit(fetch, wanted, report=count): i for i, wanted in fetches.items()}
        try:
            for arrival in as_completed(pending):
                yield pending[arrival], arrival
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


@contextmanager
def _swept(folder: Path) -> Iterator[None]:
    """Leave no temporary file when a mirror lies; a broken connection goes on from them."""
    try:
        yield
    except (ConnectionLostError, MirrorUnreachableError):
        raise
    except DataError:
        remove_leftovers(folder)
        raise
