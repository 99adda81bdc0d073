"""The mass of a particle that a scenario file states."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from lagbench.baselines.rollout import scenario_batch, scenario_paths
from lagbench.errors import DataError
from lagbench.make.generate import GenerationResult


@pytest.mark.parametrize("mass", [np.ones(2), np.nan, 0.0, -1.0])
def test_a_mass_that_is_no_number_above_0_is_refused(
    mass: object, tmp_path: Path, tiny_split: Callable[..., GenerationResult]
) -> None:
    """The message names file and variable."""
    root = tiny_split("fluid").root
    (source, *_) = scenario_paths(
        "fluid", subset="train", size="tiny", root=root
    ).values()
    path = tmp_path / source.name
    shutil.copy(source, path)
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        attributes = dict(file["particle_mass"].attrs)
        del file["particle_mass"]
        variable = file.create_dataset("particle_mass", data=mass)
        for name, value in attributes.items():
            if not name.isupper():
                variable.attrs[name] = value
    with pytest.raises(DataError) as caught:
        scenario_batch(path, slice(2))
    assert caught.value.where == f"{path}, variable 'particle_mass'"
