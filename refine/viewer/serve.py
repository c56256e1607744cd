"""One page on this machine only: `127.0.0.1`, one address, nothing of the disk."""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Of the page; its own policy stands in it."""


def page_server(page: str, port: int = 0) -> ThreadingHTTPServer:
    """Return a server, already listening on the loopback interface, that answers `/` with the page.

    Any other path is not found, and a request under another name than this machine's is refused, so that
    no web site can have its own name lead here. It never opens a file.
    """
    content = page.encode("utf-8")

    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "refine", ""

        def do_GET(self) -> None:
            name, _, _ = self.headers.get("Host", "").rpartition(":")
            if name not in ("127.0.0.1", "localhost"):
                self.send_error(421)
            elif self.path.partition("?")[0] != "/":
                self.send_error(404)
            else:
                self.send_response(200)
                for header, value in HEADERS.items():
                    self.send_header(header, value)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

        def log_message(self, *arguments: Any) -> None:
            pass

    return ThreadingHTTPServer(("127.0.0.1", port), Handler)


def address(server: ThreadingHTTPServer) -> str:
    """Return where the page is."""
    return f"http://127.0.0.1:{server.server_port}/"
