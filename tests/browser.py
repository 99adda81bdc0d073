"""Headless Chromium by its DevTools protocol over a pipe: no port, no driver, no
package.
"""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
"""The browser; None where there is none (Debian: apt-get install chromium)."""

FLAGS = (
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
    ),
    *(
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ),
    *("--disable-dev-shm-usage", "--hide-scrollbars", "--remote-debugging-pipe"),
)

MOST_SECONDS = 120.0
"""A browser that says nothing for so long has failed [s]."""

KEYS = {
    "Enter": (13, "\r"),
    "Tab": (9, ""),
    "Escape": (27, ""),
    "ArrowRight": (39, ""),
    "End": (35, ""),
    "/": (191, "/"),
}

CLEAR = 60
MARKED = 20
"""A pixel changes clearly by so many of 255 levels of grey; so many of them are a mark.
"""


@dataclass
class Page:
    """What a browser saw when it opened a page.

    Attributes:
        messages: console messages, log entries and exceptions.
        requests: addresses asked for, data: aside.
    """

    browser: Browser
    session: str
    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def value(self, expression: str) -> Any:
        """Return what an expression evaluates to."""
        said = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return said["result"]["value"]

    def screenshot(self) -> bytes:
        """Return what is to be seen as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def press(self, key: str, modifiers: int = 0) -> None:
        """Press a key and let go of it."""
        code, text = KEYS[key]
        about = {"key": key, "windowsVirtualKeyCode": code, "modifiers": modifiers}
        self.call("Input.dispatchKeyEvent", type="keyDown", text=text, **about)
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)

    def focus_shows(self, selector: str) -> bool:
        """Return whether focus is to be seen around an element: 20 pixels change
        clearly.

        The page must know a reader who uses the keyboard: press a key first.
        """
        self.value("document.activeElement.blur(), 0")
        box = self.value(
            f"(e => {{ e.scrollIntoView({{block: 'center'}});"
            " const b = e.getBoundingClientRect();"
            " return {x: b.x + scrollX - 6, y: b.y + scrollY - 6, width: b.width + "
            "12, height: b.height + 12}"
            f" }})(document.querySelector({json.dumps(selector)}))"
        )
        pictures = []
        for _ in range(2):
            data = self.call("Page.captureScreenshot", clip={**box, "scale": 1})["data"]
            picture = Image.open(io.BytesIO(base64.b64decode(data))).convert("L")
            pictures.append(np.asarray(picture, np.int16))
            self.value(
                f"document.querySelector({json.dumps(selector)})"
                ".focus({preventScroll: true}), 0"
            )
        return bool((abs(pictures[1] - pictures[0]) > CLEAR).sum() >= MARKED)

    def pdf(self) -> bytes:
        """Return the page as printed."""
        return base64.b64decode(self.call("Page.printToPDF")["data"])

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the page."""
        answer = self.browser.call(method, self.session, **parameters)
        self._notice()
        return answer

    def _notice(self) -> None:
        for event in self.browser.events:
            method = event["method"]
            said = event["params"]
            if method in (
                "Log.entryAdded",
                "Runtime.consoleAPICalled",
                "Runtime.exceptionThrown",
            ):
                self.messages.append(json.dumps(said))
            if method == "Network.requestWillBeSent" and not said["request"][
                "url"
            ].startswith("data:"):
                self.requests.append(said["request"]["url"])
        self.browser.events.clear()


