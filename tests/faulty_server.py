"""An HTTP server over a folder that answers as told: rightly, or with a fault of its
own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

PAGE = b"<!doctype html><html><body>Please log in</body></html>"


@dataclass
class Mirror:
    """What a server does and what it was asked.

    Attributes:
        folder: what it serves.
        faults: ending of a path to the fault of its answers, see ``_Handler``.
        asked: path and Range header of every request.
        url: base URL.
    """

    folder: Path
    faults: dict[str, str] = field(default_factory=dict)
    asked: list[tuple[str, str | None]] = field(default_factory=list)
    url: str = ""

    def fault_of(self, path: str) -> str:
        """Return the fault of a path, "" for none."""
        return next(
            (fault for ending, fault in self.faults.items() if path.endswith(ending)),
            "",
        )

    def count(self, ending: str) -> int:
        """Return how often paths with an ending were asked for."""
        return sum(path.endswith(ending) for path, _ in self.asked)


class _Handler(BaseHTTPRequestHandler):
    """Answers GET; faults are named after what they do."""

    mirror: Mirror

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        fault = self.mirror.fault_of(self.path)
        self.mirror.asked.append((self.path, wanted))
        path = self.mirror.folder / self.path.lstrip("/")
        if fault == "page":
            return self._send(200, PAGE, {"Content-Type": "text/html; charset=utf-8"})
        if fault == "hidden page":
            return self._send(200, PAGE)
        if fault == "busy":
            return self._send(503, b"later")
        if fault == "forbidden":
            return self._send(403, b"no")
        if fault == "elsewhere":
            return self._send(302, b"", {"Location": "file:///etc/passwd"})
        if fault == "other kind":
            return self._send(302, b"", {"Location": "ftp://localhost/data"})
        if fault == "nowhere":
            return self._send(302, b"", {"Location": "http://[::1"})
        if fault == "busy once" and self.mirror.count(self.path) == 1:
            return self._send(503, b"later")
        if fault == "gone" or not path.is_file():
            return self._send(404, PAGE, {"Content-Type": "text/html"})
        return self._file(path.read_bytes(), wanted, fault)

    def _file(self, data: bytes, wanted: str | None, fault: str) -> None:
        if fault == "flipped":
            data = data[:-500] + bytes([data[-500] ^ 1]) + data[-499:]
        if fault == "chopped":  # and the length is that of what is sent
            data = data[: len(data) // 2]
        start = 0
        whole = len(data)
        if wanted and fault not in ("no ranges", "drops and starts over"):
            start = int(wanted.removeprefix("bytes=").split("-")[0])
            if start >= whole:
                return self._send(416, b"", {"Content-Range": f"bytes */{whole}"})
        status = 206 if start else 200
        headers = (
            {"Content-Range": f"bytes {start}-{whole - 1}/{whole}"} if start else {}
        )
        body = data[start:]
        match fault:
            case (
                "drops" | "no ranges"
            ):  # after a third of the file, at the first two requests for it
                late = self.mirror.count(self.path) > 2
                return self._send(
                    status, body, headers, only=None if late else whole // 3
                )
            case "drops and starts over":
                return self._send(status, body, headers, only=whole // 3)
            case "drops always":
                return self._send(status, body, headers, only=0)
            case "announces more":
                return self._send(status, body, headers, length=len(body) + 1000)
            case "announces less":
                return self._send(status, body, headers, length=len(body) - 1000)
            case "ends early":  # says nothing of a length, and stops
                return self._send(status, body[: len(body) // 2], headers, length=-1)
            case "wrong range" if start:
                headers["Content-Range"] = f"bytes {start + 7}-{whole - 1}/{whole}"
            case "announces a number without end":
                return self._send(
                    status, body, {**headers, "Content-Length": "9" * 5000}, length=-1
                )
            case "endless":
                return self._endless()
            case "slow":
                return self._slow(body)
        return self._send(status, body, headers)

    def _endless(self) -> None:
        self.send_response(200)
        self.end_headers()
        try:
            self.wfile.write(b"\x89HDF\r\n\x1a\n")
            for _ in range(1000):
                self.wfile.write(bytes(1 << 16))
        except OSError:
            return

    def _slow(self, body: bytes) -> None:
        """Announce all of it, and send a hundred bytes a second one by one."""
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        try:
            for place in range(len(body)):
                self.wfile.write(body[place : place + 1])
                time.sleep(0.01)
        except OSError:
            return

    def _send(
        self,
        status: int,
        body: bytes,
        headers: dict[str, str] | None = None,
        *,
        length: int | None = None,
        only: int | None = None,
    ) -> None:
        """Answer; ``length`` is what is announced (-1: nothing), ``only`` how much is
        sent.
        """
        self.send_response(status)
        if length != -1:
            self.send_header(
                "Content-Length", str(len(body) if length is None else length)
            )
        for name, value in {
            "Content-Type": "application/x-netcdf",
            **(headers or {}),
        }.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body[:only])
        self.close_connection = True

    def log_message(self, *_: Any) -> None:
        """Keep quiet."""


@contextmanager
def serving(folder: Path) -> Iterator[Mirror]:
    """Serve a folder on a port of this machine."""
    mirror = Mirror(folder)
    handler = type("Handler", (_Handler,), {"mirror": mirror})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    mirror.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(
        target=server.serve_forever, kwargs={"poll_interval": 0.02}
    )
    thread.start()
    try:
        yield mirror
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
