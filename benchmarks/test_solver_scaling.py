"""Solver time over the quality factor q: fixed substeps, and the schedule of Table 3.1.

q = 1 to 4 on one CPU core; ``LAGBENCH_BENCH_DEVICE=cuda`` runs q = 1 to 9 on an NVIDIA
GPU.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import table_3_1
from pytest_benchmark.fixture import BenchmarkFixture
from timing import best_seconds

from lagbench.generators.split import Device

DEVICE = Device(os.environ.get("LAGBENCH_BENCH_DEVICE", "cpu"))
LAST = 9 if DEVICE is Device.CUDA else 4
ROWS = table_3_1.THESIS[:LAST]
REPEATS = 3

GOAL = 1.05
"""Exponent of a substep's time against particles; printed only."""

MOST_EXPONENT = 1.5
"""Greatest exponent.

A large grid leaves the caches of a processor: the exponent is 1.09 on an EPYC server.
Where a busy machine doubles the time of one row, it is 0.25 more.
"""


@pytest.fixture(scope="module")
def timed_rows() -> list[table_3_1.TimedRow]:
    """Collect the measurements of all rows."""
    return []


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"q{row.q}")
def test_row(
    benchmark: BenchmarkFixture,
    row: table_3_1.ThesisRow,
    timed_rows: list[table_3_1.TimedRow],
) -> None:
    """Time frames of the row's own substeps, and substeps in runs of 20."""

    def one_round() -> None:
        timed_row = table_3_1.measure(row, device=DEVICE, repeats=REPEATS)
        timed_rows.append(timed_row)

    best_seconds(benchmark, one_round, rounds=1)
    measured = timed_rows[-1]
    substep_ns = 1e6 * measured.substep_ms
    benchmark.extra_info.update(
        particles=row.particles,
        substep_ms=measured.substep_ms,
        frame_ms=measured.frame_ms,
        nanoseconds_per_particle_substep=substep_ns / row.particles,
        thesis_over_ours=row.frame_ms / measured.frame_ms,
    )


def test_exponents(timed_rows: list[table_3_1.TimedRow], tmp_path: Path) -> None:
    """A substep's time grows with the particles, and far less than their square."""
    if len(timed_rows) < 2:
        pytest.skip("needs the rows of this module in the same run")
    table = table_3_1.markdown(timed_rows, DEVICE.value, repeats=REPEATS)
    print(f"\n{table}")
    figure = tmp_path / "figure_3_1.png"
    table_3_1.draw(timed_rows, DEVICE.value, figure)
    print(f"Fig. 3.1: {figure}")
    exponents = table_3_1.exponents_of_measurements(timed_rows)
    exponent = exponents.substep_particles
    print(f"exponent of a substep: {exponent:.2f} (goal {GOAL}, limit {MOST_EXPONENT})")
    assert exponent <= MOST_EXPONENT


def test_the_thesis_exponents_follow_from_its_table() -> None:
    """Compare with the exponents in the text of the thesis.

    They are 1.41 (t/frame against q^2), 1.35 (t/frame against particles) and 0.83
    (t/substep against particles).
    """
    thesis = table_3_1.exponents_of_thesis()
    assert thesis.frame_q2 == pytest.approx(1.41, abs=0.01)
    assert thesis.frame_particles == pytest.approx(1.35, abs=0.01)
    assert thesis.substep_particles == pytest.approx(0.83, abs=0.01)
