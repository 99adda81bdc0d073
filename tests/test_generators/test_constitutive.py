# mypy: disallow-untyped-decorators=False
"""Constitutive models against SciPy's decompositions, finite differences and closed
forms.
"""

import math
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from constitutive_truth import (
    HIGH,
    LAMBDA,
    LOW,
    MU,
    Single,
    clamped_stretches,
    corotated_stress,
    draw_near_identity,
)
from numpy.testing import assert_allclose
from scipy.linalg import polar

from lagbench.generators import backend, constitutive
from lagbench.generators.language import ti
from lagbench.generators.split import Device
from lagbench.generators.transfer import Nothing

if TYPE_CHECKING:
    Array: TypeAlias = Any
else:
    Array = ti.types.ndarray()

COUNT = 4096


@pytest.fixture(autouse=True)
def engine() -> None:
    """Start the engine as the solver does: strict float32 on the CPU."""
    backend.start(Device.CPU)


@ti.kernel
def evaluate_scalars(
    z: Array,
    exponential: Array,
    hardening: Array,
) -> Nothing:
    """Evaluate the functions of these names for every entry."""
    for i in range(z.shape[0]):
        exponential[i] = constitutive.exponential(z[i])
        hardening[i] = constitutive.hardening(z[i], 10.0, 0.05, 5.0)


@ti.kernel
def evaluate(
    f: Array,
    turn: Array,
    stress: Array,
    elastic: Array,
    ratio: Array,
) -> Nothing:
    """Evaluate rotation, corotated stress and plastic return for every gradient."""
    for i in range(f.shape[0]):
        first_row = [f[i, 0, 0], f[i, 0, 1]]
        second_row = [f[i, 1, 0], f[i, 1, 1]]
        m = ti.Matrix([first_row, second_row])
        rotation = constitutive.rotation(m)
        tau = constitutive.corotated_stress(m, MU, LAMBDA)
        clamped, factor = constitutive.plastic_return(m, LOW, HIGH)
        ratio[i] = factor
        for a in ti.static(range(2)):
            turn[i, a] = rotation[a]
            for b in ti.static(range(2)):
                stress[i, a, b] = tau[a, b]
                elastic[i, a, b] = clamped[a, b]


def scalars(values: Single) -> tuple[Single, Single]:
    """Return exponential and hardening of numbers."""
    exponential = np.empty_like(values)
    hardening = np.empty_like(values)
    evaluate_scalars(values, exponential, hardening)
    return exponential, hardening


def models(gradients: Any) -> tuple[Single, ...]:
    """Return (cosine, sine), corotated stress, elastic part and volume ratio of
    gradients [n, 2, 2].
    """
    f = np.ascontiguousarray(gradients, np.float32)
    count = len(f)
    turn = np.empty((count, 2), np.float32)
    stress = np.empty_like(f)
    elastic = np.empty_like(f)
    ratio = np.empty(count, np.float32)
    evaluate(f, turn, stress, elastic, ratio)
    return turn, stress, elastic, ratio


def deformations(spread: float) -> Single:
    """Draw gradients near the identity, then turn each by a random angle, shape [COUNT,
    2, 2].
    """
    rng = np.random.default_rng(5)
    near = draw_near_identity(rng, COUNT, 2, spread)
    angle = 2.0 * np.pi * rng.random(COUNT)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    first_row = np.stack([cosine, -sine], axis=-1)
    second_row = np.stack([sine, cosine], axis=-1)
    turn = np.stack([first_row, second_row], axis=1)
    turned = turn @ near
    return turned.astype(np.float32)


def test_exponential_holds_its_stated_error() -> None:
    """The polynomial is exp to 3e-6 over its domain."""
    domain = np.linspace(-4.0, 4.0, 200_001)
    z = domain.astype(np.float32)
    exponential, _ = scalars(z)
    expected = np.exp(z.astype(np.float64))
    relative_error = exponential / expected - 1.0
    assert np.abs(relative_error).max() <= 3e-6


def test_hardening_is_capped_and_monotone() -> None:
    """Compacted snow is never stiffer than the cap, stretched snow never softer than
    the floor.
    """
    domain = np.linspace(0.3, 4.0, 10_001)
    jp = domain.astype(np.float32)
    _, out = scalars(jp)
    assert out.max() == np.float32(5.0)
    assert out.min() == np.float32(0.05)
    rises = np.diff(out)
    of_stretched = out[jp >= 1.0]
    assert (rises <= 0.0).all()
    assert of_stretched.max() <= 1.0 + 2e-6


def test_rotation_is_the_polar_factor() -> None:
    """R equals SciPy's polar factor for gradients of positive determinant."""
    f = deformations(0.4)
    determinant = np.linalg.det(f)
    f = f[determinant > 0.05]
    expected = []
    for gradient in f.astype(np.float64):
        rotation, _ = polar(gradient)
        expected.append(rotation[:, 0])
    turn, *_ = models(f)
    assert_allclose(turn, expected, atol=2e-6)
    # A gradient without a direction (all zero, or a pure reflection) gives R = I.
    zero = np.zeros((2, 2))
    reflection = np.diag([1.0, -1.0])
    turn, *_ = models([zero, reflection])
    identity = [1.0, 0.0]
    assert turn.tolist() == [identity, identity]


def test_corotated_stress_is_the_derivative_of_its_energy() -> None:
    """Tau = (d psi / dF) F^T, with psi differentiated by central differences."""
    f = deformations(0.3)[:64]
    stress = models(f)[1]
    gradients = f.astype(np.float64)
    for m, tau in zip(gradients, stress, strict=True):
        assert_allclose(tau, corotated_stress(m), atol=1e-4)


def test_plastic_return_clamps_numpys_singular_values() -> None:
    """The elastic part is U clamp(Sigma) V^T of NumPy's SVD, and Jp takes the rest."""
    f = deformations(0.15)
    *_, elastic, ratio = models(f)
    expected, expected_ratio = clamped_stretches(f)
    assert_allclose(elastic, expected, atol=2e-5)
    assert_allclose(ratio, expected_ratio, rtol=2e-5)
    is_elastic = np.isclose(ratio, 1.0)
    assert is_elastic.mean() < 0.5


def test_inverted_snow_stays_finite() -> None:
    """Even a collapsed or inverted gradient gives a positive, finite volume ratio."""
    collapsed = np.zeros((2, 2))
    turned = -np.eye(2)
    reflected = np.diag([1.0, -1.0])
    swapped = np.eye(2)[::-1]
    gradients = [collapsed, turned, reflected, swapped]
    *_, elastic, ratio = models(gradients)
    assert np.isfinite(elastic).all()
    assert (ratio > 0.0).all()
    assert np.isfinite(ratio).all()


def test_lame_constants() -> None:
    """By hand; lambda + 2 mu equals E (1 - nu) / ((1 + nu)(1 - 2 nu)), the P-wave
    modulus.
    """
    # 40 / 2.5 and 40 * 0.25 / (1.25 * 0.5)
    assert constitutive.lame(40.0, 0.25) == (16.0, 16.0)
    assert constitutive.lame(30.0, 0.0) == (15.0, 0.0)
    mu, la = constitutive.lame(100.0, 0.3)
    wave_modulus = 100.0 * 0.7 / (1.3 * 0.4)
    assert math.isclose(la + 2.0 * mu, wave_modulus)
