"""Pages of other sites cannot use the viewer, whatever host name or origin they send."""

import http.client
import re

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus

from helpers.viser_client import PlainClient
from morphgen.errors import MorphgenError
from morphgen.viewer.app.server import AccessPolicy, access_policy, refusal_reason, start_server

HUB = "https://hub.example.com"


def asked(gate, host, origin=None, path="/"):
    headers = Headers({"Host": host} if host is not None else {})
    if origin is not None:
        headers["Origin"] = origin
    return refusal_reason(gate, path, headers)


@pytest.mark.parametrize(
    ("bound", "host", "origin"),
    [
        ("127.0.0.1", "localhost:8080", None),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("127.0.0.1", "LOCALHOST:8080", "http://localhost:8080"),
        ("::1", "[::1]:8080", "http://[::1]:8080"),
        ("127.0.0.1", "localhost:9000", "http://localhost:9000"),  # ssh -L 9000:localhost:8080
        ("127.0.0.1", "localhost", "https://localhost"),  # behind a proxy with TLS
        ("127.0.0.1", "localhost:8080", HUB),  # a proxy that keeps the origin
        ("127.0.0.1", "hub.example.com", HUB),  # a proxy that keeps both
        ("box", "box:8080", "http://box:8080"),
        ("192.168.1.5", "192.168.1.5:8080", "http://192.168.1.5:8080"),
        ("0.0.0.0", "192.168.1.5:8080", "http://192.168.1.5:8080"),
        ("0.0.0.0", "localhost:8080", None),
        ("::", "[fe80::1]:8080", "http://[fe80::1]:8080"),
    ],
)
def test_own_host_names_and_allowed_origins_are_accepted(bound, host, origin):
    assert asked(access_policy(bound, [HUB]), host, origin) == ""


@pytest.mark.parametrize(
    ("bound", "host", "origin"),
    [
        ("127.0.0.1", "localhost:8080", "http://evil.example"),
        ("127.0.0.1", "localhost:8080", "null"),
        ("127.0.0.1", "localhost:8080", ""),
        ("127.0.0.1", "localhost:8080", "http://localhost:3000"),
        ("127.0.0.1", "localhost:8080", "http://127.0.0.1:8080"),
        ("127.0.0.1", "localhost:8080", "file://localhost:8080"),
        ("127.0.0.1", "localhost:8080", "http://localhost:99999"),
        ("127.0.0.1", "localhost:8080", "http://localhost.evil.example:8080"),
        ("127.0.0.1", "evil.example:8080", "http://evil.example:8080"),  # DNS rebinding
        ("127.0.0.1", "evil.example:8080", None),
        ("127.0.0.1", "localhost.:8080", None),
        ("127.0.0.1", "me@localhost:8080", None),
        ("127.0.0.1", "localhost:8080/x", None),
        ("127.0.0.1", "192.168.1.5:8080", None),
        ("127.0.0.1", "", None),
        ("127.0.0.1", "[::1", None),
        ("127.0.0.1", None, None),
        ("0.0.0.0", "evil.example:8080", "http://evil.example:8080"),
        ("0.0.0.0", "192.168.1.5:8080", "http://203.0.113.9"),
        ("0.0.0.0", "192.168.1.5:8080", "http://evil.example"),
    ],
)
def test_other_host_names_and_origins_are_rejected(bound, host, origin):
    assert asked(access_policy(bound), host, origin)


def test_duplicate_host_or_origin_headers_are_rejected():
    for key in ("Host", "Origin"):
        headers = Headers([("Host", "localhost"), ("Origin", "http://localhost")])
        headers[key] = headers[key]
        assert refusal_reason(AccessPolicy(), "/", headers).startswith("expected one Host")


@pytest.mark.parametrize(
    "query",
    [
        "websocket=wss://evil.example",
        "robot=x&websocket=ws://evil.example:8080/",
        "websocket=",
        "playbackPath=a.viser",
        "%77ebsocket=wss://evil.example&robot=x",
    ],
)
def test_url_cannot_connect_to_another_server(query):
    assert "another server" in asked(AccessPolicy(), "localhost:8080", path=f"/?{query}")


@pytest.mark.parametrize(
    "origin", ["null", "*", "evil.example", "http://", "http://a/b", "ftp://a", "http://u@a", ""]
)
def test_malformed_origin_is_rejected(origin):
    with pytest.raises(MorphgenError, match=re.escape(f"--allow-origin {origin!r}: expected")):
        access_policy("127.0.0.1", [origin])


@pytest.mark.parametrize(
    ("host", "origin", "why"),
    [
        (None, "http://evil.example", b"may not use this viewer"),
        ("evil.example", "http://evil.example", b"is not a name of this viewer"),
    ],
)
def test_foreign_origin_or_host_name_gets_no_websocket(shared_viewer, host, origin, why):
    with pytest.raises(InvalidStatus) as refused:
        PlainClient(shared_viewer.port, host=host, origin=origin)
    assert refused.value.response.status_code == 403
    assert why in refused.value.response.body


@pytest.mark.parametrize("origin", [None, "http://127.0.0.1:{port}", HUB])
def test_own_pages_and_allowed_origins_get_a_websocket(viewer, origin):
    on = viewer(origins=[HUB])
    with PlainClient(on.port, origin=origin and origin.format(port=on.port)) as client:
        client.shows("Grammars")


def fetched(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for key, value in headers.items():
        connection.putheader(key, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer, answer.read()


def test_pages_are_served_only_to_own_host_names(viewer, capfd):
    port = viewer().port
    answer, page = fetched(port, Host=f"localhost:{port}")
    assert (answer.status, b"<html" in page) == (200, True)
    assert b">Playback</a>" in page  # the bar is there before a page is built
    assert f"connect-src 'self' ws://localhost:{port} " in answer.headers["Content-Security-Policy"]
    assert "frame-ancestors 'self' ;" in answer.headers["Content-Security-Policy"]
    for headers in (
        {"Host": "evil.example"},
        {"Host": f"localhost:{port}", "Origin": "http://evil.example"},
        {},
    ):
        answer, page = fetched(port, **headers)
        assert (answer.status, b"<html" in page) == (403, False)
    answer, page = fetched(port, "/?websocket=wss://evil.example", Host="localhost")
    assert (answer.status, b"another server" in page) == (403, True)
    for path in ("/%00", "/" + "a" * 9000, "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd"):
        answer, page = fetched(port, path, Host="localhost")
        assert (answer.status, b"root:" in page) == (404, False)
    assert capfd.readouterr() == ("", "")


def test_invalid_requests_leave_no_traceback(viewer, capfd):
    port = viewer().port
    for data in (b"\x16\x03\x01\x02\x00", b"GET / HTTP/1.1\r\nHost", b"a" * 70_000, b"\r\n\r\n"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.connect()
        connection.sock.sendall(data)
        connection.close()
    assert fetched(port, Host="localhost")[0].status == 200
    assert capfd.readouterr() == ("", "")


def test_recording_server_rejects_all_clients():
    server = start_server("127.0.0.1", 0, AccessPolicy(names=frozenset()))
    try:
        with pytest.raises(InvalidStatus):
            PlainClient(server.get_port())
    finally:
        server.stop()
