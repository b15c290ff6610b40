"""Access policy: the viewer answers a request by its ``Host`` and ``Origin`` headers.

Threat: the viewer has no password and listens on this machine, but any web page that the user has
open in the same browser can send requests to ``localhost`` too, and can point a host name of its
own to this machine (DNS rebinding). Browsers send the name by which a server was addressed as
``Host``, and the site that sends a request as ``Origin``; a page cannot forge either. So a request
is answered only if it was addressed to a name of this viewer, by a page of this viewer.
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
"""Names of this machine that nobody else can claim."""
_PORTS = {"http": 80, "https": 443}
_FOREIGN_SERVER, _FOREIGN_FILE = "websocket", "playbackPath"
"""Query keys that make viser's page show another server, or a file, under this viewer's name."""


@dataclass(frozen=True)
class AccessPolicy:
    """Names by which a viewer may be addressed, and sites that may use it."""

    names: frozenset[str] = frozenset(LOCAL_NAMES)
    """Host names and IP addresses, in lower case."""
    any_address: bool = False
    """Whether every IP address is accepted as a name, because the viewer listens on all of them."""
    origins: frozenset[str] = frozenset()
    """Other sites that may use the viewer, such as ``https://hub.example.com``."""


def access_policy(host: str, origins: Sequence[str] = ()) -> AccessPolicy:
    """Return the access policy of a viewer.

    Args:
        host: Address that the viewer binds.
        origins: Other sites that may use it, from ``--allow-origin``.

    Raises:
        MorphgenError: If an origin is malformed.
    """
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

    Args:
        policy: The viewer's names and allowed sites.
        path: Path and query of the request.
        headers: Headers of the request.
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
    named = [value for key, value in query if key in (_FOREIGN_SERVER, _FOREIGN_FILE)]
    # A browser takes the first of several values, other programs the last.
    if len(named) > 1 or not all(_is_viewer_socket(policy, *pair) for pair in query):
        return f"an address with {_FOREIGN_SERVER}= or {_FOREIGN_FILE}= would show another server."
    return ""


def content_security_policy(policy: AccessPolicy, host: str) -> str:
    """Return the Content-Security-Policy of the page: its connections, and who may embed it.

    Second defence: without it, viser's page would connect to any server that its address names, and
    run what that server sends.

    Args:
        policy: The viewer's names and allowed sites.
        host: ``Host`` of a request that was not refused.
    """
    sites = " ".join(sorted(policy.origins))
    sockets = " ".join(f"ws{origin[4:]}" for origin in sorted(policy.origins))
    return (
        f"connect-src 'self' ws://{host} wss://{host} {sockets} data: blob:; "
        f"frame-ancestors 'self' {sites}; object-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _is_viewer_name(policy: AccessPolicy, netloc: str) -> bool:
    """Return whether a host with its port names this viewer.

    The port is not compared, because a tunnel (``ssh -L``) may use another one.
    """
    url = _split_url(f"http://{netloc}")
    if url is None or url.username is not None or url.netloc != netloc or not url.hostname:
        return False
    return (
        url.hostname in policy.names
        or (policy.any_address and _is_ip_address(url.hostname))
        or any(url.netloc == urlsplit(origin).netloc for origin in policy.origins)
    )


def _is_viewer_socket(policy: AccessPolicy, key: str, value: str) -> bool:
    """Return whether a value of a query shows nothing but this viewer."""
    server = _split_url(value) if key == _FOREIGN_SERVER else None
    own = server is not None and _is_viewer_name(policy, server.netloc.lower())
    return own or key not in (_FOREIGN_SERVER, _FOREIGN_FILE)


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
