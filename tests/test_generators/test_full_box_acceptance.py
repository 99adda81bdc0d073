"""The solver of full boxes against closed forms; ``python -m validation.flows`` runs
the costly cases.
"""

from __future__ import annotations

import pytest

from validation import flows


@pytest.mark.slow
def test_a_periodic_vortex_decays_as_navier_stokes_says() -> None:
    """After ten turnovers the energy is within 1 % of exp(-4 nu k^2 t)."""
    result = flows.taylor_green()
    assert result.deviation <= result.tolerance
    assert result.truth == pytest.approx(0.67, abs=0.01)
