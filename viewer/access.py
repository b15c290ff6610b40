"""Who may use the page: requests are judged by the names in their ``Host`` and ``Origin``.

A page of any other site that a user has open can send requests to this machine, too, and a foreign
name can be made to lead here (DNS rebinding). Browsers say in ``Host`` by which name a server was
asked, and in ``Origin`` which site asks; a page cannot change either.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import SplitResult, parse_qsl, urlsplit

from websockets.datastructures import Headers

from morphgen.errors import MorphgenError

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
"""Names of this machine that nobody else can take."""
_PORTS = {"http": 80, "https": 443}
_FOREIGN_SERVER, _FOREIGN_FILE = "websocket", "playbackPath"
"""Keys of an address by which viser's page lets another server, or a file, take its place."""


@dataclass(frozen=True)
class AccessPolicy:
    """Which names a viewer may be asked by, and which sites may ask."""

    names: frozenset[str] = frozenset(LOCAL_NAMES)
    """Host names and IP addresses, in lower case."""
    any_address: bool = False
    """Whether every IP address is a name of this machine: it listens at all of them."""
    origins: frozenset[str] = frozenset()
    """Other sites that may ask, such as ``https://hub.example.com``."""


def access_policy(host: str, origins: Sequence[str] = ()) -> AccessPolicy:
    """The gate of a viewer.

    Args:
        host: The address that it binds.
        origins: Other sites that are allowed, as ``--allow-origin`` has them.

    Raises:
        MorphgenError: If an origin is malformed.
    """
    names = {*LOCAL_NAMES, host.strip("[]").lower()}
    everywhere = _is_unspecified(host)
    if everywhere:
        names |= {name.lower() for name in (socket.gethostname(), socket.getfqdn()) if name}
    return AccessPolicy(frozenset(names), everywhere, frozenset(map(_parsed_origin, origins)))


def refusal_reason(gate: AccessPolicy, path: str, headers: Headers) -> str:
    """Why a request is refused, in one sentence; empty if it is not.

    A request without ``Origin`` is no script's of another site: browsers send it with every
    websocket. So programs of this machine may connect without one.

    Args:
        gate: Who may ask.
        path: With the query.
        headers: Of the request.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return "expected one Host and at most one Origin in the request."
    host = hosts[0].lower()
    if not _is_own(gate, host):
        return (
            f"{hosts[0][:100]!a} is no name of this viewer; open it as localhost, or start it with "
            "--host NAME or --allow-origin http://NAME."
        )
    if origins and not _may_ask(gate, origins[0], host):
        return (
            f"a page of {origins[0][:100]!a} may not use this viewer; if it is yours, start the "
            "viewer with --allow-origin and its origin."
        )
    query = dict(parse_qsl(urlsplit(path).query))
    server = _split(query.get(_FOREIGN_SERVER, f"ws://{host}"))
    if _FOREIGN_FILE in query or server is None or not _is_own(gate, server.netloc.lower()):
        return f"an address with {_FOREIGN_SERVER}= or {_FOREIGN_FILE}= would show another server."
    return ""


def policy(gate: AccessPolicy, host: str) -> str:
    """The Content-Security-Policy of the page: what it may connect to, and who may frame it.

    viser's page would connect to any server that its address names and run what that sends.

    Args:
        gate: Who may ask.
        host: ``Host`` of a request that was not refused.
    """
    sites = " ".join(sorted(gate.origins))
    sockets = " ".join(f"ws{each[4:]}" for each in sorted(gate.origins))
    return (
        f"connect-src 'self' ws://{host} wss://{host} {sockets} data: blob:; "
        f"frame-ancestors 'self' {sites}; object-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _is_own(gate: AccessPolicy, netloc: str) -> bool:
    """Whether a host with its port is this viewer's name.

    The port is not compared, because a tunnel (``ssh -L``) may have another.
    """
    url = _split(f"http://{netloc}")
    if url is None or url.username is not None or url.netloc != netloc or not url.hostname:
        return False
    allowed = (urlsplit(origin) for origin in gate.origins)
    return (
        url.hostname in gate.names
        or (gate.any_address and _is_address(url.hostname))
        or any(url.netloc == each.netloc for each in allowed)
    )


def _may_ask(gate: AccessPolicy, origin: str, host: str) -> bool:
    """Whether a site is the viewer's own, by the name that it was asked by, or an allowed one."""
    site = _split(origin)
    if site is None or site.scheme not in _PORTS:
        return False
    own = _split(f"{site.scheme}://{host}")
    return own is not None and (_site(site) == _site(own) or _site(site) in gate.origins)


def _site(url: SplitResult) -> str:
    """An origin in one spelling: lower case, without the scheme's own port."""
    name = f"[{url.hostname}]" if ":" in (url.hostname or "") else url.hostname
    port = "" if url.port in (None, _PORTS[url.scheme]) else f":{url.port}"
    return f"{url.scheme}://{name}{port}"


def _parsed_origin(text: str) -> str:
    url = _split(text.strip())
    plain = url is not None and not (url.path.strip("/") or url.query or url.fragment)
    if url is None or not plain or url.scheme not in _PORTS or not url.hostname or "@" in text:
        raise MorphgenError(
            f"--allow-origin {text!r}: expected a site such as https://hub.example.com or "
            "http://box:8080, without a path"
        )
    return _site(url)


def _split(url: str) -> SplitResult | None:
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018  (a port that is no number raises here)
    except ValueError:
        return None
    return parts


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return "%" not in name


def _is_unspecified(host: str) -> bool:
    if not host:
        return True
    return _is_address(host.strip("[]")) and ipaddress.ip_address(host.strip("[]")).is_unspecified
