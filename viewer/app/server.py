"""viser's web server behind the viewer's access policy and message validation."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import http
import io
import ipaddress
import logging
import math
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol

from morphgen.errors import MorphgenError
from morphgen.viewer.app import viser_internals
from morphgen.viewer.app.frame import frame_page

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")  # names of this machine that nobody else can claim
_PORTS = {"http": 80, "https": 443}
_FOREIGN = ("websocket", "playbackPath")
"""Query keys that make viser's page show another server, or a file, under this viewer's name."""


@dataclass(frozen=True)
class AccessPolicy:
    """Names by which a viewer may be addressed, and sites that may use it."""

    names: frozenset[str] = frozenset(LOCAL_NAMES)  # host names and IP addresses, in lower case
    any_address: bool = False  # whether every IP address is a name: the viewer listens on all
    origins: frozenset[str] = frozenset()  # other sites that may use it: `https://hub.example.com`


def access_policy(host: str, origins: Sequence[str] = ()) -> AccessPolicy:
    """Return the access policy of a viewer."""
    address = host.strip("[]")
    names = {*LOCAL_NAMES, address.lower()}
    # Binding "", 0.0.0.0 or :: listens on all addresses.
    any_address = not host or (
        _is_ip_address(address) and ipaddress.ip_address(address).is_unspecified
    )
    if any_address:
        names |= {name.lower() for name in (socket.gethostname(), socket.getfqdn()) if name}
    return AccessPolicy(frozenset(names), any_address, frozenset(map(_parse_origin, origins)))


def refusal_reason(policy: AccessPolicy, path: str, headers: Headers) -> str:
    """Return in one sentence why a request is refused; empty if it is answered.

    A request without ``Origin`` does not come from a page of another site, because browsers send
    ``Origin`` with every websocket. So programs on this machine may connect without one.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return "expected one Host and at most one Origin in the request."
    host = hosts[0].lower()
    if not _is_viewer_name(policy, host):
        return (
            f"{hosts[0][:100]!a} is not a name of this viewer; open it as localhost, or start it "
            "with --host NAME or --allow-origin http://NAME."
        )
    if origins and not _is_allowed_origin(policy, origins[0], host):
        return (
            f"a page of {origins[0][:100]!a} may not use this viewer; if it is yours, start the "
            "viewer with --allow-origin and its origin."
        )
    query = parse_qsl(urlsplit(path).query, keep_blank_values=True)
    if any(key in _FOREIGN for key, _ in query):
        return f"an address with {'= or '.join(_FOREIGN)}= would show another server."
    return ""


