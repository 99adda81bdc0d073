"""NeuralMPM: what holds for any weights, and that it learns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from simple_models import batch, info, jittered, rolled, swirl
from torch import Tensor, nn

from lagbench.baselines.augmentation import Symmetry, mirror_batch, mirror_matrices
from lagbench.baselines.baseline import Batch
from lagbench.baselines.catalogue import find
from lagbench.baselines.checkpoint import round_weights
from lagbench.baselines.neuralmpm import NeuralMPM
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.start import TrainingStart
from lagbench.data.registry import load
from lagbench.errors import DataError, UsageError

SMALL: dict[str, object] = {
    "cells": 10,
    "width": 8,
    "velocities": 2,
    "bundle": 2,
    "calls": 2,
}
SMALL |= {"noise_std": 0.0, "materials": [0, 1, 2, 3]}
PROJECTED: dict[str, object] = {"shape": [4, 8], "density": [8]}


def surrogate(
    *,
    awake: float = 0.0,
    changes: Mapping[str, object] | None = None,
    **options: object,
) -> Any:
    """Return a small model; `awake` is the deviation of its last layer's weights."""
    torch.manual_seed(0)
    model = NeuralMPM.build(SMALL | options, info(**(changes or {})))
    if awake:
        nn.init.normal_(model.network.end.weight, std=awake)
    return model


def liquid(*windows: np.ndarray[Any, np.dtype[np.float64]]) -> Batch:
    """Return windows side by side, all of one material."""
    given = batch(*windows)
    given.material.zero_()
    return given


