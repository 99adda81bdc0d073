"""Seasons: blind tests of the models on a board, without a server and a custodian.

Closing a season freezes the entries that have models. A seed follows from the hashes of
all frozen models and from the value, if the season has one. Afterwards everybody can
draw the blind scenarios::

    seed = SHA-256(season, split, size, version, all frozen models, value)

A frozen model is the hash of its file, and the options of the prediction.

The value is a public random number, from a source that was named when the season was
closed. With it nobody knows the blind scenarios before the season is closed. Without it
the last person to submit can compute them. docs/seasons.md says what each proves.

    seasons/<name>/season.yaml    the frozen entries and the seeds
    seasons/<name>/scores.yaml    the scores of their models (`season_run`)
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from lagbench.atomic import write_atomically
from lagbench.data.checksums import subset_hash
from lagbench.data.layout import SEASON_PREFIX
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Measured, Registry, Size, Split, load
from lagbench.errors import ChecksFailedError, UsageError, suggest_name
from lagbench.metrics.table import RANKING, ranking_metric
from lagbench.references.shipped import shipped
from lagbench.references.table import NAIVE
from lagbench.scoring.boards import board_option
from lagbench.scoring.skill import best_reference
from lagbench.submission.provenance import Overrides

from .entry import Entry, Prediction, Strict
from .entry_file import (
    examine,
    format_issues,
    load_plain,
    require_unchanged_model,
    yaml_bytes,
)
from .fields import (
    MOST_SEEDS,
    Date,
    Hash,
    Label,
    Line,
    Name,
    Number,
    Seed,
    Short,
    Version,
)
from .folder import SEASON_FILE, SEASONS, Folder
from .lock import board_lock
from .selection import choose_entries
from .verified import today

FIRST_SCENARIO = 1000
"""Id of the first blind scenario of a data set; all public ids are lower."""

MOST_SCENARIOS = 200
"""Most blind scenarios of a data set."""

FEWEST_BLIND_SCENARIOS = 4
"""Fewest blind scenarios that a model predicts: a gap over fewer has no interval."""

SCENARIOS = 8
BLIND = "blind"
"""Subset of the blind scenarios."""

MOST_SEASON_BYTES = 1_000_000
"""Longest file of a season [bytes]; a frozen entry takes about 300."""

RECORDED_DIGITS = 16
"""Digits of the content hashes that a registry holds."""

Recorded = Mapping[tuple[str, str], Mapping[int, str]]
"""Content hashes of blind scenarios, by split and size, then by id."""

_Count = Annotated[int, Field(ge=FEWEST_BLIND_SCENARIOS, le=MOST_SCENARIOS)]


class FrozenModel(Strict):
    """The model of one seed of an entry, and the options that it predicts with."""

    seed: Seed | None = None
    sha256: Hash
    # options that the prediction changed; None in the files of earlier seasons
    options: Annotated[Overrides, Field(strict=False)] | None = None

    @property
    def identity(self) -> str:
        """What enters the seed: the hash, and options as JSON where there are some."""
        if not self.options:
            return self.sha256
        return f"{self.sha256} {json.dumps(sorted(self.options))}"

    def is_of(self, entry: Entry, prediction: Prediction) -> bool:
        """Tell whether a prediction of an entry has this model and these options."""
        weights = prediction.weights
        if weights is None or prediction.seed != self.seed:
            return False
        if weights.sha256 != self.sha256:
            return False
        return self.options is None or self.options == entry.settings_of(prediction)


class FrozenEntry(Strict):
    """An entry of a season: the models that it had when the season was closed."""

    method: Name
    # blind scenarios that it predicts: the first ones
    scenarios: _Count
    models: Annotated[
        tuple[FrozenModel, ...],
        Field(min_length=1, max_length=MOST_SEEDS, strict=False),
    ]


class SeasonDataSet(Strict):
    """One split and size of a season."""

    split: Name
    size: Name
    version: Version
    dataset_sha256: Hash
    scenarios: _Count
    metric: Label = Field(description="the metric that ranks")
    reference: Name = Field(description="the best naive predictor in public")
    # None while the random value is not known
    draw_seed: Hash | None = None
    entries: Annotated[
        tuple[FrozenEntry, ...], Field(min_length=1, max_length=1000, strict=False)
    ]

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the blind scenarios."""
        return tuple(range(FIRST_SCENARIO, FIRST_SCENARIO + self.scenarios))


