"""What can be refused before the work: keys that are missing, files that do not belong together."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.floors import FLOORS
from lagbench.submission import Header, ValidationResult, open_predictions, validate

from .entry import ID, LONGEST_ID, MOST_SEEDS, About, CostEntry
from .folder import Folder, entry_path
from .meta import Meta

__all__ = ["Draft", "check_needed", "draft_of", "headers_of"]

NEEDED = {"authors": "--author NAME", "command": "--command 'what makes the predictions again'"}
"""Keys without a default, and the options that give them."""


@dataclass(frozen=True, kw_only=True)
class Draft:
    """An entry before it is scored."""

    place: tuple[str, str, str]  # split, size and method
    about: About  # what is said of the method; name and date are there
    seeds: tuple[int | None, ...]  # seed of each file, None where it has none
    urls: tuple[str | None, ...]  # address of each file, None where it has none
    scored_by: str  # who runs the scorer


def headers_of(
    paths: Sequence[Path],
    *,
    root: str | Path | None,
    registry: Registry | None,
    examined: Callable[[ValidationResult], None] | None,
) -> list[Header]:
    """Return what files say about themselves, each validated in a child process before it is opened."""
    headers = []
    for path in paths:
        result = validate(path, root=root, require_truth=True, registry=registry)
        if examined is not None:
            examined(result)
        result.check()
        with open_predictions(path) as opened:
            headers.append(opened.header)
    return headers


def check_needed(meta: Meta) -> None:
    """Refuse a description that lacks what readers need."""
    missing = [option for key, option in NEEDED.items() if not getattr(meta, key)]
    if missing:
        raise UsageError(
            "the entry lacks what readers need",
            expected=" and ".join(missing),
            fix="give them as options, or authors and command in a file: --from meta.yaml",
        )


def draft_of(headers: Sequence[Header], meta: Meta, folder: Folder, *, replace: bool) -> Draft:
    """Return the entry as far as it is known before the scoring."""
    seeds, urls = _seeds(headers), _urls(headers, meta)
    place = (headers[0].split, headers[0].size, _method(headers[0], meta))
    path = folder.path / entry_path(place)
    if path.exists() and not replace:
        fix = "replace it with --replace, or name this one otherwise: --method NAME"
        raise UsageError("there is such an entry already", where=str(path), fix=fix)
    return Draft(
        place=place,
        about=_about(headers, meta),
        seeds=seeds,
        urls=urls,
        scored_by=meta.scored_by or meta.authors[0],
    )


def _seeds(headers: Sequence[Header]) -> tuple[int | None, ...]:
    """Return the seeds of files that belong together; refuse those that do not."""
    if not 1 <= len(headers) <= MOST_SEEDS:
        raise UsageError("too many files", expected=f"1 to {MOST_SEEDS}, one per seed", got=len(headers))
    for name in ("split", "size", "dataset_sha256"):
        found = dict.fromkeys(getattr(header, name) for header in headers)
        if len(found) > 1:
            fix = "submit each on its own"
            raise UsageError(f"the files differ in {name}", got=", ".join(found), fix=fix)
    seeds = tuple(header.seed for header in headers)
    if any(seed is not None and not 0 <= seed < 2**63 for seed in seeds):
        raise UsageError("a seed does not fit", expected="0 to 2^63 - 1", got=seeds)
    if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
        raise UsageError(
            "several files need seeds that differ",
            got=", ".join("none" if seed is None else str(seed) for seed in seeds),
            fix="write them with submission.write(..., seed=0), seed=1 and so on",
        )
    return seeds


def _urls(headers: Sequence[Header], meta: Meta) -> tuple[str | None, ...]:
    if meta.urls and len(meta.urls) != len(headers):
        raise UsageError(
            "addresses and files differ in number",
            where="--url",
            expected=len(headers),
            got=len(meta.urls),
            fix="give one address per file, in their order, or none",
        )
    return meta.urls or (None,) * len(headers)


def _method(header: Header, meta: Meta) -> str:
    """Return the id of the method: the one given, else the label of the predictions if it can be one."""
    name = meta.method or header.method
    if not re.fullmatch(ID, name) or len(name) > LONGEST_ID:
        raise UsageError(
            "the label of the predictions cannot name an entry",
            expected="small letters, digits and single hyphens",
            got=ascii(name),
            fix="name it: --method my-model",
        )
    if name in FLOORS:
        raise UsageError(
            f"{name!r} is the name of a floor",
            where="--method",
            fix="name your method otherwise; `lagbench submit --floor` writes the floors",
        )
    return name


def _about(headers: Sequence[Header], meta: Meta) -> About:
    """Return what is said of the method, with what the predictions say where nothing is."""
    first = headers[0]
    held = {name: getattr(meta, name) for name in About.model_fields}
    held["name"] = meta.name or first.method[:100]
    held["date"] = meta.date or datetime.datetime.now(datetime.UTC).date()
    held["training"] = meta.training or (first.training or "")[:1000]
    if meta.parameters is None:
        held["parameters"] = first.parameters
    held["cost"] = meta.cost or _cost(headers, meta)
    return About(**held)


def _cost(headers: Sequence[Header], meta: Meta) -> CostEntry | None:
    """Return the mean cost over the files; None unless all tell it and one machine."""
    times = [header.seconds_per_frame for header in headers if header.seconds_per_frame is not None]
    device = headers[0].device
    if len(times) < len(headers) or not device or any(header.device != device for header in headers):
        return None
    return CostEntry(
        seconds_per_frame=float(f"{sum(times) / len(times):.6g}"),
        device=device[:100],
        solver_seconds_per_frame=meta.solver_seconds_per_frame,
    )