def drift(
    speed: tuple[float, float], frames: int, seed: int = 0
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a cloud in the middle of the box that moves as one, shape [frame,
    particle, 2].
    """
    return jittered(seed, low=0.35, high=0.65) + np.arange(frames)[
        :, None, None
    ] * np.array(speed)


def test_untrained_models_keep_every_velocity() -> None:
    """Without smoothing particles move on straight, and with it a uniform flow keeps
    its kinetic energy.
    """
    velocity = np.random.default_rng(0).normal(0.0, 2e-3, (256, 2))
    window = jittered(0, low=0.3, high=0.7) + np.arange(3)[:, None, None] * velocity
    found = rolled(surrogate(smoothing=0.0), batch(window), 20).diff(dim=1)
    expected = (
        torch.from_numpy(window[1] - window[0])[:, None].expand(-1, 19, -1).float()
    )
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    moved = rolled(surrogate(smoothing=0.2), batch(drift((4e-3, -2e-3), 3)), 40)
    energy = moved.diff(dim=1).double().square().sum(dim=2).mean(dim=0)
    np.testing.assert_allclose(energy.numpy(), 2e-5, rtol=2e-3)


def test_smoothing_damps_what_the_grid_does_not_see() -> None:
    """A share s of the sub-grid velocity goes with every frame; momentum stays."""
    velocity = np.random.default_rng(0).normal(0.0, 1e-3, (256, 2))
    window = jittered(0, low=0.3, high=0.7) + np.arange(3)[:, None, None] * velocity
    found = rolled(surrogate(smoothing=0.3), liquid(window), 4).diff(dim=1).double()
    spread = found.std(dim=0).mean(dim=1)
    assert bool((spread[1:] < 0.85 * spread[:-1]).all())


@pytest.mark.parametrize("conserve", [False, True])
def test_particles_stay_inside_the_walls(conserve: bool) -> None:
    """Whatever the network says, positions stay in the box and velocities true to
    them.
    """
    model = surrogate(awake=30.0, conserve=conserve)
    given = batch(swirl(0, 3), swirl(1, 3))
    found = rolled(model, given, 12)
    low, high = torch.tensor(info().bounds).T
    assert bool(((found >= low) & (found <= high)).all())
    assert bool(((found == low) | (found == high)).any())  # some were stopped
    _, frames = model.call(model.start(given))
    torch.testing.assert_close(
        frames[1][0] - frames[0][0], frames[1][1], rtol=0, atol=2e-7
    )


@pytest.mark.parametrize("conserve", [False, True])
def test_windows_side_by_side_do_not_see_each_other(conserve: bool) -> None:
    """Two windows in one batch roll out as they do alone, walls and context
    included.
    """
    model = surrogate(awake=0.1, context=3, wall_velocity=True, conserve=conserve)
    windows = [batch(swirl(seed, 3), walls=True) for seed in (0, 1)]
    both = rolled(model, batch(swirl(0, 3), swirl(1, 3), walls=True), 5)
    torch.testing.assert_close(
        both, torch.cat([rolled(model, w, 5) for w in windows]), rtol=0, atol=1e-6
    )


def test_training_unrolls_the_rollout() -> None:
    """The loss over two calls is the mean error of the rollout's velocities, over the
    deviation.

    With a generator after none or one call without gradients: of the rollout's next
    frames.
    """
    window = batch(swirl(0, 9))
    model = surrogate(awake=0.1, pushforward=1)
    path = torch.cat(
        [window.position[:, 2:3], rolled(model, window.part(slice(3)), 6)], dim=1
    )
    error = (path.diff(dim=1) - window.position[:, 2:].diff(dim=1)).square() / (
        (2e-4**2 + 1e-4**2) / 2
    )
    expected = [float(error[:, start : start + 4].mean()) for start in (0, 2)]
    with torch.no_grad():
        assert float(model(window)["velocity"]) == pytest.approx(expected[0], rel=1e-3)
        found = {
            float(model(window, torch.Generator().manual_seed(seed))["velocity"])
            for seed in range(12)
        }
    assert sorted(found) == pytest.approx(sorted(expected), rel=1e-3)


@pytest.mark.parametrize("after", [2.2e-3, 6e-3])
def test_the_way_back_is_asked_for(after: float) -> None:
    """An untrained model goes on as before, the truth faster: how far it is behind
    counts, to a bound.
    """
    given = 2e-3
    frames = np.arange(1.0, 5.0)
    travelled = np.concatenate([given * np.arange(3.0), 2 * given + after * frames])
    window = batch(
        jittered(0, low=0.3, high=0.6) + travelled[:, None, None] * np.array([1.0, 0.0])
    )
    model = surrogate(smoothing=0.0, recovery=4.0)
    behind = (after - given) * np.arange(4.0)
    wanted = after + np.minimum(behind / 4.0, 3.0 * model.change)
    # nothing moves along y
    expected = ((wanted - given) ** 2 / 2).mean() / model.change**2
    with torch.no_grad():
        assert float(model(window)["velocity"]) == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("projected", [{}, PROJECTED])
def test_momentum_is_conserved_away_from_walls(projected: dict[str, object]) -> None:
    """Whatever stresses are said: two materials push each other apart, and their mean
    goes on and falls.
    """
    model = surrogate(awake=0.3, conserve=True, smoothing=0.3, strain=True, **projected)
    nn.init.constant_(model.fall, -0.05)
    if model.projection is not None:
        nn.init.constant_(model.projection.limit, -2.0)  # all is too dense
    window = drift((2e-3, -1e-3), 3)
    given = batch(window)
    given.material[::2] = 3
    found = rolled(model, given, 4).diff(dim=1).double()
    fall = -0.05 * 10.0 * model.change
    mean = found.mean(dim=0).numpy()
    np.testing.assert_allclose(
        mean, [(2e-3, -1e-3 + fall * k) for k in (2, 3, 4)], rtol=0, atol=2e-7
    )
    apart = found[::2].mean(dim=0) - found[1::2].mean(dim=0)
    assert float(apart.abs().max()) > 1e-5


def test_thin_matter_bears_less() -> None:
    """Under one pressure a lattice bursts at its rim; with a quarter of the particles
    far less.
    """

    def bursting(spacing: float) -> float:
        model = surrogate(conserve=True, materials=[0], bundle=1, smoothing=0.0)
        nn.init.constant_(model.network.end.bias[:3:2], 1.0)
        axis = np.arange(0.3 + spacing / 2, 0.7, spacing)
        given = liquid(
            np.repeat(
                np.stack(np.meshgrid(axis, axis), axis=-1).reshape(1, -1, 2), 3, axis=0
            )
        )
        with torch.no_grad():
            _, ((_, velocity),) = model.call(model.start(given))
        return float(velocity.norm(dim=1).max())

    dense, full, thin, thinner = (
        bursting(spacing) for spacing in (0.0125, 0.025, 0.05, 0.1)
    )
    assert full == pytest.approx(dense, rel=0.2)
    assert thin < full / 5
    assert thinner < thin / 10


def test_walls_push_where_they_are() -> None:
    """Beside a wall momentum changes; a body in the middle is not reached."""
    model = surrogate(conserve=True, materials=[0])
    nn.init.constant_(model.network.end.bias[-4:], 1.0)
    for low, pushed in ((0.05, True), (0.4, False)):
        given = liquid(np.repeat(jittered(0, low=low, high=low + 0.2)[None], 3, axis=0))
        moved = rolled(model, given, 2)[:, -1] - given.position[:, -1]
        assert bool(moved.abs().max() > 1e-5) is pushed


@pytest.mark.parametrize(
    "changes", [{}, {"conserve": True}, {"conserve": True} | PROJECTED]
)
@pytest.mark.parametrize("number", range(8))
def test_the_mean_over_images_has_the_symmetry_of_the_box(
    number: int, changes: dict[str, object]
) -> None:
    """Strain, walls that move and context included, the rollout of an image is the
    image of the rollout.
    """
    matrix = mirror_matrices(Symmetry.SQUARE)[number]
    options = {
        "strain": True,
        "wall_velocity": True,
        "context": 3,
        "symmetry": "square",
    } | changes
    given = batch(swirl(0, 3), walls=True)
    sheared = torch.tensor([[0.9, 0.15], [0.0, 1.05]])
    given = replace(given, origin=(given.position[:, 0] - 0.5) @ sheared + 0.5)

    def apart(*, average: bool) -> float:
        model = surrogate(**options, awake=0.1, average=average)
        nn.init.normal_(model.context.numbers[-1].weight, std=3.0)
        if model.projection is not None:
            nn.init.constant_(model.projection.limit, -2.0)  # all is too dense
        here, there = (
            rolled(model, one, 4)
            for one in (given, mirror_batch(given, matrix[None], info().bounds))
        )
        return float((there - ((here - 0.5) @ matrix.T + 0.5)).abs().max())

    assert apart(average=True) < 2e-6
    assert (apart(average=False) > 1e-5) is (number > 0)  # the weights have no symmetry


def test_the_mean_over_images_in_half_precision() -> None:
    """Under autocast the rollout is near that in full precision; without images there
    is no mean.
    """
    model = surrogate(awake=0.1, symmetry="square", average=True)
    given = batch(swirl(0, 3))
    with torch.autocast("cpu", torch.bfloat16):
        rounded = rolled(model, given, 4)
    torch.testing.assert_close(rounded, rolled(model, given, 4), rtol=0, atol=1e-4)
    with pytest.raises(UsageError, match="symmetry"):
        surrogate(average=True)


def test_materials_in_one_place_come_to_one_velocity() -> None:
    """Two clouds that lie in each other and part are held together by a grid that they
    share.
    """
    rng = np.random.default_rng(0)
    side = np.where(np.arange(256) % 2, 1.0, -1.0)[:, None] * np.array([1e-3, 0.0])
    given = batch(rng.uniform(0.3, 0.7, (256, 2)) + np.arange(3)[:, None, None] * side)
    given = replace(given, material=torch.arange(256) % 2)

    def gap(**options: object) -> float:
        found = (
            rolled(surrogate(smoothing=0.5, **options), given, 6).diff(dim=1).double()
        )
        assert float(found.mean(dim=0).abs().max()) < 2e-4
        return float(found[1::2, -1, 0].mean() - found[::2, -1, 0].mean())

    assert gap() == pytest.approx(2e-3, rel=0.02)
    assert abs(gap(mixture=True)) < 0.3 * 2e-3


def test_materials_matter() -> None:
    """Who is jelly and who is snow matters; a material that was not named is refused.

    A strained first frame matters where a body is solid; liquid has no shape to come
    back to.
    """
    given = batch(swirl(0, 3))
    other = replace(given, material=(given.material + 1) % 4)
    plain = surrogate(awake=0.1)
    model = surrogate(awake=0.1, strain=True)
    assert not torch.equal(rolled(plain, given, 2), rolled(plain, other, 2))
    with pytest.raises(DataError):
        surrogate(materials=[0, 2]).start(given)
    origin = 0.9 * (given.position[:, 0] - 0.5) + 0.5
    for material, differs in ((0, False), (1, True)):
        alike = replace(given, material=torch.full_like(given.material, material))
        strained = rolled(model, replace(alike, origin=origin), 2)
        assert torch.equal(rolled(model, alike, 2), strained) is not differs


def test_bodies_come_back_to_the_shape_of_the_first_frame() -> None:
    """Jelly that is pulled apart in later frames is drawn together again; without the
    option it is not.
    """
    rng = np.random.default_rng(0)
    window = jittered(0, low=0.4, high=0.6) + 0.02 * np.arange(3)[
        :, None, None
    ] * rng.normal(0, 1, (256, 2))
    first = torch.from_numpy(jittered(0, low=0.4, high=0.6)).float()
    given = batch(window)
    given = replace(given, material=torch.ones(256).long(), frame=given.frame + 7)

    def off(**options: object) -> float:
        model = surrogate(smoothing=0.0, **options)
        told = replace(given, origin=first if model.origin else None)
        return float(
            (torch.pdist(rolled(model, told, 6)[:, -1]) - torch.pdist(first))
            .abs()
            .mean()
        )

    assert off(shape=[4, 8]) < 0.1 * off()


def test_clouds_that_meet_are_not_pressed_into_each_other() -> None:
    """Two that fly into each other end less dense where that is asked for."""
    side = np.where(np.arange(512) < 256, 1.0, -1.0)[:, None] * np.array([8e-3, 0.0])
    clouds = np.concatenate(
        [jittered(0, low=0.25, high=0.45), jittered(1, low=0.55, high=0.75)]
    )
    clouds[:, 1] += np.where(np.arange(512) < 256, 0.15, -0.15)
    given = batch(clouds + np.arange(3)[:, None, None] * side)

    def nearest(**options: object) -> float:
        moved = rolled(surrogate(smoothing=0.0, **options), given, 16)[:, -1]
        return float((torch.cdist(moved, moved) < 0.02).sum())

    assert nearest(density=[8, 16]) < 0.75 * nearest()


class Drag(nn.Module):
    """Stands for the U-Net: every frame's acceleration is -rate times the velocity on
    the grid.
    """

    def __init__(self, rate: float, bundle: int) -> None:
        super().__init__()
        self.rate = rate
        self.bundle = bundle

    def forward(self, field: Tensor) -> Tensor:
        """Return the accelerations of one material."""
        return -self.rate * field[:, 1:3].repeat(1, self.bundle, 1, 1)


def test_a_known_network_has_a_known_rollout() -> None:
    """Drag takes the share r of the velocity before a bundle in each of its frames: a
    closed form.
    """
    model = surrogate(materials=[0], smoothing=0.0)
    rate = 0.1
    model.network = Drag(rate * model.speed / model.change, 2)
    given = liquid(drift((4e-3, -2e-3), 3))
    found = rolled(model, given, 4).double().mean(dim=0) - given.position[
        :, -1
    ].double().mean(dim=0)
    shares = np.array(
        [1 - rate, 1 - 2 * rate, (1 - 2 * rate) * (1 - rate), (1 - 2 * rate) ** 2]
    )
    np.testing.assert_allclose(
        found.numpy(), shares.cumsum()[:, None] * [4e-3, -2e-3], rtol=1e-3
    )


def test_images_roll_out_as_images() -> None:
    """All eight images of the box, with a network that knows no direction: transfers
    and walls know none.
    """
    model = surrogate(materials=[0], smoothing=0.2)
    model.network = Drag(-0.5 * model.speed / model.change, 2)
    given = liquid(swirl(0, 3, (0.2, 0.2)))
    for matrix in mirror_matrices(Symmetry.SQUARE):
        there = rolled(model, mirror_batch(given, matrix[None], info().bounds), 5)
        here = (rolled(model, given, 5) - 0.5) @ matrix.T + 0.5
        torch.testing.assert_close(there, here, rtol=0, atol=1e-5)


def test_each_frame_is_driven_by_its_own_walls() -> None:
    """The first bundle sees the walls of its two frames and none after them; the second
    sees its own.
    """
    model = surrogate(awake=0.1, wall_velocity=True)
    whole = batch(swirl(0, 9), walls=True)

    def with_walls_at(frame: int) -> Tensor:
        walls = torch.zeros_like(whole.wall_velocity)
        walls[:, frame] = 0.05
        return rolled(model, replace(whole, wall_velocity=walls).part(slice(3)), 4)

    still = with_walls_at(2)  # the last given frame is over
    first, second, later = (with_walls_at(frame) for frame in (3, 6, 7))
    assert not torch.equal(first[:, 0], still[:, 0])
    assert torch.equal(second[:, :2], still[:, :2])
    assert not torch.equal(second[:, 2], still[:, 2])
    assert torch.equal(later, still)
    # a batch that knows nothing of later frames is rolled out as if its last walls
    # stayed
    short = replace(whole.part(slice(3)), wall_velocity=whole.wall_velocity[:, :3])
    assert torch.equal(rolled(model, whole.part(slice(3)), 6), rolled(model, short, 6))


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("materials", []),
        ("materials", [1, 1]),
        ("materials", [4]),
        ("wall_velocity", True),
    ],
)
def test_options_that_do_not_fit_are_refused(option: str, value: object) -> None:
    """Materials that do not exist, and walls of a split where none moves."""
    with pytest.raises(UsageError) as told:
        surrogate(changes={"moving_walls": False}, **{option: value})
    assert told.value.where == f"model.{option}"


@pytest.mark.parametrize("cells", [18, 20, 22, 30, 38, 42])
def test_walls_are_felt_alike_on_all_sides(cells: int) -> None:
    """As many rows of nodes beside each wall; with an odd number walls lay on nodes:
    refused.
    """
    held = surrogate(cells=cells).grid
    beside = [int(side.count_nonzero()) for side in held.beside_walls()]
    assert len(set(beside)) == 1
    with pytest.raises(ValidationError):
        surrogate(cells=cells + 1)


def test_learns_a_swirl() -> None:
    """Particles turn ever slower: soon the rollout errs a third of what constant
    velocity does.
    """
    model = surrogate(materials=[0], width=16, symmetry="square", noise_std=1e-5)
    flows = [swirl(seed, 24, (0.06, 0.01)) for seed in range(4)]
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3)
    rng = np.random.default_rng(0)

    def error() -> float:
        whole = liquid(swirl(9, 24, (0.06, 0.01)))
        found = rolled(model, whole.part(slice(3)), 20)
        return float((found - whole.position[:, 3:23]).square().mean().sqrt())

    before = error()
    for _ in range(60):
        length = model.history + model.future
        starts = rng.integers(24 - length + 1, size=4)
        given = liquid(*(f[s : s + length] for f, s in zip(flows, starts, strict=True)))
        optimiser.zero_grad()
        model(given, generator)["velocity"].backward()
        optimiser.step()
    assert error() < before / 3


@pytest.mark.parametrize("size", ["tiny", "mini", "full"])
@pytest.mark.parametrize("split", ["cavity", "curl-noise", "fluid", "multimaterial"])
def test_recipes_fit_every_split(split: str, size: str) -> None:
    """Walls drive the cavity alone, gravity allows the mirror alone, materials are
    those of the split.
    """
    described = load().size(split, size)
    recipe = recipe_for(find("neuralmpm"), split, size)
    model = NeuralMPM.build(
        recipe.model, info(moving_walls=split == "cavity", bounds=described.bounds)
    )
    gravity = described.parameters.get("gravity")
    assert recipe.model["wall_velocity"] is (split == "cavity")
    assert recipe.model["symmetry"] == (
        "mirror" if gravity and gravity.value else "square"
    )
    assert len(recipe.model["materials"]) == (4 if split == "multimaterial" else 1)
    assert (
        2 * sum(p.numel() for p in model.parameters()) <= 4e6
    )  # bytes of its weights in bfloat16


def both(*cells: int) -> dict[str, object]:
    """Return options with the same grids of both kinds."""
    return {"shape": list(cells), "density": list(cells)}


@pytest.mark.parametrize(
    ("earlier", "later", "same"),
    [
        *(({}, both(4, 8), 0), (both(4), both(4, 8), 1)),
        *(({kind: [4]}, both(4, 8), 1) for kind in ("shape", "density")),
        *(({kind: [4]}, {kind: [4, 8]}, 1) for kind in ("shape", "density")),
        *(
            (both(4), both(8), 0),
            (both(4, 8), both(4, 16), 1),
            (both(4, 8), both(4), 1),
        ),
        *((both(4, 8), both(8, 4), 0), (both(4, 8), {}, 0)),
    ],
)
def test_of_other_grids_those_go_on_that_stand_first_in_both(
    earlier: dict[str, object], later: dict[str, object], same: int
) -> None:
    """Their weights are kept; others start as in a new model, and those that are left
    out are dropped.
    """
    before = surrogate(awake=0.1, **earlier)
    new = surrogate(**later)
    with torch.no_grad():
        for weight in before.parameters():
            weight.add_(0.01)
    held = round_weights(before)
    own = {name: value.clone() for name, value in new.state_dict().items()}
    options = before.options.model_dump(
        mode="json", exclude=set(before.options.in_training)
    )
    start = TrainingStart(
        path=Path("earlier.pt"),
        info=before.info,
        weights=held,
        options=options,
        record={},
    )
    start.load_into(new)
    found = new.state_dict()
    assert found.keys() == own.keys()
    for name, value in found.items():
        expected = held.get(name, own[name]).to(value.dtype)
        if name in held and name in {"projection.held", "projection.push"}:
            expected = torch.cat([expected[:same], own[name][same:]])
        torch.testing.assert_close(value, expected, rtol=0, atol=0)