class Season(Strict):
    """The whole file seasons/<name>/season.yaml."""

    format: Literal[1] = 1
    season: Name
    closed: Date
    lagbench: Short
    # source of a public random value, named before the value is known
    source: Line = ""
    value: Line = ""
    # most processor time of a model in a data set, by its stated cost [s]
    budget: Number | None = None
    data_sets: Annotated[
        tuple[SeasonDataSet, ...], Field(min_length=1, max_length=100, strict=False)
    ]

    @property
    def models(self) -> tuple[str, ...]:
        """Identities of all frozen models, ascending."""
        identities = set()
        for data_set in self.data_sets:
            for entry in data_set.entries:
                for model in entry.models:
                    identities.add(model.identity)
        return tuple(sorted(identities))

    @property
    def is_waiting(self) -> bool:
        """Whether the random value is still to come."""
        return bool(self.source) and not self.value


def draw_seed(
    season: str,
    split: str,
    size: str,
    version: str,
    *,
    models: Sequence[str],
    value: str = "",
) -> str:
    """Return the seed of the blind scenarios of a data set [64 hex digits].

    It is the SHA-256 of these lines, each with a line break at its end.

    Args:
        season: name of the season.
        split: name of the split.
        size: name of the size.
        version: version of the data set.
        models: SHA-256 of all frozen models of the season, each with its options if it
            has any.
        value: the public random value; empty without one.
    """
    lines = [
        "lagbench season 1",
        f"season {season}",
        f"split {split}",
        f"size {size}",
        f"version {version}",
    ]
    for model in sorted(set(models)):
        lines.append(f"model {model}")
    lines.append(f"value {value}")
    text = "".join(f"{line}\n" for line in lines)
    return hashlib.sha256(text.encode()).hexdigest()


def season_path(name: str, file: str = SEASON_FILE) -> Path:
    """Return the path of a file of a season, relative to the leaderboard's folder."""
    return Path(SEASONS, name, file)


def season_root(name: str, root: str | Path | None = None) -> Path:
    """Return the folder of a season's blind data, below the folder of all data sets.

    No split can have its name, because of the dot.
    """
    return resolve_root(root) / f"{SEASON_PREFIX}{name}"


def read_season(folder: Folder, name: str) -> Season:
    """Return a closed season.

    Raises:
        UsageError: there is no such season.
        UnreadableFileError: its file cannot be read.
        ChecksFailedError: the file does not fit, or its seeds are not those that follow
            from the frozen models.
    """
    path = season_path(name)
    file = folder.path / path
    if folder.link_in(path) is not None or not file.is_file():
        known = [one.parts[1] for one in folder.season_files() if one.name == path.name]
        raise UsageError(
            "no such season",
            where=str(folder.path),
            expected=", ".join(known) or "a season that is closed",
            got=ascii(name),
            fix=suggest_name(name, known)
            if known
            else "begin one: lagbench season close NAME --size mini",
        )
    fix = "restore the file that `lagbench season close` wrote"
    content = load_plain(file, longest=MOST_SEASON_BYTES, fix=fix)
    season, issues = examine(Season, content)
    if season is None:
        raise ChecksFailedError(
            "the file of a season does not fit",
            where=str(file),
            expected="the layout of season.yaml",
            got=format_issues(issues),
            fix=fix,
        )
    for data_set in season.data_sets:
        _check_measures(data_set, file)
    _check_seeds(season, file, name)
    return season


def _check_measures(data_set: SeasonDataSet, file: Path) -> None:
    """Refuse a metric that does not rank, and a reference that is not naive.

    Raises:
        ChecksFailedError: one of them is not what closing a season writes.
    """
    ranking_metrics = sorted(RANKING.values())
    with suppress(UsageError):
        # the split is known: only its own metric ranks
        size = load().size(data_set.split, data_set.size)
        if is_same_data(data_set, size):
            ranking_metrics = [ranking_metric(size)]
    place = f"{file}, {data_set.split} {data_set.size}"
    for key, value, known in (
        ("metric", data_set.metric, ranking_metrics),
        ("reference", data_set.reference, sorted(NAIVE)),
    ):
        if value not in known:
            raise ChecksFailedError(
                f"the {key} of a season is not one that `lagbench season close` writes",
                where=f"{place}, key {key}",
                expected=" or ".join(known),
                got=ascii(value),
                fix="restore the file that `lagbench season close` wrote",
            )


