"""The viewer: a server of pages, a session for every browser."""

from __future__ import annotations

import contextlib
import functools
import io
import socket
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory

import viser

from morphgen.errors import MorphgenError
from morphgen.formats.urdf import UnsoundError
from morphgen.grammar.library import default_library
from morphgen.viewer import (
    browser,
    markup,
    page_compare,
    page_compose,
    page_gallery,
    page_library,
    page_robot,
    page_split,
)
from morphgen.viewer.access import access_policy
from morphgen.viewer.address import Address, Page, parse_address
from morphgen.viewer.messages import check_values
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.server import start_server
from morphgen.viewer.session import BUG, Session, close, post, refuse
from morphgen.viewer.targets import target_address
from morphgen.viewer.workers import Workers

NOTHING = "There is nothing to see here"
WORKERS = 2
"""Processes that draw thumbnails and compare robots."""


def _show_play(session: Session) -> None:
    # What simulates takes seconds and much memory to load, which other pages need not.
    from morphgen.viewer import page_play

    page_play.show(session)


SHOW: Mapping[Page, Callable[[Session], None]] = {
    "library": page_library.show,
    "gallery": page_gallery.show,
    "robot": page_robot.show,
    "compose": page_compose.show,
    "compare": page_compare.show,
    "split": page_split.show,
    "play": _show_play,
}
"""How each page is built."""


@dataclass(eq=False)
class Viewer:
    """A running viewer."""

    server: viser.ViserServer
    start: Address
    """The page that is shown to those who name none."""
    places: FileAccess
    workers: Workers
    uploads: TemporaryDirectory[str]
    """Where uploads are kept; it goes with the viewer, or with its process."""
    sessions: dict[int, Session] = field(default_factory=dict)
    shared: dict[str, object] = field(default_factory=dict)
    """What took long to find."""

    @property
    def port(self) -> int:
        """Where it listens."""
        return self.server.get_port()

    def stop(self) -> None:
        """End all sessions, the server and its workers."""
        for session in list(self.sessions.values()):
            close(session)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self.workers.close()
        self.uploads.cleanup()


def serve(
    words: Sequence[str] = (),
    host: str = "127.0.0.1",
    port: int = 8080,
    library: Sequence[Path] = (),
    origins: Sequence[str] = (),
) -> Viewer:
    """Start a viewer.

    Args:
        words: What its first page shows: nothing for the library; a folder, a file or a split's
            name; or words of ``morphgen compose``.
        host: Address to bind.
        port: Port; if it is taken, the next free one.
        library: Folders of the user's own parts.
        origins: Sites, besides its own, whose pages may use it.

    Raises:
        MorphgenError: If there is no such thing, or the address is none of this machine's.
    """
    places = FileAccess(default_library(library).folders, _roots(words), Path("/nowhere"))
    places.library.names()  # a folder that is missing, or a part that is broken, is told now
    start = target_address(words, places)
    gate = access_policy(host, origins)
    _require_address(host)
    uploads = TemporaryDirectory(prefix="morphgen-uploads-", ignore_cleanup_errors=True)
    places = FileAccess(places.folders, places.roots, Path(uploads.name).resolve())
    server = start_server(host, port, gate)
    # What a browser misses that has just gone is no news.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    viewer = Viewer(server, start, places, Workers(WORKERS), uploads)

    async def connect(client: viser.ClientHandle) -> None:
        session = Session(client, places, viewer.workers, start, viewer.shared)
        viewer.sessions[client.client_id] = session
        check_values(client, functools.partial(refuse, session))
        post(session, lambda: open_page(session))

    async def disconnect(client: viser.ClientHandle) -> None:
        session = viewer.sessions.pop(client.client_id, None)
        if session is not None:
            close(session)

    server.on_client_disconnect(disconnect)
    server.on_client_connect(connect)
    return viewer


def _require_address(host: str) -> None:
    """Require that a host is an address of this machine."""
    try:
        kind, _, _, _, address = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise MorphgenError(f"cannot serve at {host!r}: {error.strerror or error}") from error


def open_page(session: Session) -> None:
    """Build the page that a browser's URL names."""
    client = session.client
    client.gui.configure_theme(show_logo=False, show_share_button=False)
    try:
        session.address = parse_address(browser.read_query(client)) or session.address
        SHOW[session.address.page](session)
    except UnsoundError as error:
        findings = markup.findings_table(error.findings, session.places.told)
        _show_fault(session, session.places.told(error.origin), findings)
    except (MorphgenError, TimeoutError) as error:
        _show_fault(session, NOTHING, escape(session.places.told(error)))
    except RecursionError:
        _show_fault(session, NOTHING, "what the address names is nested too deeply")
    except Exception:
        if not session.closed.is_set():
            _show_fault(session, NOTHING, BUG)
            raise


def _show_fault(session: Session, title: str, text: str) -> None:
    """A page that says why there is no other."""
    gui, session.status = session.client.gui, None
    gui.reset()
    session.client.scene.reset()
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_left()
    gui.main_panel.set_width(760)
    gui.add_html(markup.STYLE + markup.crumbs((session.address.page, None)))
    gui.add_html(markup.framed(f"<h3>{escape(title)}</h3>{text}"))


def _roots(words: Sequence[str]) -> tuple[Path, ...]:
    """Where robots may be read from: here, and what the user named."""
    here = Path.cwd().resolve()
    named = [Path(word).resolve() for word in words if "=" not in word and Path(word).exists()]
    beside = [path.parent if path.is_file() else path for path in named]
    return tuple(dict.fromkeys((here, *beside)))
