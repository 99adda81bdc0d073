"""Verify a data set: hash the files again, compare with datasets.yaml, simulate some
anew.

The manifest is a claim of whoever wrote it; datasets.yaml comes with lagbench. So files
are compared with datasets.yaml, and with the manifest only where datasets.yaml has no
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
    record_hashes,
    subset_hash,
)
from lagbench.data.layout import format_ids
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UsageError, check_installed
from lagbench.generators.batch import SimulationJob
from lagbench.generators.simulate import simulate
from lagbench.generators.split import Device
from lagbench.store.copy import list_unstored, update_working_copy
from lagbench.work.machine import worker_count
from lagbench.work.pool import Pool, WorkItem
from lagbench.work.run import Meter, Progress

from .inventory import (
    DataSetState,
    ScenarioInspection,
    extra_files,
    hash_verdict,
    inspect_scenario,
    other_bits,
    recorded_hash,
    unlike,
)
from .plan import Scenarios, Selection, estimate, select

Inspections = Mapping[int, ScenarioInspection]
"""What the inspection of each scenario's file showed, by id."""


@dataclass(frozen=True, kw_only=True)
class SubsetReport:
    """What the files of one subset are."""

    name: str  # name of the subset
    present: int  # scenarios that are there and right
    missing: tuple[int, ...]  # ids that are not there
    wrong: tuple[int, ...]  # ids whose file is damaged or has another hash
    extra: tuple[str, ...]  # files in the subset's folder that belong to no scenario
    verdict: str  # how its hash compares with datasets.yaml, in words


@dataclass(frozen=True, kw_only=True)
class VerificationResult:
    """What a verification showed."""

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
        """Raise a DataError unless everything that has to hold does."""
        where = str(self.folder)
        if self.problems:
            problems = "\n  ".join(self.problems)
            raise DataError(
                f"{len(self.problems)} problem(s):\n  {problems}\n{self.fix}",
                where=where,
            )

        if not any(report.present for report in self.subsets):
            raise DataError(f"nothing is generated; {self.fix}", where=where)

        if self.must_be_complete and not self.complete:
            gaps = []
            for report in self.subsets:
                if report.missing:
                    gaps.append(f"{report.name} {format_ids(report.missing)}")
            raise DataError(
                f"the data set is incomplete, missing: {', '.join(gaps)}; {self.fix}",
                where=where,
            )