def content_security_policy(policy: AccessPolicy, host: str) -> str:
    """Return the Content-Security-Policy of the page: its connections, and who may embed it.

    Second defence: without it, viser's page would connect to any server that its address names, and
    run what that server sends.
    """
    sites = " ".join(sorted(policy.origins))
    sockets = " ".join(f"ws{origin[4:]}" for origin in sorted(policy.origins))
    return (
        f"connect-src 'self' ws://{host} wss://{host} {sockets} data: blob:; "
        f"frame-ancestors 'self' {sites}; object-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _is_viewer_name(policy: AccessPolicy, netloc: str) -> bool:
    """Return whether a host names this viewer, at any port, because of tunnels (``ssh -L``)."""
    url = _split_url(f"http://{netloc}")
    if url is None or url.username is not None or url.netloc != netloc or not url.hostname:
        return False
    return (
        url.hostname in policy.names
        or (policy.any_address and _is_ip_address(url.hostname))
        or any(url.netloc == urlsplit(origin).netloc for origin in policy.origins)
    )


def _is_allowed_origin(policy: AccessPolicy, origin: str, host: str) -> bool:
    """Return whether a site is allowed, or the viewer itself under the name it was addressed by."""
    site = _split_url(origin)
    if site is None or site.scheme not in _PORTS:
        return False
    viewer = _split_url(f"{site.scheme}://{host}")
    return viewer is not None and _normalized(site) in {_normalized(viewer), *policy.origins}


def _normalized(url: SplitResult) -> str:
    """Return an origin in one spelling: lower case, without the default port of its scheme."""
    name = f"[{url.hostname}]" if ":" in (url.hostname or "") else url.hostname
    port = "" if url.port in (None, _PORTS[url.scheme]) else f":{url.port}"
    return f"{url.scheme}://{name}{port}"


def _parse_origin(text: str) -> str:
    """Return an origin from the command line in its normalized spelling."""
    url = _split_url(text.strip())
    plain = url is not None and not (url.path.strip("/") or url.query or url.fragment)
    if url is None or not plain or url.scheme not in _PORTS or not url.hostname or "@" in text:
        raise MorphgenError(
            f"--allow-origin {text!r}: expected a site such as https://hub.example.com or "
            "http://box:8080, without a path"
        )
    return _normalized(url)


def _split_url(url: str) -> SplitResult | None:
    """Split a URL; None if it is malformed."""
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018  (raises ValueError for a port that is not a number)
    except ValueError:
        return None
    return parts


def _is_ip_address(name: str) -> bool:
    """Return whether a host name is an IP address without a zone (``%eth0``)."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return "%" not in name


MAX_UPLOAD = 100 * 2**20  # largest upload [bytes]
MAX_TEXT = 200_000  # longest value of a text field [characters]
MAX_NAME = 1000  # longest part of a file name that an error message repeats [characters]
MAX_NUMBER = 2**53
"""Limit of number fields without their own: larger integers are not exact in a browser."""
MIN_QUATERNION_NORM = 1e-3  # shortest quaternion that still defines a rotation


class MessageError(MorphgenError):
    """A message has a value that its control cannot have."""


def message_fault(data: object) -> str:
    """Return why data from a websocket is not a message of a page; empty if it is one."""
    if not isinstance(data, bytes):
        return "expected a binary message"
    try:
        content = msgspec.msgpack.decode(data)
        if not isinstance(content, dict) or not isinstance(content.get("type"), str):
            return "expected a message with a type"
        message_type = viser_internals.ACCEPTED_MESSAGES.get(content.pop("type"))
        if message_type is None:
            return "this page accepts no message of that type"
        if not content.keys() <= {field.name for field in fields(message_type)}:
            return "the message has a field that its type does not have"
        msgspec.convert(content, message_type)
    except (msgspec.MsgspecError, TypeError, ValueError, RecursionError) as error:
        return f"malformed message: {error}"
    # No page listens to clicks beside the nodes of its scene.
    if message_type is viser_internals.ScenePointer and (
        content["event_type"] != "rect-select" or len(content["screen_pos"]) != 2
    ):
        return "expected a rectangle with two points"
    norm = math.hypot(*content.get("wxyz", (1.0,)))
    if not _all_finite(content.values()) or norm < MIN_QUATERNION_NORM:
        return "a number of the message is not finite, or a quaternion is zero"
    return ""


class MessageFilter:
    """Handlers that validate one browser's messages and pass valid ones on to viser."""

    def __init__(self, client: viser.ClientHandle, report: Callable[[str], object]) -> None:
        """Replace viser's handlers of values for controls and of uploads."""
        self._client, self._report = client, report
        self._upload, self._rest = "", 0
        own: dict[type[Any], viser_internals.Handler] = {
            viser_internals.GuiUpdate: self.update,
            viser_internals.UploadStart: self.start_upload,
            viser_internals.UploadPart: self.receive_part,
        }
        self._viser = viser_internals.replace_handlers(client, own)

    async def update(self, client_id: Any, message: viser_internals.GuiUpdate) -> None:  # noqa: ANN401
        """Set the value of a control."""
        handle = viser_internals.input_handle(self._client, message.uuid)
        if handle is None:
            return  # a control of the previous page
        if message.updates.keys() != {"value"}:
            self._report("a browser may change the value of a control, and nothing else of it")
            return
        try:
            message.updates = {"value": _valid_value(handle, message.updates["value"])}
        except MessageError as error:
            self._report(str(error))
        else:
            await self._viser[viser_internals.GuiUpdate](client_id, message)

    def start_upload(self, client_id: Any, message: viser_internals.UploadStart) -> None:  # noqa: ANN401
        """Start an upload; an unfinished one is dropped, so a browser holds at most one."""
        self._drop_upload()
        reason, size, limit = "", message.size_bytes, MAX_UPLOAD // 2**20
        if size > MAX_UPLOAD:
            reason = (
                f"{size / 2**20:.0f} MB; at most {limit} MB are accepted: open it on this machine "
                "instead, with morphgen view"
            )
        # viser waits for all parts in memory: more parts than bytes would never end.
        elif not 0 <= message.part_count <= size:
            reason = f"{size} bytes in {message.part_count} parts"
        if reason:
            self._report(f"{message.filename[:MAX_NAME]}: {reason}")
            return
        self._upload, self._rest = message.transfer_uuid, size
        self._viser[viser_internals.UploadStart](client_id, message)

    def receive_part(self, client_id: Any, message: viser_internals.UploadPart) -> None:  # noqa: ANN401
        """Receive a part of the current upload, at most as many bytes as were announced."""
        if message.transfer_uuid != self._upload:
            return
        self._rest -= len(message.content)
        if self._rest < 0:
            self._drop_upload()
            self._report("an upload was longer than its announced size; it was dropped")
            return
        self._viser[viser_internals.UploadPart](client_id, message)

    def _drop_upload(self) -> None:
        viser_internals.discard_upload(self._client, self._upload)
        self._upload = ""


def _valid_value(handle: Any, value: object) -> object:  # noqa: ANN401
    """Return a browser's value for a control, clipped to the range of a slider or number field."""
    match handle:
        case viser.GuiButtonHandle() | viser.GuiCheckboxHandle() if isinstance(value, bool):
            return value
        case viser.GuiTextHandle() if isinstance(value, str) and len(value) <= MAX_TEXT:
            return value
        case viser.GuiTextHandle():
            raise MessageError(f"expected a text of at most {MAX_TEXT} characters")
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle() if value in handle.options:
            return value
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle():
            raise MessageError(f"{value!r:.80} is not one of the choices")
        case viser.GuiSliderHandle() | viser.GuiNumberHandle():
            return _clip(value, handle)
        case viser.GuiMultiSliderHandle():
            if isinstance(value, list) and len(value) == len(handle.value):
                return [_clip(number, handle) for number in value]
    raise MessageError(f"that control takes no value such as {value!r:.80}")


def _clip(value: object, handle: Any) -> float:  # noqa: ANN401
    """Clip a number to a control's range; browsers round, and so may leave it by a little."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MessageError(f"expected a number, not {value!r:.80}")
    low = -MAX_NUMBER if handle.min is None else handle.min
    high = MAX_NUMBER if handle.max is None else handle.max
    return min(max(value, low), high)


def _all_finite(values: Any) -> bool:  # noqa: ANN401
    """Return whether all numbers in nested lists are finite."""
    return all(
        _all_finite(value)
        if isinstance(value, list | tuple)
        else not isinstance(value, float) or math.isfinite(value)
        for value in values
    )


MAX_REQUEST_LINE = 65_536
"""Longest first line of a request [bytes]. websockets' own limit of 8192 is below the longest
address of a page with its escapes, and closes the connection without an answer."""
_POLICY_VIOLATION = 1008  # close code of websockets (RFC 6455)
_starting = threading.Lock()  # held while websockets' `serve` is replaced

Answer = Callable[[ServerConnection, Request], Response | None]
Receive = Callable[[str, str], bool]
"""Receives a request of a page's script: the token of the page, and a query. Returns whether there
is such a page."""
REQUESTS = "/morphgen/"  # path of these requests, before the token


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
    """Start viser's server; every request has to pass the access policy."""
    with _starting, _guarded(policy, receive), contextlib.redirect_stdout(io.StringIO()):
        # Silent, because viser's banner would name the port before ``morphgen view`` does.
        server = viser.ViserServer(host=host, port=port, verbose=False)
    viser_internals.disable_share_links(server)
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, _print_fault)
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop viser's server without its message."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _guarded(policy: AccessPolicy, receive: Receive) -> Iterator[None]:
    """Apply the policy to the server that viser starts meanwhile: its function is replaced."""
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
