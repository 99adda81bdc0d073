"""EGNN, PaiNN, SEGNN, UPT and CoRGI: their symmetries, and their way to the board."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from simple_models import batch, info, swirl, trainer
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines.augmentation import Symmetry, mirror_batch, mirror_matrices
from lagbench.baselines.baseline import DatasetInfo
from lagbench.baselines.catalogue import find
from lagbench.baselines.checkpoint import load, restore
from lagbench.baselines.predict import predict
from lagbench.baselines.segnn import SteerableLinear
from lagbench.board.entry import Meta
from lagbench.board.reproduce import reproduce
from lagbench.board.submit import submit
from lagbench.board.verified import Level
from lagbench.data.registry import Registry
from lagbench.make.generate import GenerationResult
from lagbench.models.registered import export_safetensors
from lagbench.tensors import Batch
from lagbench.work.run import Progress

EQUIVARIANT = ["egnn", "painn", "segnn"]
NETWORKS = [*EQUIVARIANT, "upt", "corgi"]


def assert_equal(value: Tensor, expected: Tensor) -> None:
    """Compare to 1e-9, in float64."""
    assert_close(value, expected, rtol=1e-9, atol=1e-9)


def build(name: str, figures: DatasetInfo, **options: object) -> Any:
    """Return a small network in float64 whose every weight but gravity is random."""
    model = find(name).model.build({"latent": 8, "layers": 2, **options}, figures)
    torch.manual_seed(0)
    for parameter_name, parameter in model.named_parameters():
        if parameter_name != "gravity":
            torch.nn.init.normal_(parameter, std=0.3)
    return model.double().eval()


def output(model: Any, given: Batch) -> Tensor:
    """Return what the network predicts."""
    state = model.start(replace(given, position=given.position.double()))
    with torch.no_grad():
        prediction, _ = model.predict(state, model.find_edges(state))
    assert float(prediction.std()) > 1e-3
    return torch.as_tensor(prediction)


def cloud(dimension: int) -> Batch:
    """Return six frames of particles near the middle of the box, far from walls."""
    source = torch.Generator().manual_seed(1)
    place = torch.rand(80, 1, dimension, generator=source, dtype=torch.float64)
    step = torch.randn(80, 6, dimension, generator=source, dtype=torch.float64)
    position = 0.4 + 0.2 * place + 0.002 * step.cumsum(dim=1)
    numbers = torch.arange(80)
    zero = torch.zeros(1, dtype=torch.int64)
    return Batch(
        position=position,
        sample=torch.zeros_like(numbers),
        material=numbers % 4,
        wall_velocity=None,
        scenario=zero,
        frame=zero,
    )


def figures_of_cube() -> DatasetInfo:
    """Return the figures of a box of three dimensions."""
    statistics = {}
    for name, values in info().statistics.items():
        statistics[name] = (*values, values[0])
    return replace(info(), bounds=(info().bounds[0],) * 3, statistics=statistics)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", EQUIVARIANT)
def test_predictions_turn_with_the_particles(name: str, dimension: int) -> None:
    """By random rotations and mirror images about the middle of the box."""
    model = build(name, info() if dimension == 2 else figures_of_cube())
    given = cloud(dimension)
    expected = output(model, given)
    for seed in range(3):
        source = torch.Generator().manual_seed(seed)
        square = torch.randn(dimension, dimension, generator=source)
        rotation, _ = torch.linalg.qr(square.double())
        position = 0.5 + (given.position - 0.5) @ rotation.T
        turned = output(model, replace(given, position=position))
        assert_equal(turned, expected @ rotation.T)


@pytest.mark.parametrize("name", EQUIVARIANT)
def test_predictions_turn_with_the_walls(name: str) -> None:
    """By the eight images of the square, with walls that move."""
    model = build(name, info(), wall_velocity=True)
    given = batch(swirl(0, 6), walls=True)
    given = replace(given, position=given.position.double())
    expected = output(model, given)
    for matrix in mirror_matrices(Symmetry.SQUARE).double():
        image = mirror_batch(given, matrix[None], model.info.bounds)
        assert_equal(output(model, image), expected @ matrix.T)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_order_of_particles_means_nothing(name: str) -> None:
    model = build(name, info())
    given = cloud(2)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(2))
    shuffled = replace(
        given, position=given.position[order], material=given.material[order]
    )
    assert_equal(output(model, shuffled), output(model, given)[order])


@pytest.mark.parametrize("name", NETWORKS)
def test_predictions_do_not_change_when_all_is_moved(name: str) -> None:
    """The box too; where no wall is near, networks without a grid need no box."""
    model = build(name, info())
    given = cloud(2)
    expected = output(model, given)
    moved = replace(given, position=given.position + 0.03125)
    if name in EQUIVARIANT:
        assert_equal(output(model, moved), expected)
    bounds = tuple((low + 0.03125, high + 0.03125) for low, high in info().bounds)
    elsewhere = build(name, info(bounds=bounds))
    assert_equal(output(elsewhere, moved), expected)


@pytest.mark.parametrize(("name", "is_felt"), [("gns", False), ("upt", True)])
def test_far_particles_are_felt(name: str, is_felt: bool) -> None:
    """By supernodes of the whole box; two layers of a graph end after two radii."""
    model = build(name, info())
    given = cloud(2)
    other = given.position.clone()
    first = other[:, -1, 0].argmin()
    last = other[:, -1, 0].argmax()
    assert float(other[last, -1, 0] - other[first, -1, 0]) > 2 * model.radius
    other[first, 0] += 0.01  # an old velocity
    before = output(model, given)[last]
    after = output(model, replace(given, position=other))[last]
    assert bool((after != before).any()) is is_felt


def test_corgi_is_gns_beside_its_grid() -> None:
    """With convolutions that return 0 it predicts what GNS does."""
    corgi = build("corgi", info())
    for parameter in corgi.convolutions.end.parameters():
        torch.nn.init.zeros_(parameter)
    gns = build("gns", info())
    gns.load_state_dict(corgi.state_dict(), strict=False)
    assert_equal(output(corgi, cloud(2)), output(gns, cloud(2)))


@pytest.mark.slow
def test_a_steerable_layer_is_the_tensor_product_of_e3nn() -> None:
    """In three dimensions, with weights times the root of 3 in paths with vectors."""
    from e3nn import o3

    layer = SteerableLinear(4, 3, 5, 2).double()
    product = o3.FullyConnectedTensorProduct(
        "4x0e+3x1o",
        "1x0e+1x1o",
        "5x0e+2x1o",
        irrep_normalization="none",
        path_normalization="none",
    ).double()
    of_scalar = layer.scalar.weight[:, :4]
    of_product = layer.scalar.weight[:, 4:]
    weights = {
        (0, 0, 0): of_scalar,
        (1, 1, 0): of_product * 3**0.5,
        (0, 1, 1): layer.along.weight * 3**0.5,
        (1, 0, 1): layer.vector.weight * 3**0.5,
    }
    flat = []
    for path in product.instructions:
        weight = weights.pop((path.i_in1, path.i_in2, path.i_out))
        flat.append(weight.T.flatten())
    assert not weights

    scalar = torch.randn(6, 4).double()
    vector = torch.randn(6, 3, 3).double()
    attribute = torch.randn(6, 3).double()
    ones = torch.ones(6, 1).double()
    expected = product(
        torch.cat([scalar, vector.flatten(1)], dim=1),
        torch.cat([ones, attribute], dim=1),
        torch.cat(flat),
    )
    next_scalar, next_vector = layer(scalar, vector, attribute)
    result = torch.cat([next_scalar - layer.scalar.bias, next_vector.flatten(1)], dim=1)
    assert_close(result, expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_from_a_training_to_the_board(
    name: str,
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interrupted, resumed to the same bits, predicted, exported and reproduced."""
    run = trainer(generated.root, unmeasured, tmp_path, monkeypatch)
    settings = ("steps=4", "validate_every=0")
    whole = run(name, *settings, to="whole")

    def interrupt(news: Progress) -> None:
        if news.done == 2:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(name, *settings, to="parts", progress=interrupt)
    parts = run(name, *settings, to="parts")
    resumed = load(parts.weights)
    for key, value in load(whole.weights).weights.items():
        assert torch.equal(value, resumed.weights[key]), key

    exported = export_safetensors(
        restore(resumed), tmp_path / "model.safetensors", baseline=name
    )
    root = generated.root
    predictions = tmp_path / "predictions.nc"
    predict(exported, predictions, root=root, device="cpu", threads=1, method=name)
    board = tmp_path / "board"
    submit(
        [predictions],
        Meta(authors=("A. Author",), command="make"),
        weights=[exported],
        board=board,
        root=root,
        new_board=True,
    )
    result = reproduce(board, [f"curl-noise/tiny/{name}"], root=root, costs=False)
    (line,) = result.lines.values()
    assert line.level is Level.REPRODUCED
