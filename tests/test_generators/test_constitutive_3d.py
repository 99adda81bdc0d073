# mypy: disallow-untyped-decorators=False
"""Constitutive models in three dimensions against SciPy's decompositions, finite
differences and closed forms.
"""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
import taichi as ti
from numpy.typing import NDArray
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from lagbench.generators import backend, constitutive, constitutive_3d
from lagbench.generators.solver import Device
from lagbench.generators.transfer import Nothing

if TYPE_CHECKING:
    Array: TypeAlias = Any
else:
    Array = ti.types.ndarray()

COUNT = 2048
MU, LAMBDA = constitutive.lame(30.0, 0.3)
LOW = 1.0 - 2.5e-2
HIGH = 1.0 + 4.5e-3
IDENTITY = np.eye(3)


@pytest.fixture(autouse=True)
def taichi_runtime() -> None:
    """Start Taichi as the solver does: strict float32 on the CPU."""
    backend.start(Device.CPU)


@ti.kernel
def evaluate(
    f: Array, stretch: Array, stress: Array, elastic: Array, ratio: Array
) -> Nothing:
    """Evaluate left stretch, corotated stress and plastic return of gradients."""
    for i in range(f.shape[0]):
        m = ti.Matrix.zero(ti.f32, 3, 3)
        for a, b in ti.static(ti.ndrange(3, 3)):
            m[a, b] = f[i, a, b]
        jacobian = constitutive_3d.determinant(m)
        left = constitutive_3d.left_stretch(m @ m.transpose(), jacobian)
        tau = constitutive_3d.corotated_stress(m, MU, LAMBDA)
        clamped, factor = constitutive_3d.plastic_return(m, LOW, HIGH)
        ratio[i] = factor
        for a, b in ti.static(ti.ndrange(3, 3)):
            stretch[i, a, b] = left[a, b]
            stress[i, a, b] = tau[a, b]
            elastic[i, a, b] = clamped[a, b]


def models(gradients: Any) -> tuple[NDArray[np.float32], ...]:
    """Return left stretch, corotated stress, elastic part and volume ratio of gradients
    [n, 3, 3].
    """
    f = np.ascontiguousarray(gradients, np.float32)
    stretch = np.empty_like(f)
    stress = np.empty_like(f)
    elastic = np.empty_like(f)
    ratio = np.empty(len(f), np.float32)
    evaluate(f, stretch, stress, elastic, ratio)
    return stretch, stress, elastic, ratio


def rotations(count: int = COUNT) -> NDArray[np.float64]:
    """Draw rotations, uniform over all of them, shape [count, 3, 3]."""
    rng = np.random.default_rng(5)
    return np.asarray(Rotation.random(count, random_state=rng).as_matrix())


def deformations(spread: float) -> NDArray[np.float32]:
    """Draw gradients near the identity, each turned, shape [COUNT, 3, 3]."""
    rng = np.random.default_rng(6)
    deviation = 2.0 * rng.random((COUNT, 3, 3)) - 1.0
    return (rotations() @ (IDENTITY + spread * deviation)).astype(np.float32)


def energy(f: NDArray[np.float64]) -> float:
    """Fixed corotated energy mu |F - R|^2 + lambda/2 (J - 1)^2, R from SciPy."""
    rotation, _ = polar(f)
    shear = ((f - rotation) ** 2).sum()
    bulk = (np.linalg.det(f) - 1.0) ** 2
    return float(MU * shear + 0.5 * LAMBDA * bulk)


def test_left_stretch_is_the_polar_factor() -> None:
    """V equals SciPy's polar factor, for stretches from 0.3 to 2.5 along any axes."""
    rng = np.random.default_rng(7)
    stretches = rng.uniform(0.3, 2.5, (COUNT, 1, 3))
    turn = rotations()
    f = (turn * stretches) @ turn[::-1].transpose(0, 2, 1)
    f = f.astype(np.float32)
    expected = [polar(m.astype(np.float64), side="left")[1] for m in f]
    stretch, *_ = models(f)
    np.testing.assert_allclose(stretch, expected, atol=3e-6)


def test_an_inverted_gradient_has_the_nearest_rotation() -> None:
    """Where det F < 0 the least stretch is negative: R is a rotation still."""
    rng = np.random.default_rng(8)
    stretches = rng.uniform(0.6, 1.4, (COUNT, 3))
    stretches[:, 2] = -rng.uniform(0.1, 0.4, COUNT)
    turn = rotations()
    f = (turn * stretches[:, None]) @ turn[::-1].transpose(0, 2, 1)
    expected = (turn * stretches[:, None]) @ turn.transpose(0, 2, 1)
    stretch, *_ = models(f)
    np.testing.assert_allclose(stretch, expected, atol=5e-4)


