"""What a reader of the leaderboard's page does: keys, clicks, addresses; what is then to be seen."""

from __future__ import annotations

import json
import time

from browser import Page

from lagbench.board.model import Row


def close(page: Page) -> None:
    """Close the tab."""
    target = page.browser.call("Target.getTargets")["targetInfos"]
    for one in target:
        if one["type"] == "page" and one["attached"]:
            page.browser.call("Target.closeTarget", targetId=one["targetId"])


def still(page: Page, motion: str = "reduce") -> None:
    """Ask for reduced motion."""
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": motion}])


def run(page: Page, statement: str) -> None:
    """Run a statement and whatever it sets going."""
    page.value(f"{statement}, 0")
    page.call("Runtime.evaluate", expression="new Promise(done => setTimeout(done, 30))", awaitPromise=True)


def press(page: Page, key: str, modifiers: int = 0) -> None:
    """Press a key, and wait for what it sets going."""
    page.press(key, modifiers)
    run(page, "0")


def until(page: Page, condition: str) -> None:
    """Wait some seconds for a condition; fail where it does not come true."""
    for _ in range(200):
        if page.value(condition):
            return
        time.sleep(0.03)
    raise AssertionError(condition)


def restored(page: Page, address: str) -> None:
    """Load the page anew at an address."""
    run(page, f"location.hash = {json.dumps(address)}")
    page.browser.events.clear()
    page.call("Page.reload")
    page.browser.wait("Page.loadEventFired")


def seen(page: Page) -> list[list[str]]:
    """Return the texts of the table in view: rank, name, numbers."""
    rows = "section.tab:not([hidden]) tr:is([data-entry], [data-floor]):not([hidden])"
    found: list[list[str]] = page.value(
        f"[...document.querySelectorAll('{rows}')].map(tr =>"
        " [tr.cells[0], tr.querySelector('.name'),"
        " ...[...tr.querySelectorAll('td:not(.rank, [hidden])')].map(td => td.firstChild)]"
        ".map(e => e.textContent))"
    )
    return found


def names(page: Page) -> list[str]:
    """Return the names of the entries in view, in order."""
    found: list[str] = page.value(
        "[...document.querySelectorAll('section.tab:not([hidden]) tr[data-entry]:not([hidden]) .name')]"
        ".map(e => e.textContent)"
    )
    return found


def active(rows: tuple[Row, ...]) -> list[Row]:
    """Return the entries that are shown at first."""
    return [row for row in rows if row.active]
