"""The server of one page: loopback only, one address, no files."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator
from http.server import ThreadingHTTPServer

import pytest

from refine.viewer.serve import address, page_server

PAGE = "<!doctype html><title>wall - refine</title>"


@pytest.fixture
def server() -> Iterator[ThreadingHTTPServer]:
    with page_server(PAGE) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def get(server: ThreadingHTTPServer, path: str, **headers: str) -> tuple[int, str, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), dict(answer.getheaders())
    finally:
        connection.close()


def test_the_page_is_served_as_it_is(server: ThreadingHTTPServer) -> None:
    status, text, headers = get(server, "/")
    assert (status, text) == (200, PAGE)
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert address(server) == f"http://127.0.0.1:{server.server_port}/"


def test_it_listens_on_the_loopback_interface_only(server: ThreadingHTTPServer) -> None:
    assert server.socket.family == socket.AF_INET
    assert server.socket.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/etc/passwd",
        "//etc/passwd",
        "/./",
        "/..",
        "/favicon.ico",
        "/index.html",
        "/\\..\\..",
        "file:///etc/passwd",
    ],
)
def test_nothing_else_is_found(server: ThreadingHTTPServer, path: str) -> None:
    status, text, _ = get(server, path)
    assert status == 404
    assert "root:" not in text


@pytest.mark.parametrize("name", ["evil.example", "evil.example:80", "127.0.0.1.evil.example:80", ""])
def test_other_names_are_refused(server: ThreadingHTTPServer, name: str) -> None:
    status, text, _ = get(server, "/", Host=name)
    assert status == 421
    assert PAGE not in text
