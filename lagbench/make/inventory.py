"""What a size of a split costs, which scenarios are on disk, and whether they are
right, hash by hash.

Right means: the file says what it is in the place where it stands, its parameters are
those of the registry, its values have the hash that it states, and that hash is the one
in datasets.yaml; where there is none yet, the one in the manifest. A file of a machine
that promises no equal bits may differ from datasets.yaml, but not from its manifest.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import file_sha256, load_recorded_hashes
from lagbench.data.hdf5 import to_plain
from lagbench.data.layout import (
    PICTURES,
    format_ids,
    scenario_path,
    url_of,
)
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    describe_file,
)
from lagbench.data.registry import Size, default_path
from lagbench.data.scenario import ScenarioHeader, check_scenario, read_scenario
from lagbench.data.statistics import QUANTITIES
from lagbench.errors import DataError
from lagbench.generators.batch import draw_initial_state, file_parameters
from lagbench.generators.simulate import OUTCOMES
from lagbench.work.machine import available_cores, may_differ

from .plan import estimate


def has_all_statistics(manifest: Manifest, size: Size) -> bool:
    """Return whether a manifest has the statistics of train, a number for each axis.

    Somebody else may have written it. So names and numbers may be missing or too many.
    """
    names: set[str] = set()
    for quantity in QUANTITIES:
        names.update((f"{quantity}_mean", f"{quantity}_std"))
    lengths = {len(row) for row in manifest.statistics.values()}
    return manifest.statistics.keys() == names and lengths == {size.dimension}


class DataSetState(enum.StrEnum):
    """What became of a scenario's file in a data set."""

    GOOD = "good"
    MISSING = "missing"
    WRONG = "wrong"


@dataclass(frozen=True, kw_only=True)
class Overview:
    """What tables say about one size of a split."""

    split: str  # name of the split
    size: str  # name of the size
    version: str  # semantic version
    scenarios: dict[str, int]  # number of scenarios by subset
    particles: int  # particles in one scenario
    frames: int  # recorded frames of all scenarios
    bytes: int  # disk space before compression [bytes]
    # time to generate on all cores of this machine [s], for orientation; 0 for what
    # cannot be simulated
    seconds: float
    # scenario files that are there, by subset; 'lagbench verify' checks them. Of a
    # store what its manifest names.
    present: dict[str, int]
    folder: Path  # where they are, or would be
    picture: Path | None  # picture of the data set once it is generated
    dataset_sha256: str | None  # data set hash as datasets.yaml has it

    @property
    def state(self) -> str:
        """Whether it is on this machine: "yes", "no" or a count as in "3/5"."""
        present_count = sum(self.present.values())
        total_count = sum(self.scenarios.values())
        if present_count == total_count:
            return "yes"
        if present_count:
            return f"{present_count}/{total_count}"
        return "no"


def overview(size: Size, root: Path) -> Overview:
    """Return what a size is, costs, and has below a root folder or in its store, read
    from names alone.
    """
    folder = size.folder(root)
    ids = size.scenarios

    seconds = 0.0
    if size.simulated:
        seconds = estimate(size, ids).core_seconds / available_cores()
    url = url_of(root)
    if url is None:
        present_ids = {i for i in ids if size.path(root, i).is_file()}
    else:
        # what a store takes is not loaded for a folder
        from lagbench.store.copy import remote_manifest

        manifest = remote_manifest(size, url)
        entries = manifest.files if manifest else ()
        present_ids = {entry.scenario for entry in entries}
    counts: dict[str, int] = {}
    present: dict[str, int] = {}
    for subset, members in size.subsets.items():
        counts[subset] = len(members)
        present[subset] = len(present_ids.intersection(members))
    pictures = [folder / name for name in PICTURES if (folder / name).is_file()]
    return Overview(
        split=size.split,
        size=size.name,
        version=size.version,
        scenarios=counts,
        particles=size.particles,
        frames=sum(map(size.frame_count, ids)),
        bytes=size.data_set_bytes(ids),
        seconds=seconds,
        present=present,
        folder=folder,
        picture=pictures[0] if pictures else None,
        dataset_sha256=size.measured.dataset_sha256 if size.measured else None,
    )


@dataclass(frozen=True, kw_only=True)
class ScenarioInspection:
    """What an inspection of one scenario's file showed."""

    scenario: int  # its id
    state: DataSetState  # whether the file is there and right
    content_sha256: str | None = None  # content hash of a good file
    # what is wrong, naming file and, where it can be told, variable
    problem: str | None = None
    # manifest entry of a good file, where one was asked for
    entry: FileEntry | None = None
    tolerated: bool = False  # whether a good file has other bits than datasets.yaml


