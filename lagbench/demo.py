"""From nothing to data: generate, verify and draw the splits at size ``tiny``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .generation import GenerationResult, Progress, generate
from .layout import ScenarioKey, resolve_root, scenario_path
from .registry import Registry, Size, load
from .verification import VerificationResult, verify

__all__ = ["DEMO_SIZE", "DemoResult", "demo", "demo_splits"]

DEMO_SIZE = "tiny"


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """One split of the demo: what was generated, how it verified, and its picture.

    Attributes:
        generation: result of :func:`~lagbench.generation.generate`.
        verification: result of :func:`~lagbench.verification.verify`.
        picture: PNG of the first test scenario at its last frame of interest.
    """

    generation: GenerationResult
    verification: VerificationResult
    picture: Path


def demo_splits(registry: Registry) -> list[str]:
    """Return the splits that have a size ``tiny``; those of other packages need not."""
    return [name for name, split in registry.splits.items() if DEMO_SIZE in split.sizes]


def demo(
    split: str,
    *,
    root: str | Path | None = None,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> DemoResult:
    """Generate, verify and draw one split at size ``tiny``.

    Args:
        split: name of the split.
        root: folder of the data and of ``pictures/``; see ``resolve_root``.
        workers: worker processes; one per core when None.
        progress: called as the generation advances.

    Raises:
        LagbenchError: what :func:`~lagbench.generation.generate`,
            :func:`~lagbench.verification.verify` and :func:`~lagbench.plots.plot_frame` raise.
    """
    from .plots import plot_frame

    folder = resolve_root(root)
    size = load().size(split, DEMO_SIZE)
    generation = generate(split, DEMO_SIZE, root=folder, workers=workers, progress=progress)
    verification = verify(split, DEMO_SIZE, root=folder, complete=True)
    verification.check()
    pictures = folder / "pictures"
    pictures.mkdir(exist_ok=True)
    picture = plot_frame(
        _first_test(size, folder), size.task.frames_of_interest[-1], pictures / f"{split}.png"
    )
    return DemoResult(generation=generation, verification=verification, picture=picture)


def _first_test(size: Size, root: Path) -> Path:
    scenario = size.subsets["test"][0]
    key = ScenarioKey(
        split=size.split, size=size.name, version=size.version, scenario=scenario, subset="test"
    )
    return scenario_path(root, key)
