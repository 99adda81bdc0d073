"""Arrays that mean something else than they say are refused by name; odd but honest
ones are adopted.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import Result

from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.exchange import adopt
from lagbench.exchange.mistakes import check_meaning
from lagbench.make.generate import GenerationResult

Array = NDArray[Any]
SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")


@pytest.fixture(scope="module", params=SPLITS)
def ours(
    request: pytest.FixtureRequest, tiny_split: Callable[..., GenerationResult]
) -> list[Any]:
    """The scenarios of a split: positions, the solver's velocities, the time between
    frames.
    """
    return scenarios(tiny_split(request.param))


def scenarios(made: GenerationResult) -> list[Any]:
    """Return positions, velocities and the time between frames of each scenario."""
    found = []
    for path in sorted(made.folder.rglob("*.nc")):
        with read_scenario(path) as file:
            time = file.read("time")
            found.append(
                (file.read("position"), file.read("velocity"), float(time[1] - time[0]))
            )
    assert found
    return found


def said(position: Array, velocity: Array | None, interval: float) -> str:
    """Return what a trajectory is refused for; nothing where it is accepted."""
    try:
        check_meaning("runs.npy", position, velocity, interval)
    except DataError as error:
        return error.what
    return ""


def differences(position: Array, interval: float) -> Array:
    """Return velocities as differences to the frame before."""
    steps = np.diff(position.astype(np.float64), axis=0) / interval
    return np.concatenate([steps[:1], steps])


def test_our_own_data_pass(ours: list[Any]) -> None:
    """As they are; with differences to the frame before, after, or both; without
    velocities; at rest.
    """
    for position, velocity, interval in ours:
        backward = differences(position, interval)
        forward = np.concatenate([backward[1:], backward[-1:]])
        for own in (velocity, None, backward, forward, (backward + forward) / 2):
            assert said(position, own, interval) == ""
        rest = np.repeat(position[:1], len(position), axis=0)
        for own in (None, np.zeros_like(rest), velocity):
            assert said(rest, own, interval) == ""


def test_transposed_axes_are_named(ours: list[Any]) -> None:
    """Particles first, with and without velocities, also when all particles rest."""
    for position, velocity, interval in ours:
        turned = position.swapaxes(0, 1)
        words = "(particles, frames, 2) where (frames, particles, 2)"
        assert words in said(turned, None, interval)
        assert words in said(turned, velocity.swapaxes(0, 1), interval)
        assert words in said(np.repeat(turned[:, :1], 8, axis=1), None, interval)


def test_swapped_components_are_named(ours: list[Any]) -> None:
    """X and y of the solver's velocities, and of differences, in length/s and per
    frame.
    """
    for position, velocity, interval in ours:
        for own in (
            velocity,
            differences(position, interval),
            differences(position, 1.0),
        ):
            assert "x and y of the velocity are swapped" in said(
                position, own[..., ::-1], interval
            )
        assert said(position[..., ::-1], velocity[..., ::-1], interval) == ""


def test_other_units_are_named(ours: list[Any]) -> None:
    """Displacements per frame, a constant factor, of which the fix names the interval,
    or turned round.
    """
    for position, _, interval in ours[:2]:
        assert "per frame" in said(position, differences(position, 1.0), interval)
        for factor, word in ((3, "3 times"), (-1, "backwards"), (-3, "backwards")):
            with pytest.raises(DataError, match=word) as caught:
                check_meaning(
                    "runs.npy",
                    position,
                    factor * differences(position, interval),
                    interval,
                )
            named = (
                f"--frame-interval {interval / 3:.3g}"
                if factor > 0
                else "--frame-interval"
            )
            assert (named in str(caught.value.fix)) == (factor > 0)


@pytest.mark.parametrize("split", ["fluid", "multimaterial"])
def test_shifted_velocities_are_named(
    split: str, tiny_split: Callable[..., GenerationResult]
) -> None:
    """By one frame, late and early, in most scenarios whose velocities are those of the
    motion.

    In our closed boxes the particles' own velocities lag behind their motion by some of
    a frame.
    """
    found = scenarios(tiny_split(split))
    named = {"late": 0, "early": 0}
    for position, velocity, interval in found:
        for shift, word in ((1, "late"), (-1, "early")):
            what = said(position, np.roll(velocity, shift, axis=0), interval)
            assert what in ("", f"velocities are one frame {word}")
            named[word] += bool(what)
    assert min(named.values()) >= 0.8 * len(found)


def test_shifted_differences_are_named(ours: list[Any]) -> None:
    """Differences that came one frame late fit nothing; swapped and per frame too, all
    is named.
    """
    for position, _, interval in ours:
        late = np.roll(differences(position, interval), 1, axis=0)
        assert said(position, late, interval) == "velocities are one frame late"
    position, _, interval = ours[0]
    what = said(
        position, np.roll(differences(position, 1.0), 1, axis=0)[..., ::-1], interval
    )
    assert [word in what for word in ("swapped", "per frame", "late")] == [True] * 3


ODD: dict[str, Callable[[np.random.Generator], tuple[Array, Array]]] = {
    "random places": lambda rng: (
        rng.random((20, 300, 2)),
        rng.normal(size=(20, 300, 2)),
    ),
    "random walk": lambda rng: (
        rng.random((300, 2)) + np.cumsum(rng.normal(size=(20, 300, 2)), axis=0) / 50,
        rng.normal(size=(20, 300, 2)),
    ),
    "noise at rest": lambda rng: (
        rng.random((300, 2)) + 1e-4 * rng.normal(size=(20, 300, 2)),
        1e-3 * rng.normal(size=(20, 300, 2)),
    ),
    "jitter about a filament": lambda rng: (
        np.linspace((0, 0), (1, 1), 300) + 1e-4 * rng.normal(size=(20, 300, 2)),
        rng.normal(size=(20, 300, 2)),
    ),
    "straight flight, meaningless velocities": lambda rng: (
        rng.random((300, 2))
        + 0.01 * np.arange(20)[:, None, None] * rng.normal(size=(300, 2)),
        rng.normal(size=(20, 300, 2)),
    ),
    "fall as one block": lambda rng: (
        rng.random((300, 2)) * 0.1
        + 0.02 * np.arange(20)[:, None, None] * np.array([1, 1]),
        np.full((20, 300, 2), 0.2),
    ),
    "flight along the diagonal, exactly": lambda rng: _diagonal(rng, 1.0),
    "flight along the other diagonal, exactly": lambda rng: _diagonal(rng, -1.0),
    "wheel that turns by half a radian per frame": lambda rng: _wheel(
        rng.random(300), 0.5
    ),
    "wheel that turns nearly round per frame": lambda rng: _wheel(rng.random(300), 2.5),
    "filament that turns": lambda rng: _wheel(np.zeros(300), 0.3),
    "filament that turns by much": lambda rng: _wheel(np.zeros(300), 0.7),
    "one particle": lambda rng: (rng.random((20, 1, 2)), rng.normal(size=(20, 1, 2))),
    "three frames": lambda rng: (rng.random((3, 300, 2)), rng.normal(size=(3, 300, 2))),
    "not finite": lambda rng: (
        np.full((20, 300, 2), np.nan),
        np.full((20, 300, 2), np.inf),
    ),
}


def _diagonal(rng: np.random.Generator, side: float) -> tuple[Array, Array]:
    """Return particles that fly together, all numbers powers of two apart: nothing is
    rounded.
    """
    velocity = np.array([1.0, side]) / 8
    place = (
        rng.integers(0, 64, (300, 2)) / 64 + np.arange(20)[:, None, None] * velocity / 8
    )
    return place, np.broadcast_to(velocity / 8 / 0.1, place.shape)


def _wheel(turn: Array, speed: float) -> tuple[Array, Array]:
    """Return particles on a wheel and their velocities per frame interval of 0.1."""
    angle = 2 * np.pi * turn + speed * np.arange(20)[:, None]
    radius = np.linspace(0.1, 0.5, len(turn))
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return place, speed / 0.1 * np.stack([-place[..., 1], place[..., 0]], axis=-1)


@pytest.mark.parametrize("kind", ODD)
def test_odd_data_pass(kind: str) -> None:
    """What is random, noisy, rigid or coarse in time is no mistake, in ten draws of
    each.
    """
    for seed in range(10):
        position, velocity = ODD[kind](np.random.default_rng(seed))
        assert said(position, velocity, 0.1) == ""
        assert said(position, None, 0.1) == ""


def test_adopting_says_so_and_can_be_told_otherwise(
    tmp_path: Path, run: Callable[..., Result]
) -> None:
    """`adopt` refuses swapped velocities, leaves nothing, and takes them with
    --as-is.
    """
    interval = 0.1
    position = 0.5 + 0.5 * _wheel(np.random.default_rng(0).random(60), 0.2)[0]
    for number in range(3):
        swapped = differences(position, interval)[..., ::-1]
        np.savez(tmp_path / f"{number}.npz", position=position, velocity=swapped)
    words = [
        "adopt",
        tmp_path,
        "-o",
        tmp_path / "own",
        "--radius",
        "0.1",
        "--frame-interval",
        interval,
    ]
    refused = run(*words)
    assert refused.exit_code == DataError.exit_code
    assert "0.npz" in refused.stderr
    assert not (tmp_path / "own").exists()
    taken = run(*words, "--as-is")
    assert taken.exit_code == 0, taken.output


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((12, 2, 40), "(frames, 2, particles)"),
        ((2, 12, 40), "(2, frames"),
        ((2, 40, 3), "3 components"),
        ((50, 2, 3), "3 components"),
    ],
)
def test_components_that_do_not_come_last(
    tmp_path: Path, shape: tuple[int, ...], words: str
) -> None:
    """The shape alone gives them away, and what is said mends it; three components are
    data in space.
    """
    array = np.zeros(shape)
    np.save(tmp_path / "runs.npy", np.stack([array] * 3))
    with pytest.raises(DataError) as caught:
        adopt(
            tmp_path / "runs.npy",
            output=tmp_path / "own",
            radius=0.1,
            frame_interval=0.1,
        )
    assert words in str(caught.value)
    if shape[2] == 3:
        assert "moveaxis" not in str(caught.value)
    else:
        assert eval(str(caught.value.fix), {"np": np, "array": array}).shape == (
            12,
            40,
            2,
        )
