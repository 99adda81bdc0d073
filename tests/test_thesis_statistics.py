"""The statistics of train beside Tables 5.1 and 5.3; the velocity scales were set to meet them."""

import pytest

from lagbench.data.registry import load


@pytest.mark.parametrize(
    ("split", "expected"),
    [("cavity", (0.002191, 0.002195)), ("curl-noise", (1.600e-03, 1.600e-03))],
)
def test_velocity_deviation(split: str, expected: tuple[float, float]) -> None:
    """The standard deviation of the per-frame velocity is within 5 % of the thesis, per component."""
    measured = load().size(split, "full").measured
    assert measured is not None
    assert measured.statistics["velocity_std"] == pytest.approx(expected, rel=0.05)


def test_curl_noise_fills_its_box() -> None:
    """Positions spread as in Table 5.1 (0.272), which a uniform box of this width gives within 2 %."""
    size = load().size("curl-noise", "full")
    measured = size.measured
    assert measured is not None
    (low, high), _ = size.bounds
    uniform = (high - low) / 12**0.5
    assert measured.statistics["position_std"] == pytest.approx((uniform, uniform), rel=1e-3)
    assert uniform == pytest.approx(0.272, rel=0.02)
