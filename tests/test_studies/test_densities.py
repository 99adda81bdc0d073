"""Densities of true states: their mean, and all pairs of particles counted directly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lagbench.baselines.rollout import scenario_paths
from lagbench.data.registry import load
from lagbench.make.generate import GenerationResult
from studies.densities import main, relative_densities, to_line


def test_densities_are_those_of_a_tree(
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """Distances by SciPy, with the nearest images along both axes."""
    root = tiny_split("poiseuille").root
    size = load().size("poiseuille", "tiny")
    paths = scenario_paths("poiseuille", subset="train", size="tiny", root=root)
    path = next(iter(paths.values()))
    every = 20
    densities = relative_densities(size, [path], every=every)

    support = 2.0 * size.task.radius
    with h5py.File(path) as file:
        positions = file["position"][:].astype(np.float64)
    last_given = positions[size.task.input_frames - 1]
    expected = []
    for position in (last_given, *positions[::every]):
        tree = cKDTree(position % 1.0, boxsize=1.0)
        pairs = tree.sparse_distance_matrix(tree, support).tocoo()
        kernel = (1.0 - (pairs.data / support) ** 2) ** 3
        density = np.bincount(pairs.row, kernel, len(position))
        if not (pairs.row == pairs.col).any():  # SciPy may leave out zeros
            density = density + 1.0
        expected.append(density)
    mean = expected[0].mean()
    relative = np.concatenate(expected[1:]) / mean
    np.testing.assert_allclose(densities, relative, rtol=2e-4)


def test_a_line_has_quantiles_and_the_largest() -> None:
    densities = np.linspace(0.0, 10.0, 1001).astype(np.float32)
    assert to_line("ramp", densities) == "| ramp | 5.00 | 9.90 | 9.99 | 10.00 | 10.00 |"


def test_missing_data_and_bad_numbers_end_without_a_table(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["--root", str(tmp_path), "--split", "cavity"]) != 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "fix:" in captured.err
    with pytest.raises(SystemExit):
        main(["--root", str(tmp_path), "--every", "0"])
