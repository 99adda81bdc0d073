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
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import file_sha256, to_plain
from lagbench.data.layout import scenario_path, url_of
from lagbench.data.local import DESCRIPTION
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    describe_file,
    load_recorded_hashes,
)
from lagbench.data.registry import Size, format_ids
from lagbench.data.scenario import ScenarioHeader, check_scenario, read_scenario
from lagbench.errors import DataError
from lagbench.generators.batch import draw
from lagbench.generators.simulate import OUTCOMES, file_parameters
from lagbench.work.machine import available_cores, may_differ

from .cards import PICTURES
from .plan import estimate


class State(enum.StrEnum):
    """What became of a scenario's file."""

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
    measured: bool  # whether that is at a rate that this machine has measured
    # scenario files that are there, by subset; 'lagbench verify' checks them. Of a
    # store what its manifest names.
    present: dict[str, int]
    folder: Path  # where they are, or would be
    picture: Path | None  # picture of the data set once it is generated
    dataset_sha256: str | None  # data set hash as datasets.yaml has it

    @property
    def state(self) -> str:
        """Whether it is on this machine: "yes", "no" or how much of it."""
        there = sum(self.present.values())
        wanted = sum(self.scenarios.values())
        if there == wanted:
            return "yes"
        if there:
            return f"{there} of {wanted}"
        return "no"


def overview(size: Size, root: Path) -> Overview:
    """Return what a size is, costs, and has below a root folder or in its store, read
    from names alone.
    """
    folder = size.folder(root)
    ids = size.scenarios
    url = url_of(root)
    # to draw all would take seconds
    expected = estimate(size, ids, drawn=2) if size.simulated else None
    if url is None:
        there = {i for i in ids if size.path(root, i).is_file()}
    else:
        from lagbench.store.copy import (
            remote_manifest,
        )  # what a store takes is not loaded for a folder

        found = remote_manifest(size, url)
        if found:
            there = {entry.scenario for entry in found.files}
        else:
            there = set()
    return Overview(
        split=size.split,
        size=size.name,
        version=size.version,
        scenarios={subset: len(ids) for subset, ids in size.subsets.items()},
        particles=size.particles,
        frames=sum(map(size.frame_count, ids)),
        bytes=sum(map(size.file_bytes, ids)),
        seconds=expected.seconds(available_cores()) if expected else 0.0,
        measured=expected is not None and expected.measured,
        present={subset: len(there & {*ids}) for subset, ids in size.subsets.items()},
        folder=folder,
        picture=next(
            (folder / name for name in PICTURES if (folder / name).is_file()), None
        ),
        dataset_sha256=size.measured.dataset_sha256 if size.measured else None,
    )


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a look at one scenario's file showed."""

    scenario: int  # its id
    state: State  # whether the file is there and right
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


def examine(
    root: Path,
    size: Size,
    scenario: int,
    *,
    manifest: Manifest | None = None,
    quick: bool = False,
    trusting: bool = False,
) -> Finding:
    """Look at a file; ``quick`` asks for an entry and takes hashes of before,
    ``trusting`` the manifest's.
    """
    key = size.key(scenario)
    path = scenario_path(root, key)
    if not path.exists():
        return Finding(scenario=scenario, state=State.MISSING)
    if manifest:
        claim = manifest.entry(scenario)
    else:
        claim = None
    recorded = recorded_hash(size, scenario)
    try:
        # A manifest is the word of whoever wrote it: only what was hashed here is not
        # hashed again.
        if quick:
            noted = load_recorded_hashes(size.folder(root))(path)
        else:
            noted = None
        # Before the values: a file that changes meanwhile then fits no note.
        digest = noted[1] if noted else file_sha256(path) if quick else None
        if trusting and claim is not None and digest == claim.file_sha256:
            noted = claim.content_sha256, claim.file_sha256
        with read_scenario(path) as file:
            _check_header(path, file.header, size, scenario)
            if noted:
                file.check_attributes()
        if noted:
            content = noted[0]
        else:
            content = check_scenario(path)
        unchanged = claim is not None and (digest, content) == (
            claim.file_sha256,
            claim.content_sha256,
        )
        expected = recorded or (claim.content_sha256 if claim else None)
        differs = expected is not None and not content.startswith(expected)
        if differs and not (
            manifest is not None
            and manifest.identity == "tolerance"
            and claim is not None
            and claim.content_sha256 == content
            and may_differ(claim.device, manifest.environments)
        ):
            raise DataError(
                "the file has another content hash",
                where=str(path),
                expected=f"{expected} of "
                f"{record_of(size) if recorded else 'the manifest'}",
                got=content,
            )
        entry = claim
        if digest and not unchanged:
            entry = describe_file(root, key, digest=digest)
            if (
                claim is not None and claim.content_sha256 == content
            ):  # packed anew, or by an earlier version
                facts = entry.facts or claim.facts
                entry = entry.model_copy(
                    update={"facts": facts, "twin_floor": claim.twin_floor}
                )
    except DataError as error:
        # How to mend it depends on the split, and is said once for all files.
        problem = str(
            DataError(
                error.what, where=error.where, expected=error.expected, got=error.got
            )
        )
        return Finding(scenario=scenario, state=State.WRONG, problem=problem)
    except OSError as error:
        problem = f"cannot read {path}: {error.strerror}"
        return Finding(scenario=scenario, state=State.WRONG, problem=problem)
    return Finding(
        scenario=scenario,
        state=State.GOOD,
        content_sha256=content,
        entry=entry if quick else None,
        tolerated=differs,
    )