def _check_seeds(season: Season, file: Path, name: str) -> None:
    """Refuse a season of another name, or with seeds that do not follow from its
    frozen models.
    """
    if season.season != name:
        raise ChecksFailedError(
            "the file is of another season",
            where=f"{file}, key season",
            expected=name,
            got=season.season,
            fix="restore the file that `lagbench season close` wrote",
        )
    right_seeds = []
    wrong_seeds = []
    for data_set, seeded in zip(
        season.data_sets, with_seeds(season).data_sets, strict=True
    ):
        if data_set.draw_seed == seeded.draw_seed:
            continue
        place = f"{data_set.split} {data_set.size}"
        right_seeds.append(f"{place}: {seeded.draw_seed}")
        wrong_seeds.append(f"{place}: {data_set.draw_seed}")
    if wrong_seeds:
        raise ChecksFailedError(
            "the seeds of a season do not follow from its frozen models",
            where=str(file),
            expected=", ".join(right_seeds),
            got=", ".join(wrong_seeds),
            fix="restore the file that `lagbench season close` wrote",
        )


def with_seeds(season: Season) -> Season:
    """Return a season with the seeds that follow from it."""
    data_sets = []
    for data_set in season.data_sets:
        seed = None
        if not season.is_waiting:
            seed = draw_seed(
                season.season,
                data_set.split,
                data_set.size,
                data_set.version,
                models=season.models,
                value=season.value,
            )
        data_sets.append(data_set.model_copy(update={"draw_seed": seed}))
    return season.model_copy(update={"data_sets": tuple(data_sets)})


def write_season(folder: Folder, season: Season) -> Path:
    """Write the file of a season; return its path."""
    path = folder.path / season_path(season.season)
    folder.require_unlinked([season_path(season.season)])
    values = season.model_dump(mode="python", exclude_defaults=True)
    write_atomically(path, yaml_bytes({"format": 1} | values), option="--board")
    return path


def close(
    board: str | Path,
    name: str,
    *,
    split: str | None = None,
    size: str | None = None,
    scenarios: int = SCENARIOS,
    budget: float | None = None,
    source: str = "",
    root: str | Path | None = None,
    registry: Registry | None = None,
    lagbench: str,
) -> Season:
    """Close a season: freeze the active entries that have models, and form the seeds.

    Args:
        board: the leaderboard's folder.
        name: name of the season.
        split: only entries of this split.
        size: only entries of this size.
        scenarios: blind scenarios of each data set.
        budget: most processor time of a model in a data set, by the cost that its entry
            states [s]. A model that costs more predicts fewer scenarios.
        source: source of a public random value that is not known yet, in words.
        root: folder of all data sets.
        registry: where splits are described; ours when None.
        lagbench: version of the package.

    Raises:
        UsageError: the season is closed already, no entry has a model, or an option is
            out of range.
        ChecksFailedError: a model is not the one that its entry names.
    """
    folder = Folder(board)
    folder.require()
    _check_options(name, scenarios=scenarios, source=source, budget=budget)
    rooted_registry = load_rooted_registry(resolve_root(root), registry)
    with board_lock(folder):
        _require_open(folder, name)
        chosen = choose_entries(folder, (), rooted_registry, split=split, size=size)
        groups: dict[tuple[str, str], list[Entry]] = {}
        for entry in chosen:
            groups.setdefault((entry.split, entry.size), []).append(entry)
        data_sets = []
        for place in sorted(groups):
            tier = rooted_registry.size(*place)
            data_sets.append(
                _freeze(folder, tier, groups[place], scenarios=scenarios, budget=budget)
            )
        if not data_sets:
            raise UsageError(
                "no entry has a model to freeze",
                where=str(folder.path),
                expected="entries with models",
                got="predictions only, or other splits and sizes",
                fix="lagbench submit --weights puts models beside entries",
            )
        content = {
            "season": name,
            "closed": today(),
            "lagbench": lagbench,
            "source": source,
            "budget": budget,
            "data_sets": tuple(data_sets),
        }
        season, issues = examine(Season, content)
        if season is None:
            raise UsageError(
                "the options of the season do not fit",
                where="NAME or --source",
                expected="letters, digits and single hyphens; a source in one line",
                got=format_issues(issues),
                fix="correct the option",
            )
        season = with_seeds(season)
        write_season(folder, season)
    return season