def recorded_hash(size: Size, scenario: int) -> str | None:
    """Return the first 16 digits of a content hash as they are recorded, or None."""
    if size.measured:
        return size.measured.scenario_sha256.get(scenario)
    return None


def inspect_scenario(
    root: Path,
    size: Size,
    scenario: int,
    *,
    manifest: Manifest | None = None,
    quick: bool = False,
) -> ScenarioInspection:
    """Inspect a scenario's file.

    Args:
        root: folder of all data sets.
        size: size that the scenario belongs to.
        scenario: its id.
        manifest: what the folder's manifest says.
        quick: ask for a manifest entry, and take the content hash that this machine
            noted before instead of hashing the values again.
    """
    path = scenario_path(root, size.key(scenario))
    if not path.exists():
        return ScenarioInspection(scenario=scenario, state=DataSetState.MISSING)
    try:
        return _inspect_file(root, size, scenario, manifest=manifest, quick=quick)
    except DataError as error:
        problem = str(error)
    except OSError as error:
        problem = f"cannot read {path}: {error.strerror}"
    return ScenarioInspection(
        scenario=scenario, state=DataSetState.WRONG, problem=problem
    )


def _inspect_file(
    root: Path,
    size: Size,
    scenario: int,
    *,
    manifest: Manifest | None,
    quick: bool,
) -> ScenarioInspection:
    """Inspect a file that is there; one that is not right is a DataError."""
    path = size.path(root, scenario)
    claim = manifest.entry(scenario) if manifest else None

    # A manifest is the word of whoever wrote it: only what was hashed here is not
    # hashed again.
    noted_content: str | None = None
    digest: str | None = None
    if quick:
        noted = load_recorded_hashes(size.folder(root))(path)
        if noted:
            noted_content, digest = noted
        else:
            # Before the values: a file that changes meanwhile then fits no note.
            digest = file_sha256(path)

    with read_scenario(path) as file:
        key = file.header.key
        stated_key = (key.split, key.size, key.major, key.scenario, key.subset)
        subset = size.subset_of(scenario)
        expected_key = (size.split, size.name, size.major, scenario, subset)
        if stated_key != expected_key:
            raise DataError(
                f"a file holds another scenario: got {stated_key}, expected "
                f"{expected_key}",
                where=str(path),
            )
        different_parameters = _list_different_parameters(file.header, size, scenario)
    recorded = recorded_hash(size, scenario)
    content = noted_content
    if different_parameters:
        # The content hash covers the parameters. So a file with the recorded hash is
        # right, whatever the module of the split draws today.
        content = None
        if recorded is not None:
            with suppress(DataError):
                content = check_scenario(path)
        if content is None or not content.startswith(recorded or "?"):
            raise DataError(
                "a file was simulated with other parameters: expected those of "
                f"{size.record_name}, and of {size.generator}",
                where=f"{path}, attributes {', '.join(different_parameters)}",
            )
    content = content or check_scenario(path)

    expected = recorded or (claim.content_sha256 if claim else "")
    is_tolerated = False
    if not content.startswith(expected):
        # A machine may have written it that promises no equal bits.
        is_tolerated = (
            manifest is not None
            and manifest.identity == "tolerance"
            and claim is not None
            and claim.content_sha256 == content
            and may_differ(claim.device, manifest.environments)
        )
        if not is_tolerated:
            source = size.record_name if recorded else "the manifest"
            raise DataError(
                f"the file has another content hash: got {content}, expected "
                f"{expected} of {source}",
                where=str(path),
            )
    entry = None
    if quick and digest is not None:
        has_same_content = claim is not None and claim.content_sha256 == content
        entry = claim
        if claim is None or not has_same_content or claim.file_sha256 != digest:
            entry = describe_file(root, size.key(scenario), digest=digest)
            if claim is not None and has_same_content:
                # packed anew, or by an earlier version
                update = {
                    "facts": entry.facts or claim.facts,
                    "twin_floor": claim.twin_floor,
                }
                entry = entry.model_copy(update=update)
    return ScenarioInspection(
        scenario=scenario,
        state=DataSetState.GOOD,
        content_sha256=content,
        entry=entry,
        tolerated=is_tolerated,
    )


def run_inspection(
    inspection: Callable[[], ScenarioInspection], report: Callable[[int], None]
) -> ScenarioInspection:
    """Inspect a file, as a worker does, and report it as one unit of work."""
    result = inspection()
    report(1)
    return result