def test_a_rotation_leaves_no_stress() -> None:
    """F = R has no stress beyond rounding, and nothing yields."""
    f = rotations().astype(np.float32)
    _, stress, elastic, ratio = models(f)
    assert np.abs(stress).max() <= 2e-6 * (2.0 * MU + 3.0 * LAMBDA)
    np.testing.assert_allclose(elastic, f, atol=1e-6)
    np.testing.assert_allclose(ratio, 1.0, atol=1e-6)


@pytest.mark.parametrize("stretch", [0.6, 0.9, 1.0, 1.25, 1.8])
def test_uniaxial_stretch_has_the_closed_form(stretch: float) -> None:
    """F = diag(s, 1, 1): tau_xx = 2 mu (s - 1) s + lambda (s - 1) s, others lambda
    (s - 1) s, in any frame.
    """
    volumetric = LAMBDA * (stretch - 1.0) * stretch
    along = 2.0 * MU * (stretch - 1.0) * stretch + volumetric
    expected = np.diag([along, volumetric, volumetric])
    turn = rotations(64)
    f = turn @ np.diag([stretch, 1.0, 1.0]) @ turn[::-1]
    _, stress, *_ = models(f)
    closed_form = turn @ expected @ turn.transpose(0, 2, 1)
    np.testing.assert_allclose(stress, closed_form, atol=1e-4)


def test_corotated_stress_is_the_derivative_of_its_energy() -> None:
    """Tau = (d psi / dF) F^T, with psi differentiated by central differences."""
    f = deformations(0.3)[:64]
    stress = models(f)[1]
    step = 1e-6
    for m, tau in zip(f.astype(np.float64), stress, strict=True):
        gradient = np.empty((3, 3))
        for entry in np.ndindex(3, 3):
            shift = np.zeros((3, 3))
            shift[entry] = step
            rise = energy(m + shift) - energy(m - shift)
            gradient[entry] = rise / (2.0 * step)
        np.testing.assert_allclose(tau, gradient @ m.T, atol=2e-4)


def test_corotated_stress_ignores_rotation_before_and_follows_rotation_after() -> None:
    """tau(Q F) = Q tau(F) Q^T and tau(F Q) = tau(F): objective and isotropic."""
    f = deformations(0.2)
    q = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix().astype(np.float32)
    _, stress, *_ = models(f)
    _, turned_after, *_ = models(q @ f)
    _, turned_before, *_ = models(f @ q)
    np.testing.assert_allclose(turned_after, q @ stress @ q.T, atol=4e-4)
    np.testing.assert_allclose(turned_before, stress, atol=4e-4)


def test_the_stress_is_symmetric() -> None:
    """No torque: opposite entries agree in every bit."""
    _, stress, *_ = models(deformations(0.4))
    assert np.array_equal(stress, stress.transpose(0, 2, 1))


def test_plane_strain_is_the_stress_of_two_dimensions() -> None:
    """F = diag(F2, 1) has the stress of the closed form in the plane."""
    rng = np.random.default_rng(9)
    plane = np.eye(2) + 0.3 * (2.0 * rng.random((64, 2, 2)) - 1.0)
    f = np.tile(IDENTITY, (64, 1, 1))
    f[:, :2, :2] = plane
    _, stress, *_ = models(f)
    for m, tau in zip(plane, stress, strict=True):
        rotation, _ = polar(m)
        j = np.linalg.det(m)
        volumetric = LAMBDA * (j - 1.0) * j
        in_plane = 2.0 * MU * (m - rotation) @ m.T + volumetric * np.eye(2)
        np.testing.assert_allclose(tau[:2, :2], in_plane, atol=2e-4)
        np.testing.assert_allclose(tau[2], [0.0, 0.0, volumetric], atol=2e-4)


def test_plastic_return_clamps_numpys_singular_values() -> None:
    """The elastic part is U clamp(Sigma) V^T of NumPy's SVD, and Jp takes the rest."""
    f = deformations(0.15)
    *_, elastic, ratio = models(f)
    u, sigma, vt = np.linalg.svd(f.astype(np.float64))
    clamped = np.clip(sigma, LOW, HIGH)
    expected = u @ (clamped[:, :, None] * vt)
    expected_ratio = sigma.prod(1) / clamped.prod(1)
    np.testing.assert_allclose(elastic, expected, atol=5e-6)
    np.testing.assert_allclose(ratio, expected_ratio, rtol=5e-6)


def test_snow_that_collapses_stays_finite() -> None:
    """Even a gradient without volume gives a positive, finite volume ratio."""
    collapsed = np.zeros((3, 3))
    flat = np.diag([1.0, 1.0, 0.0])
    reflected = np.diag([1.0, 1.0, -1.0])
    stretch, stress, elastic, ratio = models([collapsed, flat, reflected])
    assert np.isfinite(stretch).all()
    assert np.isfinite(stress).all()
    assert np.isfinite(elastic).all()
    assert (ratio > 0.0).all()
    assert np.isfinite(ratio).all()
