"""An HTTP server over a folder that answers as told: rightly, or with a fault of its
own.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


@dataclass
class Mirror:
    """What a server does and what it was asked.

    Attributes:
        folder: what it serves.
        faults: ending of a path to the fault of its answers, see ``_Handler``.
        asked: path of every request.
        url: base URL.
    """

    folder: Path
    faults: dict[str, str] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    url: str = ""

    def fault_of(self, path: str) -> str:
        """Return the fault of a path, "" for none."""
        return next(
            (fault for ending, fault in self.faults.items() if path.endswith(ending)),
            "",
        )

    def count(self, ending: str) -> int:
        """Return how often paths with an ending were asked for."""
        return sum(path.endswith(ending) for path in self.asked)


class _Handler(BaseHTTPRequestHandler):
    """Answers GET; faults are named after what they do."""

    mirror: Mirror

    def do_GET(self) -> None:
        fault = self.mirror.fault_of(self.path)
        self.mirror.asked.append(self.path)
        path = self.mirror.folder / self.path.lstrip("/")
        if fault == "busy once" and self.mirror.count(self.path) == 1:
            return self._send(503, b"later")
        if fault == "gone" or not path.is_file():
            return self._send(404, b"")
        data = path.read_bytes()
        return self._send(200, data, sent=0 if fault == "drops always" else None)

    def _send(self, status: int, body: bytes, sent: int | None = None) -> None:
        """Answer; ``sent`` is how much of the announced body is sent."""
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[:sent])
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