def extra_files(root: Path, size: Size) -> dict[str, list[str]]:
    """Return, by subset folder, the names of files that no scenario of the size has."""
    folder = size.folder(root)
    known_paths = {size.path(root, scenario) for scenario in size.scenarios}
    extra: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*/*.nc")):
        if path not in known_paths and not path.name.startswith("."):
            extra.setdefault(path.parent.name, []).append(path.name)
    return extra


def _list_different_parameters(
    header: ScenarioHeader, size: Size, scenario: int
) -> list[str]:
    """Return the names of parameters that are not those of the draw.

    There are none in a local split, which has no module that draws parameters.
    """
    if not size.simulated:
        return []

    state = draw_initial_state(size, scenario)
    expected = {}
    for name, value in file_parameters(size, scenario, state).items():
        expected[name] = to_plain(value)
    if size.periodic:  # stated by the writer, from the box
        expected["periodic"] = " ".join(sorted(size.periodic))
    # What only the simulation tells is covered by the content hash.
    stated = {}
    for name, value in header.parameters.items():
        if name not in OUTCOMES:
            stated[name] = value
    if "periodic" in stated:  # in any order
        stated["periodic"] = " ".join(sorted(str(stated["periodic"]).split()))

    names = sorted(expected.keys() | stated.keys())
    return [name for name in names if expected.get(name) != stated.get(name)]


def compare_hashes(
    size: Size, manifest: Manifest, *, promised: Collection[int] = ()
) -> str:
    """Return how the hashes of a manifest compare with datasets.yaml, in words.

    ``promised``: scenarios that this call simulated on a machine that promises equal
    bits, whatever the manifest says of others.

    Raises:
        DataError: a hash is not the recorded one.
    """
    record = size.record_name
    measured = size.measured
    if measured is None:
        return (
            f"nothing to compare with: {record} holds no hash of this size yet, which "
            "would tell whether these are the bits of every x86-64 Linux CPU"
        )

    differing = []
    broken = []
    for entry in manifest.files:
        if entry.has_hash(measured.scenario_sha256.get(entry.scenario)):
            continue
        differing.append(entry.scenario)
        is_tolerated = may_differ(entry.device, manifest.environments)
        if entry.scenario in promised or not is_tolerated:
            broken.append(entry.scenario)

    computed = {**manifest.subset_sha256, "the data set": manifest.dataset_sha256}
    recorded = {**measured.subset_sha256, "the data set": measured.dataset_sha256}
    unequal = []
    for name, digest in computed.items():
        if digest is not None and digest != recorded.get(name):
            unequal.append(name)

    if broken:
        what = f"{len(broken)} of {len(manifest.files)} scenarios have another hash"
        raise _hash_error(size, what, f"scenarios {format_ids(broken)}")
    if differing:
        return f"scenarios {format_ids(differing)} have {other_bits(size)}"
    if unequal:
        what = (
            "subsets or the data set have another hash though every scenario has its "
            "own"
        )
        raise _hash_error(size, what, ", ".join(unequal))
    if manifest.complete:
        return f"equal to {record}"
    return f"what is there is equal to {record}"


def _hash_error(size: Size, what: str, place: str) -> DataError:
    fix = "see docs/determinism.md; `lagbench doctor` prints what a report needs"
    is_ours = size.file.resolve() == default_path().resolve()
    if not is_ours and size.draw_seed is None:
        fix = (
            f"if you changed the split, raise MAJOR of its version in {size.file}, "
            "generate again, and record the new hashes with "
            f"`python -m lagbench.generators.record` (docs/extending.md); else {fix}"
        )
    return DataError(
        f"{what}: got other hashes, expected the hashes in {size.record_name}; {fix}",
        where=f"{size.split} {size.name}, {place}",
    )


def unlike(size: Size) -> str:
    """Return the words for a hash that is not the recorded one."""
    return f"NOT that of {size.record_name}"


def other_bits(size: Size) -> str:
    """Return the words for bits that may be others."""
    return f"other bits than {size.record_name} (identity: tolerance)"


def hash_verdict(
    size: Size, computed: str | None, subset: str | None = None, *, tolerated: bool
) -> str:
    """Return how the hash of a subset, else of the data set, compares with the recorded
    one, in words.
    """
    measured = size.measured
    recorded = None
    if measured is not None:
        recorded = measured.dataset_sha256
        if subset is not None:
            recorded = measured.subset_sha256.get(subset)
    if recorded is None:
        return f"no hash in {size.record_name} yet"
    if computed is None:
        return "incomplete"
    if computed == recorded:
        return f"equal to {size.record_name}"
    if tolerated:
        return other_bits(size)
    return unlike(size)