def look(examined: Callable[[], Finding], report: Callable[[int], None]) -> Finding:
    """Examine a file, as a worker does, and report it as one unit of work."""
    finding = examined()
    report(1)
    return finding


def extra_files(root: Path, size: Size) -> dict[str, list[str]]:
    """Return, by subset folder, the names of files that no scenario of the size has."""
    folder = size.folder(root)
    known = {
        (subset, f"{i:04d}.nc") for subset, ids in size.subsets.items() for i in ids
    }
    extra: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*/*.nc")):
        if (path.parent.name, path.name) not in known and not path.name.startswith("."):
            extra.setdefault(path.parent.name, []).append(path.name)
    return extra


def _check_header(
    path: Path, header: ScenarioHeader, size: Size, scenario: int
) -> None:
    """Refuse a file of another scenario or simulated with other parameters."""
    key = header.key
    found = (key.split, key.size, key.major, key.scenario, key.subset)
    wanted = (size.split, size.name, size.major, scenario, size.subset_of(scenario))
    if found != wanted:
        raise DataError(
            "a file holds another scenario", where=str(path), expected=wanted, got=found
        )
    if not size.simulated:  # then the recorded content hash covers the parameters
        return
    parameters = {
        name: to_plain(value)
        for name, value in file_parameters(size, draw(size, scenario)).items()
    }
    # What only the simulation tells is covered by the content hash.
    stated = {
        name: value for name, value in header.parameters.items() if name not in OUTCOMES
    }
    if parameters != stated:
        names = sorted(
            n
            for n in parameters.keys() | stated.keys()
            if parameters.get(n) != stated.get(n)
        )
        raise DataError(
            "a file was simulated with other parameters",
            where=f"{path}, attributes {', '.join(names)}",
            expected="those of datasets.yaml",
        )


def record_of(size: Size) -> str:
    """Return the name of the file that records the hashes of a split."""
    if size.simulated:
        return "datasets.yaml"
    return DESCRIPTION


def compare(size: Size, manifest: Manifest, *, promised: Collection[int] = ()) -> str:
    """Return how the hashes of a manifest compare with datasets.yaml, in words."""
    measured = size.measured
    record = record_of(size)
    if measured is None:
        return f"{record} holds no hash of this size yet: nothing to compare with"
    recorded = measured.scenario_sha256
    differing = [
        e.scenario for e in manifest.files if not e.has_hash(recorded.get(e.scenario))
    ]
    tolerated = {
        e.scenario
        for e in manifest.files
        if may_differ(e.device, manifest.environments)
    }
    tolerated -= set(promised)
    broken = [i for i in differing if i not in tolerated]
    found = {**manifest.subset_sha256, "the data set": manifest.dataset_sha256}
    wanted = {**measured.subset_sha256, "the data set": measured.dataset_sha256}
    others = [
        name
        for name, digest in found.items()
        if digest is not None and digest != wanted.get(name)
    ]
    if broken:
        what = f"{len(broken)} of {len(manifest.files)} scenarios have another hash"
        others = [f"scenarios {format_ids(broken)}"]
    elif differing:
        return f"scenarios {format_ids(differing)} have {other_bits(size)}"
    elif others:
        what = "subsets or the data set have another hash though every scenario has its own"
    else:
        if manifest.complete:
            return f"equal to {record}"
        return f"what is there is equal to {record}"
    raise DataError(
        what,
        where=f"{size.split} {size.name}, {', '.join(others)}",
        expected=f"the hashes in {record}",
        fix="see docs/determinism.md; `lagbench doctor` prints what a report needs",
    )


def unlike(size: Size) -> str:
    """Return the words for a hash that is not the recorded one."""
    return f"NOT that of {record_of(size)}"


def other_bits(size: Size) -> str:
    """Return the words for bits that may be others."""
    return f"other bits than {record_of(size)} (identity: tolerance)"


def hash_verdict(
    size: Size, computed: str | None, subset: str | None = None, *, tolerated: bool
) -> str:
    """Return how the hash of a subset, else of the data set, compares with the recorded
    one, in words.
    """
    known = size.measured
    recorded = known and (
        known.subset_sha256.get(subset) if subset else known.dataset_sha256
    )
    if recorded is None:
        return f"no hash in {record_of(size)} yet"
    if computed is None:
        return "incomplete"
    if computed == recorded:
        return f"equal to {record_of(size)}"
    if tolerated:
        return other_bits(size)
    return unlike(size)
