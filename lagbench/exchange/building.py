"""A local split on the way: scenario files one by one, then manifest and description."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.layout import ScenarioKey, scenario_path
from lagbench.data.local import DESCRIPTION
from lagbench.data.manifest import FileEntry, Manifest, describe_file, merge, write_manifest
from lagbench.data.registry import MAX_ID, NO_GENERATOR
from lagbench.data.statistics import file_statistics
from lagbench.data.writer import ScenarioWriter
from lagbench.errors import DataError
from lagbench.work.machine import environment_of

from .description import SIZE, VERSION, Description, rate_of, split_yaml
from .measure import Box, estimate_spacing
from .trajectory import Trajectory

__all__ = ["Building"]

DEVICE = "cpu"
HEAD = '# A local split of lagbench, written by `lagbench {}`; its hashes stand under "measured".\n'


@dataclass
class Building:
    """A local split on the way."""

    about: Description  # what is known of the data
    root: Path  # root folder in which the split's folder is built
    spacing: float = 0.0  # distance of neighbouring particles at first [length]; 0 before the first scenario
    # manifest entries of the scenarios written so far, by id
    entries: list[FileEntry] = field(default_factory=list)
    # least coordinates of any particle [length]
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.inf))
    # greatest coordinates of any particle [length]
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(2, -np.inf))

    def add(self, subset: str, trajectory: Trajectory) -> None:
        """Write the next scenario."""
        scenario = len(self.entries)
        if scenario > MAX_ID:
            raise DataError("too many trajectories", where=trajectory.name, expected=f"at most {MAX_ID + 1}")
        about = self.about
        if not self.spacing:
            first = np.asarray(trajectory.first())
            self._check(trajectory, 0, about.measure.place(first))
            own = about.spacing or estimate_spacing(first, about.radius)
            self.spacing = own / about.measure.scale
        key = ScenarioKey(split=about.name, size=SIZE, version=VERSION, scenario=scenario, subset=subset)
        scale = about.measure.scale
        walls = None if trajectory.wall_velocity is None else np.asarray(trajectory.wall_velocity) / scale
        rate = rate_of(about.frame_interval)
        with ScenarioWriter(
            scenario_path(self.root, key),
            key,
            particles=trajectory.particles,
            frames=trajectory.frames,
            frame_interval=1.0 / rate,
            material=trajectory.material,
            particle_mass=about.density * self.spacing**2,
            wall_velocity=walls,
            parameters={"frame_rate": rate, "density": about.density, **trajectory.parameters},
            seed=NO_GENERATOR,
            device=DEVICE,
            generator=NO_GENERATOR,
            licence=about.licence,
        ) as writer:
            for position, velocity in self._frames(trajectory, rate):
                writer.append(position, velocity)
        self.entries.append(describe_file(self.root, key))

    def _frames(
        self, trajectory: Trajectory, rate: float
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Yield positions and velocities in the unit box; without own velocities, differences.

        Then ``v(f) = (x(f) - x(f-1)) / interval``, and v(0) = v(1).
        """
        before: NDArray[np.float32] | None = None
        first: NDArray[np.float32] | None = None
        for number, (raw, own) in enumerate(trajectory.read()):
            position = self.about.measure.place(raw)
            self._check(trajectory, number, position)
            if own is not None:
                yield position, (own / self.about.measure.scale).astype(np.float32)
            elif before is None:
                first = position
            else:
                velocity = ((position.astype(np.float64) - before) * rate).astype(np.float32)
                if first is not None:
                    yield first, velocity
                    first = None
                yield position, velocity
            before = position

    def _check(self, trajectory: Trajectory, number: int, position: NDArray[np.float32]) -> None:
        """Refuse positions that are no numbers or lie outside the unit box; note their extent."""
        where = f"{trajectory.name}, frame {number}"
        low, high = position.min(axis=0), position.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise DataError("a position is not finite", where=where)
        if (low < 0.0).any() or (high > 1.0).any():
            raise DataError(
                "particles lie outside the unit box",
                where=where,
                expected="[0, 1] x [0, 1]",
                got=" x ".join(f"[{a:.6g}, {b:.6g}]" for a, b in zip(low, high, strict=True)),
                fix="fit the box of the data into the unit box: --rescale, and --bounds if none are stated",
            )
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)

    def box(self) -> Box:
        """Return the stated bounds in the unit box, else the extent of the positions."""
        if self.about.bounds is not None:
            return self.about.measure.box(self.about.bounds)
        (left, bottom), (right, top) = self.low.tolist(), self.high.tolist()
        return (left, right), (bottom, top)

    def finish(self, command: str) -> Manifest:
        """Write manifest and description; return the manifest."""
        about = self.about
        ids = {name: [e.scenario for e in self.entries if e.subset == name] for name in HASHED_SUBSETS}
        folder = self.root / about.name
        train = [self.root / about.name / SIZE / "v1" / e.path for e in self.entries if e.subset == "train"]
        content = {entry.scenario: entry.content_sha256[:16] for entry in self.entries}
        manifest = merge(
            None,
            self.entries,
            split=about.name,
            size=SIZE,
            version=VERSION,
            subsets=ids,
            environment=environment_of(DEVICE),
            recorded=content,
            statistics=file_statistics(train),
        )
        write_manifest(self.root, manifest)
        measured: dict[str, object] = {
            "dataset_sha256": manifest.dataset_sha256,
            "subset_sha256": manifest.subset_sha256,
            "scenario_sha256": content,
            "statistics": {name: list(row) for name, row in manifest.statistics.items()},
            "twin_floor": [],
        }
        text = split_yaml(
            about,
            subsets=ids,
            frames={entry.scenario: entry.frames for entry in self.entries},
            particles=_particles(self.entries),
            spacing=self.spacing,
            bounds=self.box(),
            measured=measured,
        )
        body = yaml.safe_dump(text, sort_keys=False, allow_unicode=True, width=110)
        (folder / DESCRIPTION).write_text(HEAD.format(command) + body, encoding="utf-8")
        return manifest


def _particles(entries: Sequence[FileEntry]) -> int:
    """Return how many particles test scenarios have, where all have as many; else the most of any."""
    test = {entry.particles for entry in entries if entry.subset == "test"}
    return test.pop() if len(test) == 1 else max(entry.particles for entry in entries)
