"""viser's web server behind the viewer's access policy and message validation."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import http
import io
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol

from morphgen.viewer.access import AccessPolicy, content_security_policy, refusal_reason
from morphgen.viewer.frame import frame_page
from morphgen.viewer.messages import message_fault
from morphgen.viewer.viser_internals import disable_share_links

MAX_REQUEST_LINE = 65_536
"""Longest first line of a request [bytes]. websockets' own limit of 8192 is below the longest
address of a page with its escapes, and closes the connection without an answer."""
_POLICY_VIOLATION = 1008
"""Close code of websockets (RFC 6455) for a message that violates the policy."""
_starting = threading.Lock()
"""Held while websockets' ``serve`` is replaced."""

Answer = Callable[[ServerConnection, Request], Response | None]
Receive = Callable[[str, str], bool]
"""Receives a request of a page's script: the token of the page, and a query. Returns whether there
is such a page."""
REQUESTS = "/morphgen/"
"""Path of these requests, before the token."""


class _OneLine(logging.Filter):
    """Logs a fault in one line without traceback, and nothing for requests that are not HTTP."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is logged."""
        error = record.exc_info[1] if record.exc_info else None
        record.exc_info = None
        if error is not None:
            record.msg, record.args = f"{record.getMessage()}: {error!r}", ()
        return not record.getMessage().startswith(("opening handshake failed", "connection "))


_LOG = logging.getLogger("morphgen.viewer.connections")
_LOG.addFilter(_OneLine())


class _Connection(ServerConnection):
    """A websocket that closes at the first message that no page of the viewer sends."""

    def __init__(self, protocol: ServerProtocol, *arguments: Any, **options: Any) -> None:  # noqa: ANN401  (as its base class)
        """Let the lines of a request be as long as ``MAX_REQUEST_LINE``."""
        super().__init__(protocol, *arguments, **options)
        read_line = protocol.reader.read_line
        protocol.reader.read_line = lambda m: read_line(max(m, MAX_REQUEST_LINE))  # type: ignore[method-assign]
        # The parser that websockets 14 to 16 started already reads lines by the old function.
        protocol.parser = protocol.parse()
        next(protocol.parser)

    async def recv(self, decode: bool | None = None) -> Any:  # noqa: ANN401  (as its base class)
        """Return the next message; viser never sees a malformed one."""
        data = await super().recv(decode)
        if fault := message_fault(data):
            await self.close(_POLICY_VIOLATION, fault[:120])
            return await super().recv(decode)  # raises ConnectionClosed
        return data


def start_server(
    host: str, port: int, policy: AccessPolicy, receive: Receive = lambda token, query: False
) -> viser.ViserServer:
    """Start viser's server; every request has to pass the access policy.

    Args:
        host: Address to bind.
        port: Port; if it is taken, the next free one.
        policy: The access policy.
        receive: Receives the requests of the pages' scripts.

    Raises:
        RuntimeError: If the installed viser does not start a websockets server.
    """
    with _starting, _guarded(policy, receive), contextlib.redirect_stdout(io.StringIO()):
        # Silent, because viser's banner would name the port before ``morphgen view`` does.
        server = viser.ViserServer(host=host, port=port, verbose=False)
    disable_share_links(server)
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, _print_fault)
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop viser's server without its message."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _guarded(policy: AccessPolicy, receive: Receive) -> Iterator[None]:
    """Apply the policy to the websockets server that viser starts meanwhile.

    viser passes no options to ``websockets.serve``, so the function itself is replaced.
    """
    module = websockets.asyncio.server
    original, started = module.serve, []

    def serve(*arguments: Any, process_request: Answer, **options: Any) -> Any:  # noqa: ANN401
        started.append(True)
        return original(
            *arguments,
            process_request=functools.partial(_answer, policy, receive, process_request),
            create_connection=_Connection,
            logger=_LOG,
            **options,
        )

    module.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        module.serve = original  # type: ignore[misc]
    if not started:
        raise RuntimeError("this version of viser does not start a websockets server to guard")


def _answer(
    policy: AccessPolicy,
    receive: Receive,
    serve_file: Answer,
    connection: ServerConnection,
    request: Request,
) -> Response | None:
    """Answer a request; None lets a websocket be opened."""
    if reason := refusal_reason(policy, request.path, request.headers):
        return _text_response(http.HTTPStatus.FORBIDDEN, reason)
    if request.path.startswith(REQUESTS):
        token, _, query = request.path.removeprefix(REQUESTS).partition("?")
        if receive(token, query):
            return _text_response(http.HTTPStatus.OK, "ok")
        return _text_response(http.HTTPStatus.NOT_FOUND, "there is no such page any more.")
    try:
        response = serve_file(connection, request)
    except (OSError, ValueError):  # the path is not a valid file name
        return _text_response(http.HTTPStatus.NOT_FOUND, "there is no such file.")
    if response is not None:
        if request.path.partition("?")[0] in ("/", "/index.html"):
            frame_page(response)
        csp = content_security_policy(policy, request.headers["Host"])
        response.headers["Content-Security-Policy"] = csp
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "same-origin"
    return response


def _text_response(status: http.HTTPStatus, text: str) -> Response:
    body = f"morphgen view: {text}\n".encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8"})
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status, status.phrase, headers, body)


def _print_fault(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print in one line the error that a browser's message has caused in viser."""
    error = context.get("exception")
    text = context["message"] if error is None else f"{type(error).__name__}: {error}"
    print(f"morphgen: a browser's message failed: {' '.join(text.split())}", file=sys.stderr)
