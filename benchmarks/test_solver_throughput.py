"""Our solver against the conventional Taichi formulation, per core, in one run.

Taichi starts once per process, with fast math or without, so each side runs in a
process of its own, pinned to its cores; rounds alternate, and the best of each side
counts. The conventional code runs on one core and, as Taichi would by itself, on two;
our solver uses cores by running scenarios side by side, so its rate per core is that of
one. Rates depend on the machine, whose model is printed; asserted is only a ratio, of
processor time on one core, which other work disturbs least.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from timing import best_seconds, measured_apart

from lagbench.baselines.machine import hardware

TARGET_RATIO = 4.0
"""Ratio on an EPYC server; printed only."""

LEAST_RATIO = 2.0
"""What must hold on other processors too, and beside other work."""

ROUNDS = 3
SUBSTEPS = {"whole_frame.py": 2000, "conventional.py": 500}

CORES = sorted(os.sched_getaffinity(0))


def measure(script: str, cores: int) -> dict[str, Any]:
    """Run a script on the first cores that this process may use and return what it
    prints.
    """
    options = [f"--substeps={SUBSTEPS[script]}", "--repeats=2"]
    if script == "conventional.py":
        options.append(f"--threads={cores}")
    path = str(Path(__file__).with_name(script))
    rates: dict[str, Any] = measured_apart(path, *options, cores=CORES[:cores])
    return rates


def test_throughput_per_core(benchmark: BenchmarkFixture) -> None:
    """On one core, at least twice as fast as the conventional code by processor
    time.
    """
    sides = {"ours, 1 core": ("whole_frame.py", 1)}
    for count in (1, 2):
        if count <= len(CORES):
            sides[f"conventional, {count} core(s)"] = ("conventional.py", count)
    best = {}
    for name in sides:
        best[name] = {"per_core": 0.0, "per_processor_second": 0.0}

    def one_round() -> None:
        for name, (script, cores) in sides.items():
            rates = measure(script, cores)
            best_rates = best[name]
            for key, rate in best_rates.items():
                best_rates[key] = max(rate, rates[key])

    best_seconds(benchmark, one_round, rounds=ROUNDS)
    ours = best["ours, 1 core"]
    print(f"\n{hardware()['processor']}; M particle-substeps/s")
    for name, rates in best.items():
        core = rates["per_core"]
        second = rates["per_processor_second"]
        print(
            f"{name}: {core / 1e6:.2f} per core (ours "
            f"{ours['per_core'] / core:.1f}x), by processor "
            f"time {second / 1e6:.2f} (ours "
            f"{ours['per_processor_second'] / second:.1f}x)"
        )
    conventional = best["conventional, 1 core(s)"]
    ratio = ours["per_processor_second"] / conventional["per_processor_second"]
    print(f"ratio {ratio:.1f} (target {TARGET_RATIO}, at least {LEAST_RATIO})")
    benchmark.extra_info.update(
        sides=best, ratio=ratio, machine=hardware()["processor"]
    )
    assert ratio >= LEAST_RATIO


def test_both_formulations_simulate_the_same_flow() -> None:
    """After 1001 substeps their kinetic energies agree to 1e-3: the yardstick does the
    same work.
    """
    energies = []
    for script in SUBSTEPS:
        path = str(Path(__file__).with_name(script))
        result = measured_apart(path, "--substeps=1000", "--repeats=1")
        energies.append(result["energy"])
    ours, conventional = energies
    assert ours == pytest.approx(conventional, rel=1e-3)
