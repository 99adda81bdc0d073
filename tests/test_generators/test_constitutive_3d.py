# mypy: disallow-untyped-decorators=False
"""Constitutive models in three dimensions against SciPy's decompositions, finite
differences and closed forms.
"""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from constitutive_truth import (
    HIGH,
    LAMBDA,
    LOW,
    MU,
    Double,
    Single,
    clamped_stretches,
    corotated_stress,
    draw_near_identity,
)
from numpy.testing import assert_allclose
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from lagbench.generators import backend, constitutive_3d
from lagbench.generators.language import ti
from lagbench.generators.split import Device
from lagbench.generators.transfer import Nothing

if TYPE_CHECKING:
    Array: TypeAlias = Any
else:
    Array = ti.types.ndarray()

COUNT = 2048
IDENTITY = np.eye(3)
# the place of an entry in a symmetric matrix
ENTRY = ((0, 5, 4), (5, 1, 3), (4, 3, 2))


@pytest.fixture(autouse=True)
def engine() -> None:
    """Start the engine as the solver does: strict float32 on the CPU."""
    backend.start(Device.CPU)


@ti.kernel
def evaluate(
    f: Array,
    stretch: Array,
    stress: Array,
    elastic: Array,
    ratio: Array,
) -> Nothing:
    """Evaluate left stretch, corotated stress and plastic return of gradients."""
    for i in range(f.shape[0]):
        m = ti.Matrix.zero(ti.f32, 3, 3)
        for a, b in ti.static(ti.ndrange(3, 3)):
            m[a, b] = f[i, a, b]
        rows = constitutive_3d.rows_of(m)
        square = constitutive_3d.times_transposed(rows)
        jacobian = constitutive_3d.determinant(rows)
        left = constitutive_3d.left_stretch(square, jacobian)
        tau = constitutive_3d.corotated_stress(rows, MU, LAMBDA)
        clamped, factor = constitutive_3d.plastic_return(rows, LOW, HIGH)
        ratio[i] = factor
        for a, b in ti.static(ti.ndrange(3, 3)):
            entry = ti.static(ENTRY[a][b])
            stretch[i, a, b] = left[entry]
            stress[i, a, b] = tau[entry]
            elastic[i, a, b] = clamped[a][b]


def models(gradients: Any) -> tuple[Single, ...]:
    """Return left stretch, corotated stress, elastic part and volume ratio of gradients
    [n, 3, 3].
    """
    f = np.ascontiguousarray(gradients, np.float32)
    stretch = np.empty_like(f)
    stress = np.empty_like(f)
    elastic = np.empty_like(f)
    count = len(f)
    ratio = np.empty(count, np.float32)
    evaluate(f, stretch, stress, elastic, ratio)
    return stretch, stress, elastic, ratio


def rotations(count: int = COUNT) -> Double:
    """Draw rotations, uniform over all of them, shape [count, 3, 3]."""
    rng = np.random.default_rng(5)
    drawn = Rotation.random(count, random_state=rng)
    return np.asarray(drawn.as_matrix())


def transposed(matrices: Double) -> Double:
    """Return the transposed matrices."""
    return matrices.transpose(0, 2, 1)


def deformations(spread: float) -> Single:
    """Draw gradients near the identity, each turned, shape [COUNT, 3, 3]."""
    rng = np.random.default_rng(6)
    near = draw_near_identity(rng, COUNT, 3, spread)
    gradients = rotations() @ near
    return gradients.astype(np.float32)


@pytest.mark.slow
def test_left_stretch_is_the_polar_factor() -> None:
    """V equals SciPy's polar factor, for stretches from 0.3 to 2.5 along any axes."""
    rng = np.random.default_rng(7)
    stretches = rng.uniform(0.3, 2.5, (COUNT, 1, 3))
    turn = rotations()
    second_turn = transposed(turn[::-1])
    f = (turn * stretches) @ second_turn
    f = f.astype(np.float32)
    expected = []
    for gradient in f.astype(np.float64):
        _, left = polar(gradient, side="left")
        expected.append(left)
    stretch, *_ = models(f)
    assert_allclose(stretch, expected, atol=3e-6)


def test_an_inverted_gradient_has_the_nearest_rotation() -> None:
    """Where det F < 0 the least stretch is negative: R is a rotation still."""
    rng = np.random.default_rng(8)
    stretches = rng.uniform(0.6, 1.4, (COUNT, 3))
    least = rng.uniform(0.1, 0.4, COUNT)
    stretches[:, 2] = -least
    turn = rotations()
    stretched = turn * stretches[:, None]
    f = stretched @ transposed(turn[::-1])
    expected = stretched @ transposed(turn)
    stretch, *_ = models(f)
    assert_allclose(stretch, expected, atol=5e-4)


def test_corotated_stress_is_the_derivative_of_its_energy() -> None:
    """Tau = (d psi / dF) F^T, with psi differentiated by central differences."""
    f = deformations(0.3)[:64]
    stress = models(f)[1]
    gradients = f.astype(np.float64)
    for m, tau in zip(gradients, stress, strict=True):
        assert_allclose(tau, corotated_stress(m), atol=2e-4)


def test_plane_strain_is_the_stress_of_two_dimensions() -> None:
    """F = diag(F2, 1) has the stress of the closed form in the plane."""
    rng = np.random.default_rng(9)
    plane = draw_near_identity(rng, 64, 2, 0.3)
    f = np.tile(IDENTITY, (64, 1, 1))
    f[:, :2, :2] = plane
    _, stress, *_ = models(f)
    for m, tau in zip(plane, stress, strict=True):
        rotation, _ = polar(m)
        j = np.linalg.det(m)
        volumetric = LAMBDA * (j - 1.0) * j
        shear = 2.0 * MU * (m - rotation) @ m.T
        in_plane = shear + volumetric * np.eye(2)
        out_of_plane = [0.0, 0.0, volumetric]
        assert_allclose(tau[:2, :2], in_plane, atol=2e-4)
        assert_allclose(tau[2], out_of_plane, atol=2e-4)


def test_plastic_return_clamps_numpys_singular_values() -> None:
    """The elastic part is U clamp(Sigma) V^T of NumPy's SVD, and Jp takes the rest."""
    f = deformations(0.15)
    *_, elastic, ratio = models(f)
    expected, expected_ratio = clamped_stretches(f)
    assert_allclose(elastic, expected, atol=5e-6)
    assert_allclose(ratio, expected_ratio, rtol=5e-6)


def test_snow_that_collapses_stays_finite() -> None:
    """Even a gradient without volume gives a positive, finite volume ratio."""
    collapsed = np.zeros((3, 3))
    flat = np.diag([1.0, 1.0, 0.0])
    reflected = np.diag([1.0, 1.0, -1.0])
    gradients = [collapsed, flat, reflected]
    stretch, stress, elastic, ratio = models(gradients)
    assert np.isfinite(stretch).all()
    assert np.isfinite(stress).all()
    assert np.isfinite(elastic).all()
    assert (ratio > 0.0).all()
    assert np.isfinite(ratio).all()