def verify(
    split: str | Path,
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
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
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
        UsageError: unknown split, size, subset or scenario, fewer than one worker, or a
            negative number for ``regenerate``.
        DataError: the root folder is the working copy of a store that holds wrong data.
        WorkFailedError: simulating anew failed, or the store does not answer.
    """
    tier, data_root, _ = locate(split, size, root=root, registry=registry)
    ids = select(tier, subset=subset, scenarios=scenarios)
    meter = Meter(progress)
    cores = worker_count(workers)
    if regenerate < 0:
        raise UsageError(
            f"the number is negative: {regenerate}; leave it out, or give such a "
            "number",
            where="--regenerate",
        )
    if regenerate:
        check_installed("taichi", extra="generate")

    update_working_copy(tier, data_root, ids, thoroughly=True)
    manifest, warnings = _read_manifest(tier, data_root)
    inspections = _inspect_files(tier, data_root, ids, manifest=manifest, meter=meter)
    # content hashes of the files that are there and right
    hashes: dict[int, str] = {}
    for scenario, inspection in inspections.items():
        if inspection.content_sha256:
            hashes[scenario] = inspection.content_sha256

    new_hashes = _regenerate(tier, evenly_spaced(ids, regenerate), cores, meter)
    regenerated: dict[int, str] = {}
    for scenario, content in new_hashes.items():
        regenerated[scenario] = _compare_regenerated(
            tier, inspections[scenario], content
        )

    subset_digests = _subset_digests(tier, hashes)
    data_set_digest = _data_set_digest(tier, subset_digests)
    reports = _subset_reports(data_root, tier, inspections, subset_digests)
    tolerated = []
    for i, inspection in inspections.items():
        if inspection.tolerated:
            tolerated.append(i)
    verdict = hash_verdict(tier, data_set_digest, tolerated=bool(tolerated))

    problems = [*_file_problems(inspections), *_regeneration_problems(regenerated)]
    # A killed writer leaves files here that the store never got.
    for scenario in list_unstored(tier, data_root, [*hashes]):
        problem = f"scenario {scenario} is in the working copy alone, not in the store"
        problems.append(problem)
    problems += _hash_problems(tier, reports, verdict)

    warnings += _gaps(tier, reports, tolerated)
    warnings += _manifest_differences(tier, manifest, inspections)
    identity = "unknown"
    if manifest:
        identity = manifest.identity
    return VerificationResult(
        split=tier.split,
        size=tier.name,
        folder=tier.folder(data_root),
        subsets=reports,
        identity=identity,
        dataset_sha256=data_set_digest,
        regenerated=regenerated,
        problems=tuple(problems),
        warnings=tuple(warnings),
        must_be_complete=complete,
        verdict=verdict,
        fix=suggest_repair(tier, root=data_root),
    )


def _read_manifest(size: Size, root: Path) -> tuple[Manifest | None, list[str]]:
    """Return the manifest of a data set, and what a reader should know of it."""
    try:
        manifest = read_manifest(root, size.split, size.name, size.major)
    except DataError as error:
        return None, [str(error)]
    if manifest is None:
        return None, [f"there is no manifest: {suggest_repair(size, root=root)}"]

    warnings = []
    if manifest.identity == "tolerance":
        warnings.append(
            "identity: tolerance - a device wrote these files that does not "
            "promise equal bits"
        )
    return manifest, warnings


def _inspect_files(
    size: Size,
    root: Path,
    ids: Sequence[int],
    *,
    manifest: Manifest | None,
    meter: Meter,
) -> dict[int, ScenarioInspection]:
    """Hash every file; note which are right, so that scorer and generator need not hash
    their values again.
    """
    meter.begin("hashing", total=len(ids), scenarios=len(ids))
    inspections: dict[int, ScenarioInspection] = {}
    file_digests: dict[Path, str] = {}
    contents: dict[Path, str] = {}
    for scenario in ids:
        path = size.path(root, scenario)
        # Before the values, so that a file that changes meanwhile fits no note.
        with suppress(OSError):
            file_digests[path] = file_sha256(path)
        inspection = inspect_scenario(root, size, scenario, manifest=manifest)
        inspections[scenario] = inspection
        if inspection.content_sha256:
            contents[path] = inspection.content_sha256
        meter.count(1, scenarios=1)
    record_hashes(size.folder(root), contents, file_hashes=file_digests)
    return inspections


def evenly_spaced(ids: Sequence[int], count: int) -> tuple[int, ...]:
    """Return some of the ids, evenly spaced: the first, and from two on the last.

    >>> evenly_spaced(range(60), 3)
    (0, 30, 59)
    """
    count = min(count, len(ids))
    if count < 2:
        return tuple(ids[:count])

    last = len(ids) - 1
    chosen = []
    for k in range(count):
        # k last / (count - 1), rounded to the nearest, halves up
        position = (2 * k * last + count - 1) // (2 * (count - 1))
        chosen.append(ids[position])
    return tuple(chosen)


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
                for simulated in event.value:
                    hashes[simulated.scenario] = simulated.content_sha256
                meter.count(scenarios=1)
            elif event.kind == "progress":
                meter.count(event.value)
            else:
                # lost with its worker: done in vain
                meter.count(-event.value)
    return {scenario: hashes[scenario] for scenario in ids}


def _compare_regenerated(
    size: Size, inspection: ScenarioInspection, content: str
) -> str:
    """Compare a scenario simulated anew with its file, else with datasets.yaml."""
    references = []
    if inspection.content_sha256:
        references.append(inspection.content_sha256)
    if inspection.tolerated or not references:
        recorded = recorded_hash(size, inspection.scenario)
        if recorded:
            references.append(recorded)
    if not references:
        return "nothing to compare with"
    for reference in references:
        if content.startswith(reference):
            return "identical"
    return "different"


def _subset_digests(size: Size, hashes: Mapping[int, str]) -> dict[str, str]:
    """Return the hash of every subset whose files are all there and right."""
    digests = {}
    for name, members in size.subsets.items():
        if hashes.keys() >= set(members):
            digests[name] = subset_hash({i: hashes[i] for i in members})
    return digests


def _data_set_digest(size: Size, subset_digests: Mapping[str, str]) -> str | None:
    """Return the hash of a data set; None while a subset that it covers has none."""
    covered = {}
    for name in HASHED_SUBSETS:
        if name not in subset_digests:
            return None
        covered[name] = subset_digests[name]
    return dataset_hash(size.split, size.name, size.major, covered)


def _subset_reports(
    root: Path, size: Size, inspections: Inspections, digests: Mapping[str, str]
) -> tuple[SubsetReport, ...]:
    extra = extra_files(root, size)
    reports = []
    for name, members in size.subsets.items():
        subset_inspections = []
        for i in members:
            if i in inspections:
                subset_inspections.append(inspections[i])
        if not subset_inspections:
            continue
        is_tolerated = any(inspection.tolerated for inspection in subset_inspections)
        verdict = hash_verdict(size, digests.get(name), name, tolerated=is_tolerated)
        report = SubsetReport(
            name=name,
            present=len(_ids_in_state(subset_inspections, DataSetState.GOOD)),
            missing=_ids_in_state(subset_inspections, DataSetState.MISSING),
            wrong=_ids_in_state(subset_inspections, DataSetState.WRONG),
            extra=tuple(extra.get(name, ())),
            verdict=verdict,
        )
        reports.append(report)
    return tuple(reports)


def _ids_in_state(
    inspections: Sequence[ScenarioInspection], state: DataSetState
) -> tuple[int, ...]:
    scenarios = []
    for inspection in inspections:
        if inspection.state is state:
            scenarios.append(inspection.scenario)
    return tuple(scenarios)


def _file_problems(inspections: Inspections) -> list[str]:
    problems = []
    for inspection in inspections.values():
        if inspection.problem:
            problems.append(inspection.problem)
    return problems


def _regeneration_problems(regenerated: Mapping[int, str]) -> list[str]:
    problems = []
    for scenario, verdict in regenerated.items():
        if verdict == "different":
            problems.append(f"scenario {scenario} differs when simulated anew")
    return problems


def _hash_problems(
    size: Size, reports: Sequence[SubsetReport], verdict: str
) -> list[str]:
    """Return which hashes are not the recorded ones."""
    wrong = unlike(size)
    problems = []
    for report in reports:
        if report.verdict == wrong:
            problems.append(f"{report.name}: its hash is {wrong}")
    if verdict == wrong:
        problems.append(f"the data set hash is {wrong}")
    return problems


def _gaps(
    size: Size, reports: Sequence[SubsetReport], tolerated: Sequence[int]
) -> list[str]:
    """Return what is tolerated, missing, or there without a scenario."""
    gaps = []
    if tolerated:
        gaps.append(f"scenarios {format_ids(tolerated)} have {other_bits(size)}")
    for report in reports:
        if report.missing:
            gaps.append(f"{report.name} lacks {format_ids(report.missing)}")
    for report in reports:
        if report.extra:
            names = ", ".join(report.extra)
            gaps.append(f"{report.name} has files of no scenario: {names}")
    return gaps


def _manifest_differences(
    size: Size, manifest: Manifest | None, inspections: Inspections
) -> list[str]:
    """Return how the manifest differs from files that are right, and from
    datasets.yaml.
    """
    if manifest is None:
        return []
    differences = []
    different_ids = []
    for scenario, inspection in inspections.items():
        entry = manifest.entry(scenario)
        content = inspection.content_sha256
        if entry and content and content != entry.content_sha256:
            different_ids.append(scenario)
    if different_ids:
        listing = format_ids(different_ids)
        differences.append(f"the manifest has other hashes of {listing}")

    names = _different_statistics(size, manifest)
    if names:
        listing = ", ".join(names)
        record = size.record_name
        differences.append(f"the manifest has another {listing} than {record}")
    return differences


def _different_statistics(size: Size, manifest: Manifest) -> list[str]:
    """Return the names of recorded numbers of which the manifest has others.

    They follow from the bits. So they must be as recorded where all bits are.
    """
    is_bitwise = manifest.complete and manifest.identity == "bitwise"
    if size.measured is None or not is_bitwise:
        return []
    stated = manifest.statistics
    recorded = size.measured.statistics
    names = []
    for name in sorted(stated.keys() | recorded.keys()):
        if stated.get(name) != recorded.get(name):
            names.append(name)
    if manifest.mean_twin_floor() != size.measured.twin_floor:
        names.append("twin_floor")
    return names