def _check_options(
    name: str, *, scenarios: int, source: str, budget: float | None
) -> None:
    """Refuse options that a file of a season cannot hold, before models are hashed.

    Raises:
        UsageError: one of them does not fit.
    """
    if not FEWEST_BLIND_SCENARIOS <= scenarios <= MOST_SCENARIOS:
        raise UsageError(
            "this number of blind scenarios is not possible",
            where="--scenarios",
            expected=f"{FEWEST_BLIND_SCENARIOS} to {MOST_SCENARIOS}",
            got=scenarios,
            fix=f"give a number from {FEWEST_BLIND_SCENARIOS} to {MOST_SCENARIOS}",
        )
    name_rule = "small letters, digits and single hyphens, as in spring-2027"
    _check_option(Name, name, where="NAME", expected=name_rule)
    source_rule = "one line of printable text, of at most 200 characters"
    _check_option(Line, source, where="--source", expected=source_rule)
    if budget is not None:
        budget_rule = "a number of seconds above 0"
        kind = Annotated[Number, Field(gt=0.0)]
        _check_option(kind, budget, where="--budget", expected=budget_rule)


def _check_option(
    kind: Any,  # noqa: ANN401 (an annotated type)
    value: object,
    *,
    where: str,
    expected: str,
) -> None:
    try:
        TypeAdapter(kind).validate_python(value)
    except ValidationError:
        raise UsageError(
            "an option of the season does not fit",
            where=where,
            expected=expected,
            got=ascii(value)[:80],
            fix=f"give another {where}",
        ) from None


def _require_open(folder: Folder, name: str) -> None:
    if (folder.path / season_path(name)).exists():
        raise UsageError(
            "the season is closed already, and its models stay frozen",
            where=str(folder.path / season_path(name)),
            expected="a season that is not closed",
            got="one with frozen models",
            fix="choose another name; with --value, give the random value that it "
            "waits for",
        )


def _freeze(
    folder: Folder,
    size: Size,
    entries: Sequence[Entry],
    *,
    scenarios: int,
    budget: float | None,
) -> SeasonDataSet:
    """Return a data set of a season with the models of its entries."""
    if max(size.scenarios) >= FIRST_SCENARIO:
        raise UsageError(
            "the data set uses ids that are reserved for blind scenarios",
            where=f"{size.split} {size.name}",
            expected=f"ids below {FIRST_SCENARIO}",
            got=max(size.scenarios),
            fix="leave it out: --split, --size",
        )
    metric = ranking_metric(size)
    naive_scores = {}
    for name, reference in (shipped(size) or {}).items():
        if name in NAIVE and metric in reference.scores:
            naive_scores[name] = reference.scores[metric]
    best = best_reference(naive_scores)
    if best is None or size.measured is None:
        raise UsageError(
            "no naive predictor was measured on the data set",
            where=f"{size.split} {size.name}",
            expected="measured scores of a naive predictor",
            got="none",
            fix="leave it out: --split, --size; or measure: python -m "
            "lagbench.scoring.measure_references",
        )
    frozen = []
    for entry in entries:
        frozen.append(
            FrozenEntry(
                method=entry.method,
                scenarios=_count_scenarios(entry, size, scenarios, budget),
                models=_frozen_models(folder, entry),
            )
        )
    return SeasonDataSet(
        split=size.split,
        size=size.name,
        version=size.version,
        dataset_sha256=size.measured.dataset_sha256,
        scenarios=scenarios,
        metric=metric,
        reference=best,
        entries=tuple(frozen),
    )


def _count_scenarios(
    entry: Entry, size: Size, scenario_count: int, seconds_per_model: float | None
) -> int:
    """Return how many blind scenarios the models of an entry predict.

    As many as the budget of a model [s] allows, FEWEST_BLIND_SCENARIOS at least; all
    without a budget or a stated cost.
    """
    if seconds_per_model is None or entry.cost is None:
        return scenario_count
    seconds_per_scenario = entry.cost.seconds_per_frame * size.task.horizon
    affordable_count = seconds_per_model / seconds_per_scenario  # may be infinite
    count = int(min(scenario_count, affordable_count))
    return max(count, FEWEST_BLIND_SCENARIOS)


def _frozen_models(folder: Folder, entry: Entry) -> tuple[FrozenModel, ...]:
    models = []
    for prediction in entry.predictions:
        weights = prediction.weights
        if weights is None:
            continue
        require_unchanged_model(folder, weights)
        model = FrozenModel(
            seed=prediction.seed,
            sha256=weights.sha256,
            options=entry.settings_of(prediction),
        )
        models.append(model)
    return tuple(models)


