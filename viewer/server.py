"""viser's server behind a gate: who may ask it, and which messages it takes."""

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
import websockets.http11
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from morphgen.viewer.access import AccessPolicy, policy, refusal_reason
from morphgen.viewer.messages import message_fault

LONGEST_LINE = 65_536
"""Bytes of a request's line. Beyond websockets' own 8,192 a browser would be told nothing."""
_POLICY_VIOLATION = 1008
"""Code with which a websocket is closed."""
_starting = threading.Lock()

Answer = Callable[[ServerConnection, Request], Response | None]


class _OneLine(logging.Filter):
    """Keeps the log to one line a fault, and silent on requests that are no HTTP."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is logged; its traceback is not."""
        error = record.exc_info[1] if record.exc_info else None
        record.exc_info = None
        if error is not None:
            record.msg, record.args = f"{record.getMessage()}: {error!r}", ()
        return not record.getMessage().startswith(("opening handshake failed", "connection "))


_LOG = logging.getLogger("morphgen.viewer.connections")
_LOG.addFilter(_OneLine())


class _Connection(ServerConnection):
    """A websocket that is closed at the first message that no page of the viewer sends."""

    async def recv(self, decode: bool | None = None) -> Any:  # noqa: ANN401  (as its base)
        """The next message; what is malformed ends the connection before viser sees it."""
        data = await super().recv(decode)
        if fault := message_fault(data):
            await self.close(_POLICY_VIOLATION, fault[:120])
            return await super().recv(decode)  # raises that it is closed
        return data


def start_server(host: str, port: int, gate: AccessPolicy) -> viser.ViserServer:
    """Start viser's server; every request goes by the gate.

    Raises:
        RuntimeError: If this version of viser starts its server otherwise.
    """
    with _starting, _gated(gate), contextlib.redirect_stdout(io.StringIO()):
        # its banner names the port before we do
        server = viser.ViserServer(host=host, port=port, verbose=False)
    # Whoever sends one of these would open the page to the internet, by way of another server.
    for request in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(request)
    loop = server._event_loop
    loop.call_soon_threadsafe(loop.set_exception_handler, _tell_fault)
    return server


@contextlib.contextmanager
def _gated(gate: AccessPolicy) -> Iterator[None]:
    """Have the server that viser starts ask the gate; viser has no setting for it."""
    module = websockets.asyncio.server
    plain, started = module.serve, []
    websockets.http11.MAX_LINE_LENGTH = LONGEST_LINE

    def serve(*arguments: Any, process_request: Answer, **options: Any) -> Any:  # noqa: ANN401
        started.append(True)
        return plain(
            *arguments,
            process_request=functools.partial(_answer, gate, process_request),
            create_connection=_Connection,
            logger=_LOG,
            **options,
        )

    module.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        module.serve = plain  # type: ignore[misc]
    if not started:
        raise RuntimeError("this version of viser starts no websockets server that could be gated")


def _answer(
    gate: AccessPolicy, plain: Answer, connection: ServerConnection, request: Request
) -> Response | None:
    """Answer a request; None lets a websocket be opened."""
    if why := refusal_reason(gate, request.path, request.headers):
        return _sentence(http.HTTPStatus.FORBIDDEN, why)
    try:
        response = plain(connection, request)
    except (OSError, ValueError):  # a path that no file system takes
        return _sentence(http.HTTPStatus.NOT_FOUND, "there is no such file.")
    if response is not None:
        response.headers["Content-Security-Policy"] = policy(gate, request.headers["Host"])
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "same-origin"
    return response


def _sentence(status: http.HTTPStatus, text: str) -> Response:
    body = f"morphgen view: {text}\n".encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8"})
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status, status.phrase, headers, body)


def _tell_fault(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Tell in one line what a browser's message has made go wrong."""
    error = context.get("exception")
    text = context["message"] if error is None else f"{type(error).__name__}: {error}"
    print(f"morphgen: a browser's message failed: {' '.join(text.split())}", file=sys.stderr)
