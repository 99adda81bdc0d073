"""Verify a data set: hash the files again, compare with datasets.yaml, simulate some
anew.

The manifest is a claim of whoever wrote it; datasets.yaml comes with lagbench. So files
are held against datasets.yaml, and against the manifest only where datasets.yaml has no
hash yet, or where a machine wrote files that promises no equal bits.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import (
    HASHED_SUBSETS,
    dataset_hash,
    file_sha256,
    subset_hash,
)
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import Manifest, read_manifest, record_hashes
from lagbench.data.registry import Registry, Size, format_ids
from lagbench.errors import DataError, UsageError, check_installed
from lagbench.generators.batch import SimulationJob
from lagbench.generators.simulate import simulate
from lagbench.generators.solver import Device
from lagbench.store.copy import list_unstored, update_working_copy
from lagbench.work.pool import Pool, WorkItem, worker_count
from lagbench.work.progress import Meter, Progress

from .inventory import (
    Finding,
    State,
    examine,
    extra_files,
    hash_verdict,
    other_bits,
    record_of,
    recorded_hash,
    unlike,
)
from .plan import Scenarios, Selection, estimate, select


@dataclass(frozen=True, kw_only=True)
class SubsetReport:
    """What was found of one subset."""

    name: str  # name of the subset
    present: int  # scenarios that are there and right
    missing: tuple[int, ...]  # ids that are not there
    wrong: tuple[int, ...]  # ids whose file is damaged or has another hash
    extra: tuple[str, ...]  # files in the subset's folder that belong to no scenario
    verdict: str  # how its hash compares with datasets.yaml, in words


@dataclass(frozen=True, kw_only=True)
class VerificationResult:
    """What a verification found."""

    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the data set
    subsets: tuple[SubsetReport, ...]  # a report on each subset looked at
    # "bitwise", or "tolerance" where a device wrote files that does not keep the
    # promise of equal bits; "unknown" without a manifest
    identity: str
    # data set hash of the files, where all of them are there and right
    dataset_sha256: str | None
    # id to "identical", "different" or "nothing to compare with"
    regenerated: Mapping[int, str]
    # what is wrong, each naming file and, where it can be told, variable
    problems: tuple[str, ...]
    warnings: tuple[str, ...]  # what a reader should know although it is no fault
    must_be_complete: bool  # whether a missing scenario is a fault
    verdict: str  # how the data set hash compares with datasets.yaml, in words
    fix: str  # what makes the data set whole again

    @property
    def complete(self) -> bool:
        """Whether nothing that was looked at is missing."""
        return not any(report.missing for report in self.subsets)

    def check(self) -> None:
        """Raise unless everything that has to hold does."""
        where = str(self.folder)
        if self.problems:
            count = (
                f"{len(self.problems)} problem{'s' if len(self.problems) > 1 else ''}"
            )
            what = "\n  ".join([count, *self.problems])
            raise DataError(what, where=where, fix=self.fix)
        if not any(report.present for report in self.subsets):
            raise DataError("nothing is generated", where=where, fix=self.fix)
        if self.must_be_complete and not self.complete:
            missing = ", ".join(
                f"{r.name} {format_ids(r.missing)}" for r in self.subsets if r.missing
            )
            got = f"missing: {missing}"
            raise DataError(
                "the data set is incomplete", where=where, got=got, fix=self.fix
            )


def verify(
    split: str,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    subset: Selection = None,
    scenarios: Scenarios = None,
    regenerate: int = 0,
    complete: bool = False,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> VerificationResult:
    """Compare the files of a data set with datasets.yaml; call ``check()`` on the
    result.

    Args:
        split: name of the split.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        subset: some subsets only.
        scenarios: some ids only.
        regenerate: how many scenarios to simulate anew, evenly spaced, first and last
            included.
        complete: whether a missing scenario is a fault.
        workers: worker processes for ``regenerate``; one per core when None.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset or scenario, fewer than one worker, or
            than no scenario anew.
        WorkFailedError: simulating anew failed.
    """
    tier, folder, _ = locate(split, size, root=root, registry=registry)
    ids = select(tier, subset=subset, scenarios=scenarios)
    meter = Meter(progress)
    cores = worker_count(workers)
    if regenerate < 0:
        raise UsageError(
            "fewer than none", where="--regenerate", expected=">= 0", got=regenerate
        )
    if regenerate:
        check_installed("taichi", extra="generate")
    update_working_copy(tier, folder, ids, thoroughly=True)
    manifest: Manifest | None = None
    warnings: list[str] = []
    try:
        manifest = read_manifest(folder, tier.split, tier.name, tier.major)
        if manifest is None:
            warnings.append(f"there is no manifest: {suggest_repair(tier, root=folder)}")
        elif manifest.identity == "tolerance":
            warnings.append(
                "identity: tolerance - a device wrote these files that does not "
                "promise equal bits"
            )
    except DataError as error:
        warnings.append(str(error))
    meter.begin("hashing", total=len(ids), scenarios=len(ids))
    findings = {}
    digests_of = {}
    for scenario in ids:
        path = tier.path(folder, scenario)
        with suppress(
            OSError
        ):  # before the values, so that a file that changes meanwhile fits no note
            digests_of[path] = file_sha256(path)
        findings[scenario] = examine(folder, tier, scenario, manifest=manifest)
        meter.count(1, scenarios=1)
    # Which files are right is noted, so that scorer and generator need not hash their
    # values again.
    right = {i: f.content_sha256 for i, f in findings.items() if f.content_sha256}
    record_hashes(
        tier.folder(folder),
        {tier.path(folder, i): content for i, content in right.items()},
        digests_of,
    )
    anew = _regenerate(tier, evenly_spaced(ids, regenerate), cores, meter)
    regenerated = {
        i: _likeness(tier, findings[i], content) for i, content in anew.items()
    }
    problems = [f.problem for f in findings.values() if f.problem]
    problems += [
        f"scenario {i} differs when simulated anew"
        for i in anew
        if regenerated[i] == "different"
    ]
    # A killed writer leaves files here that the store never got.
    alone = list_unstored(tier, folder, [*right])
    problems += [
        f"scenario {i} is in the working copy alone, not in the store" for i in alone
    ]
    full = {
        name: members
        for name, members in tier.subsets.items()
        if right.keys() >= {*members}
    }
    digests = {
        name: subset_hash({i: right[i] for i in members})
        for name, members in full.items()
    }
    reports = _reports(folder, tier, findings, digests)
    hashed = {name: digests.get(name, "") for name in HASHED_SUBSETS}
    if all(hashed.values()):
        whole = dataset_hash(tier.split, tier.name, tier.major, hashed)
    else:
        whole = None
    tolerated = [i for i, finding in findings.items() if finding.tolerated]
    verdict = hash_verdict(tier, whole, tolerated=bool(tolerated))
    wrong = unlike(tier)
    problems += [
        f"{r.name}: its hash is {wrong}" for r in reports if r.verdict == wrong
    ]
    problems += [f"the data set hash is {wrong}"] if verdict == wrong else []
    if tolerated:
        gaps = [f"scenarios {format_ids(tolerated)} have {other_bits(tier)}"]
    else:
        gaps = []
    gaps += [f"{r.name} lacks {format_ids(r.missing)}" for r in reports if r.missing]
    gaps += [
        f"{r.name} has files of no scenario: {', '.join(r.extra)}"
        for r in reports
        if r.extra
    ]
    return VerificationResult(
        split=tier.split,
        size=tier.name,
        folder=tier.folder(folder),
        subsets=reports,
        identity=manifest.identity if manifest else "unknown",
        dataset_sha256=whole,
        regenerated=regenerated,
        problems=tuple(problems),
        warnings=(*warnings, *gaps, *_notes(tier, manifest, findings)),
        must_be_complete=complete,
        verdict=verdict,
        fix=suggest_repair(tier, root=folder),
    )


def evenly_spaced(ids: Sequence[int], count: int) -> tuple[int, ...]:
    """Return some of the ids, evenly spaced, the first and the last included.

    >>> evenly_spaced(range(60), 3)
    (0, 30, 59)
    """
    count = min(count, len(ids))
    if count < 2:
        return tuple(ids[:count])
    last = len(ids) - 1
    return tuple(
        ids[(2 * k * last + count - 1) // (2 * (count - 1))] for k in range(count)
    )


def _regenerate(
    size: Size, ids: Sequence[int], workers: int, meter: Meter
) -> dict[int, str]:
    """Simulate scenarios into a folder that vanishes; return their content hashes."""
    if not ids:
        return {}
    substeps = estimate(size, ids).substeps
    meter.begin("simulating anew", total=sum(substeps), scenarios=len(ids))
    hashes: dict[int, str] = {}
    with (
        tempfile.TemporaryDirectory(prefix="lagbench-") as folder,
        Pool(min(workers, len(ids))) as pool,
    ):
        for scenario, cost in zip(ids, substeps, strict=True):
            job = SimulationJob(
                size=size, scenarios=(scenario,), root=Path(folder), device=Device.CPU
            )
            name = f"{size.split} {size.name}, scenario {scenario}"
            pool.submit(
                WorkItem(name=name, function=simulate, arguments=(job,), cost=cost)
            )
        for event in pool.events():
            if event.kind == "done":
                hashes |= {
                    outcome.scenario: outcome.content_sha256 for outcome in event.value
                }
                meter.count(scenarios=1)
            else:
                meter.count(event.value if event.kind == "progress" else -event.value)
    return {scenario: hashes[scenario] for scenario in ids}


def _likeness(size: Size, finding: Finding, content: str) -> str:
    """Compare a scenario simulated anew with its file, else with datasets.yaml."""
    if finding.content_sha256:
        known = [finding.content_sha256]
    else:
        known = []
    if finding.tolerated or not known:
        known += filter(None, [recorded_hash(size, finding.scenario)])
    if not known:
        return "nothing to compare with"
    if any(map(content.startswith, known)):
        return "identical"
    return "different"


def _reports(
    root: Path, size: Size, findings: Mapping[int, Finding], digests: Mapping[str, str]
) -> tuple[SubsetReport, ...]:
    extra = extra_files(root, size)
    reports = []
    for name, members in size.subsets.items():
        held = {i: findings[i] for i in members if i in findings}
        if held:
            by_state = {
                state: tuple(i for i, f in held.items() if f.state is state)
                for state in State
            }
            reports.append(
                SubsetReport(
                    name=name,
                    present=len(by_state[State.GOOD]),
                    missing=by_state[State.MISSING],
                    wrong=by_state[State.WRONG],
                    extra=tuple(extra.get(name, ())),
                    verdict=hash_verdict(
                        size,
                        digests.get(name),
                        name,
                        tolerated=any(f.tolerated for f in held.values()),
                    ),
                )
            )
    return tuple(reports)


def _notes(
    size: Size, manifest: Manifest | None, findings: Mapping[int, Finding]
) -> list[str]:
    """Return how the manifest differs from files that are right, and from
    datasets.yaml.
    """
    if manifest is None:
        return []
    entries = {entry.scenario: entry.content_sha256 for entry in manifest.files}
    others = [
        i
        for i, f in findings.items()
        if i in entries and f.content_sha256 not in (None, entries[i])
    ]
    if others:
        notes = [f"the manifest has other hashes of {format_ids(others)}"]
    else:
        notes = []
    # What follows from the bits must be as recorded where all of them are.
    if size.measured and manifest.complete and manifest.identity == "bitwise":
        found = {**manifest.statistics, "twin floor": manifest.mean_twin_floor()}
        known = {**size.measured.statistics, "twin floor": size.measured.twin_floor}
        names = [*sorted((known.keys() | found.keys()) - {"twin floor"}), "twin floor"]
        names = [name for name in names if found.get(name) != known.get(name)]
        notes += (
            [f"the manifest has another {', '.join(names)} than {record_of(size)}"]
            if names
            else []
        )
    return notes