class Browser:
    """A running browser."""

    def __init__(self, write: int, read: int) -> None:
        self._out = os.fdopen(write, "wb", 0)
        self._in = os.fdopen(read, "rb")
        self._number = 0
        self._rest = b""
        self.events: list[dict[str, Any]] = []

    def call(
        self, method: str, session: str | None = None, **parameters: Any
    ) -> dict[str, Any]:
        """Call a method and return its answer; events on the way are kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        self._out.write(json.dumps(message).encode() + b"\0")
        while True:
            said = self._receive()
            if said.get("id") == self._number:
                if "error" in said:
                    raise RuntimeError(f"{method}: {said['error']}")
                return dict(said["result"])
            if "method" in said:
                self.events.append(said)

    def wait(self, method: str) -> None:
        """Wait for an event."""
        while not any(event["method"] == method for event in self.events):
            said = self._receive()
            if "method" in said:
                self.events.append(said)

    def open(
        self, path: Path, *, width: int, height: int = 900, dark: bool = False
    ) -> Page:
        """Open a file in a new tab and wait until it is loaded."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        page = Page(self, session)
        for domain in ("Page", "Network", "Log", "Runtime"):
            page.call(f"{domain}.enable")
        size = {
            "width": width,
            "height": height,
            "deviceScaleFactor": 1,
            "mobile": width < 600,
        }
        page.call("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.call("Emulation.setEmulatedMedia", features=[scheme])
        page.call("Page.navigate", url=path.absolute().as_uri())
        self.wait("Page.loadEventFired")
        wait_for_script(page)
        return page

    def close(self) -> None:
        """Close the pipe."""
        self._out.close()
        self._in.close()

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            readable, _, _ = select.select([self._in], [], [], MOST_SECONDS)
            if not readable:
                raise RuntimeError(f"the browser was silent for {MOST_SECONDS:.0f} s")
            piece = os.read(self._in.fileno(), 1 << 20)
            if not piece:
                raise RuntimeError("the browser has gone")
            self._rest += piece
        message, _, self._rest = self._rest.partition(b"\0")
        return dict(json.loads(message))


@contextmanager
def browser() -> Iterator[Browser]:
    """Start a browser with a profile of its own; stop it at the end."""
    theirs_in, ours_out = os.pipe()
    ours_in, theirs_out = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        # the protocol wants descriptors 3 and 4
        shell = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
        command = [
            "bash",
            "-c",
            shell,
            "bash",
            str(CHROMIUM),
            *FLAGS,
            f"--user-data-dir={profile}",
        ]
        process = subprocess.Popen(
            command,
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        running = Browser(ours_out, ours_in)
        try:
            yield running
        finally:
            running.close()
            process.terminate()
            process.wait(10)


def close(page: Page) -> None:
    """Close the tab."""
    target = page.browser.call("Target.getTargets")["targetInfos"]
    for one in target:
        if one["type"] == "page" and one["attached"]:
            page.browser.call("Target.closeTarget", targetId=one["targetId"])


def still(page: Page, motion: str = "reduce") -> None:
    """Ask for reduced motion."""
    page.call(
        "Emulation.setEmulatedMedia",
        features=[{"name": "prefers-reduced-motion", "value": motion}],
    )


def run(page: Page, statement: str) -> None:
    """Run a statement and whatever it sets going."""
    page.value(f"{statement}, 0")
    page.call(
        "Runtime.evaluate",
        expression="new Promise(done => setTimeout(done, 30))",
        awaitPromise=True,
    )


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


def wait_for_script(page: Page) -> None:
    """Wait until the script of a leaderboard has decompressed its data and drawn."""
    has_data = "document.getElementById('page-data') !== null"
    is_ready = "document.documentElement.dataset.ready !== undefined"
    until(page, f"!({has_data}) || {is_ready}")


def restored(page: Page, address: str) -> None:
    """Load the page anew at an address."""
    run(page, f"location.hash = {json.dumps(address)}")
    page.browser.events.clear()
    page.call("Page.reload")
    page.browser.wait("Page.loadEventFired")
    wait_for_script(page)


def seen(page: Page) -> list[list[str]]:
    """Return the texts of the table in view: rank, name, numbers."""
    rows = (
        "section.tab:not([hidden]) tr:is([data-entry], [data-reference]):not([hidden])"
    )
    found: list[list[str]] = page.value(
        f"[...document.querySelectorAll('{rows}')].map(tr =>"
        " [tr.cells[0], tr.querySelector('.name'),"
        " ...[...tr.querySelectorAll('td:not(.rank, [hidden])')].map(td => "
        "td.firstChild)]"
        ".map(e => e.textContent))"
    )
    return found


def names(page: Page) -> list[str]:
    """Return the names of the entries in view, in order."""
    found: list[str] = page.value(
        "[...document.querySelectorAll('section.tab:not([hidden]) "
        "tr[data-entry]:not([hidden]) .name')]"
        ".map(e => e.textContent)"
    )
    return found
