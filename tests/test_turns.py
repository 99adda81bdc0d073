"""Which slow tests run at a commit."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest
import turns
from turns import leave_out_slow_tests


@dataclass(frozen=True)
class Item:
    """What pytest says of a test that it collected."""

    nodeid: str
    is_slow: bool

    def get_closest_marker(self, name: str) -> str | None:
        """Return the marker of a name, or None."""
        return name if name == "slow" and self.is_slow else None


@dataclass
class Config:
    """What pytest is told of tests that do not run."""

    left_out: list[Item] = field(default_factory=list)

    @property
    def hook(self) -> Any:
        """The calls that pytest offers."""

        def pytest_deselected(items: list[Item]) -> None:
            self.left_out.extend(items)

        return SimpleNamespace(pytest_deselected=pytest_deselected)


SLOW = [Item(f"slow {number}", is_slow=True) for number in range(300)]
QUICK = [Item(f"quick {number}", is_slow=False) for number in range(2)]


def test_a_share_of_the_slow_tests_runs_and_each_has_its_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A third of the slow tests runs in each turn, and the others always; in 30 turns
    all run. What does not run is reported to pytest.
    """
    monkeypatch.delenv("LAGBENCH_TURN", raising=False)
    monkeypatch.setenv("LAGBENCH_SLOW_SHARE", "0.33")
    slow_that_ran: set[Item] = set()
    for turn in range(30):
        monkeypatch.setattr(turns, "turn", lambda number=turn: number)
        config: Any = Config()
        items: Any = [QUICK[0], *SLOW, QUICK[1]]
        leave_out_slow_tests(config, items)
        assert [item for item in items if not item.is_slow] == QUICK
        assert {*items, *config.left_out} == {*QUICK, *SLOW}
        assert 70 <= len(items) <= 130
        slow_that_ran.update(item for item in items if item.is_slow)
    assert slow_that_ran == set(SLOW)


@pytest.mark.parametrize(
    ("name", "value"), [("LAGBENCH_TURN", "all"), ("LAGBENCH_SLOW_SHARE", "1")]
)
def test_all_slow_tests_run_on_request(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A share of 1 leaves none out, and neither does ``LAGBENCH_TURN=all``."""
    monkeypatch.setenv("LAGBENCH_SLOW_SHARE", "0.33")
    monkeypatch.setenv(name, value)
    config: Any = Config()
    items: Any = list(SLOW)
    leave_out_slow_tests(config, items)
    assert items == SLOW
