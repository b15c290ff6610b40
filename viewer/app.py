"""The viewer: a server, and a session for every browser."""

from __future__ import annotations

import socket
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory

import viser

from morphgen.benchmark.split_file import split_names
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import MorphgenError, nearest
from morphgen.formats.urdf import UnsoundError
from morphgen.grammar.grammar_file import SUFFIX, grammar_names
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import is_robot_folder
from morphgen.viewer import markup
from morphgen.viewer.access import access_policy
from morphgen.viewer.address import Address, parse_address
from morphgen.viewer.messages import MessageFilter
from morphgen.viewer.pages import load_page
from morphgen.viewer.robot_uri import (
    CHECKPOINT,
    EPISODE_SUFFIX,
    WORDS,
    FileAccess,
    UriError,
    resolve_words,
)
from morphgen.viewer.scene_stage import BRAND, set_stage
from morphgen.viewer.server import start_server, stop_server
from morphgen.viewer.session import BUG, Session, read_location
from morphgen.viewer.workers import Workers

NOTHING = "There is nothing to see here"
"""Title of the page for an address that cannot be shown."""
FAULT_WIDTH = 760.0
"""Width of that page's panel [pixels]."""
NUM_WORKERS = 2
"""Processes that draw thumbnails and compare robots."""


@dataclass(eq=False)
class Viewer:
    """A running viewer."""

    server: viser.ViserServer
    start: Address
    """Page for browsers whose URL names none."""
    files: FileAccess
    workers: Workers
    uploads: TemporaryDirectory[str]
    """Folder of uploads; deleted with the viewer, at the latest when its process ends."""
    sessions: dict[int, Session] = field(default_factory=dict)
    """Sessions of the connected browsers, by viser's client number."""
    cache: dict[str, object] = field(default_factory=dict)
    """Results of slow work that all sessions share."""

    @property
    def port(self) -> int:
        """Port on which the viewer listens."""
        return self.server.get_port()

    def stop(self) -> None:
        """End all sessions, the server and its workers, and delete the uploads."""
        for session in list(self.sessions.values()):
            session.close()
        stop_server(self.server)
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
        words: Target of the start page, see ``start_address``.
        host: Address to bind.
        port: Port; if it is taken, the next free one.
        library: Folders with further parts.
        origins: Other sites whose pages may use the viewer.

    Raises:
        MorphgenError: If the target does not exist, or the address does not belong to this machine.
    """
    targets = [Path(word).resolve() for word in words if "=" not in word and Path(word).exists()]
    folders = [path.parent if path.is_file() else path for path in targets]
    roots = tuple(dict.fromkeys((Path.cwd().resolve(), *folders)))
    files = FileAccess(default_library(library).folders, roots, Path("/nowhere"))
    files.library.names()  # reports a missing folder or a broken part before the server starts
    start = start_address(words, files)
    policy = access_policy(host, origins)
    _require_local_address(host)
    uploads = TemporaryDirectory(prefix="morphgen-uploads-", ignore_cleanup_errors=True)
    files = FileAccess(files.library_folders, roots, Path(uploads.name).resolve())
    server = start_server(host, port, policy)
    # Work that ends after its browser has disconnected still writes to the page; that is harmless.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    viewer = Viewer(server, start, files, Workers(NUM_WORKERS), uploads)

    async def connect(client: viser.ClientHandle) -> None:
        session = Session(client, files, viewer.workers, start, cache=viewer.cache)
        viewer.sessions[client.client_id] = session
        MessageFilter(client, session.report_error)
        session.enqueue(lambda: open_page(session))

    async def disconnect(client: viser.ClientHandle) -> None:
        session = viewer.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    server.on_client_disconnect(disconnect)
    server.on_client_connect(connect)
    return viewer


def start_address(words: Sequence[str], files: FileAccess) -> Address:
    """Return the page that ``morphgen view`` opens.

    Args:
        words: Nothing for the library; a folder, a file, or the name of a split or grammar; or
            words of ``morphgen compose``.
        files: Files that may be read.

    Raises:
        MorphgenError: If the target does not exist.
    """
    if not words:
        return Address("library")
    if len(words) > 1 or "=" in words[0]:
        resolve_words(" ".join(words), files)
        return Address("robot", (WORDS + " ".join(words),))
    word = words[0]
    if Path(word).exists():
        return _path_address(word, files)
    if word in split_names():
        return Address("split", (word,))
    if word in grammar_names():
        return Address("compose", (word,))
    valid = (*split_names(), *grammar_names())
    raise UriError(f"{word}: no such file or folder, no split and no grammar{nearest(word, valid)}")


def _path_address(text: str, files: FileAccess) -> Address:
    """Return the page of a file or folder."""
    path = files.path(text)
    if path.suffix == EPISODE_SUFFIX:
        from morphgen.viewer.episode import read_episode

        read_episode(path, files)
        return Address("play", (text,))
    if path.suffix == ".pt" or (path / CHECKPOINT).is_file():
        from morphgen.rl.runs import read_checkpoint

        read_checkpoint(path)
        return Address("play", state={"policy": text})
    if path.is_file():
        return Address({".yaml": "split", SUFFIX: "compose"}.get(path.suffix, "robot"), (text,))
    if (path / SPLIT_FILE).is_file():
        return Address("split", (text,))
    return Address("robot" if is_robot_folder(path) else "gallery", (text,))


def open_page(session: Session) -> None:
    """Build the page that a browser's URL names, or a page that says why it cannot be shown."""
    client, redact = session.client, session.files.redact
    try:
        location = read_location(client)
        session.dark = location.dark
        client.gui.configure_theme(
            show_logo=False, show_share_button=False, dark_mode=session.dark, brand_color=BRAND
        )
        set_stage(client.scene, dark=session.dark)
        session.address = parse_address(location.query) or session.address
        load_page(session.address.page)(session)
    except UnsoundError as error:
        _show_fault(session, redact(error.origin), markup.findings_table(error.findings, redact))
    except (MorphgenError, TimeoutError) as error:
        _show_fault(session, NOTHING, escape(redact(error)))
    except RecursionError:
        _show_fault(session, NOTHING, "the address is nested too deeply")
    except Exception:
        if not session.closed.is_set():
            _show_fault(session, NOTHING, BUG)
            raise
    finally:
        if not session.closed.is_set():
            session.reveal()


def _show_fault(session: Session, title: str, html: str) -> None:
    """Replace the page by a panel that says why it cannot be shown."""
    gui = session.client.gui
    gui.reset()
    session.client.scene.reset()
    session.open_panel(FAULT_WIDTH, markup.breadcrumbs((session.address.page, None)), left=True)
    gui.add_html(markup.framed(f"<h3>{escape(title)}</h3>{html}"))


def _require_local_address(host: str) -> None:
    """Require that an address to bind belongs to this machine."""
    try:
        kind, _, _, _, address = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise MorphgenError(f"cannot serve at {host!r}: {error.strerror or error}") from error