def reveal(board: str | Path, name: str, value: str) -> Season:
    """Give a closed season the random value that it waits for; return it with seeds.

    Raises:
        UsageError: there is no such season, it waits for no value, or the value is
            empty or cannot be printed.
    """
    folder = Folder(board)
    folder.require()
    with board_lock(folder):
        season = read_season(folder, name)
        if not season.is_waiting:
            expected = "a season that was closed with --source"
            got = "no source"
            if season.value:
                expected = "a season that has no random value yet"
                got = f"the value {season.value!a}, which cannot be changed"
            run = f"lagbench season run {name}{board_option(folder.path)}"
            raise UsageError(
                "the season waits for no random value",
                where=str(folder.path / season_path(name)),
                expected=expected,
                got=got,
                fix=f"leave --value out: {run} scores the models",
            )
        revealed, issues = examine(Season, season.model_dump() | {"value": value})
        if revealed is None or not value.strip():
            raise UsageError(
                "this cannot be a random value",
                where="--value",
                expected="a text of one line, as the source publishes it",
                got=format_issues(issues) if issues else "an empty text",
                fix="copy it from the source once more",
            )
        revealed = with_seeds(revealed)
        write_season(folder, revealed)
    return revealed


def season_registry(
    season: Season, registry: Registry, recorded: Recorded, *, board: Path
) -> Registry:
    """Return a registry in which the data sets of a season hold blind scenarios only.

    Args:
        season: a season with seeds.
        registry: where splits are described.
        recorded: content hashes of blind scenarios that are known already.
        board: folder of the season's leaderboard.

    Raises:
        UsageError: the season still waits for its random value.
        ChecksFailedError: a data set has another version by now.
    """
    splits: dict[str, Split] = {}
    measured: dict[str, dict[str, Measured]] = {}
    for data_set in season.data_sets:
        size = blind_size(season, data_set, registry, recorded, board=board)
        split = splits.get(data_set.split, registry.split(data_set.split))
        entry = split.sizes[data_set.size].model_copy(
            update={
                "subsets": size.subsets,
                "frames": size.frames,
                "particle_counts": size.particle_counts,
                "draw_seed": size.draw_seed,
            }
        )
        sizes = {**split.sizes, data_set.size: entry}
        splits[data_set.split] = split.model_copy(update={"sizes": sizes})
        # without recorded hashes there is nothing to compare with
        if size.measured is not None and size.measured.scenario_sha256:
            measured.setdefault(data_set.split, {})[data_set.size] = size.measured
    return Registry(splits, measured, registry.files)


def blind_size(
    season: Season,
    data_set: SeasonDataSet,
    registry: Registry,
    recorded: Recorded,
    *,
    board: Path,
) -> Size:
    """Return the size whose blind scenarios are scored.

    They are drawn as scenarios of test are, and recorded as long as the task needs.
    Statistics are those of the public train.

    Args:
        season: the season.
        data_set: one of its data sets.
        registry: where splits are described.
        recorded: content hashes of blind scenarios that are known already.
        board: folder of the season's leaderboard.

    Raises:
        UsageError: the season still waits for its random value.
        ChecksFailedError: the data set has another version by now.
    """
    if data_set.draw_seed is None:
        raise UsageError(
            "the season still waits for its random value",
            where=f"season {season.season}",
            expected=season.source,
            got="no value yet",
            fix=f"lagbench season close {season.season}{board_option(board)} "
            "--value VALUE",
        )
    public = registry.size(data_set.split, data_set.size)
    if public.measured is None or not is_same_data(data_set, public):
        raise ChecksFailedError(
            "the season was closed for another version of the data",
            where=f"{data_set.split} {data_set.size}",
            expected=f"{data_set.version}, {data_set.dataset_sha256[:16]}",
            got=public.version,
            fix=f"use lagbench {season.lagbench}, which closed it",
        )
    hashes = recorded.get((data_set.split, data_set.size), {})
    first_digits = {}
    for scenario, sha256 in hashes.items():
        first_digits[scenario] = sha256[:RECORDED_DIGITS]
    subset_hashes = {}
    if hashes:
        subset_hashes[BLIND] = subset_hash(hashes)
    measured = public.measured.model_copy(
        update={
            "scenario_sha256": first_digits,
            "subset_sha256": subset_hashes,
            "twin_floor": (),
        }
    )
    return public.model_copy(
        update={
            "subsets": {BLIND: data_set.ids},
            "frames": public.task.input_frames + public.task.horizon,
            "particle_counts": {},
            "scored_subset": BLIND,
            "draw_seed": data_set.draw_seed,
            "measured": measured,
        }
    )


def is_same_data(data_set: SeasonDataSet, size: Size) -> bool:
    """Tell whether a size still is the data set that a season was closed for."""
    if size.measured is None or size.version != data_set.version:
        return False
    return size.measured.dataset_sha256 == data_set.dataset_sha256
