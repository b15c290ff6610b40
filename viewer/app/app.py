"""The viewer: a server, and a session for every browser."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import parse_qsl

import viser

from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import MorphgenError, nearest
from morphgen.formats.urdf.read import UnsoundError
from morphgen.grammar.grammar_file import SUFFIX, grammar_names
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import is_robot_folder
from morphgen.rl.demonstrations.lerobot import is_data_set
from morphgen.splits.split import split_names
from morphgen.viewer import markup, robot_uri
from morphgen.viewer.app.address import CHOSEN, PAGES, Address, parse_address, parse_count
from morphgen.viewer.app.frame import call
from morphgen.viewer.app.server import MessageFilter, access_policy, start_server, stop_server
from morphgen.viewer.app.session import BUG, DEFAULT_WIDTH, Session
from morphgen.viewer.app.viser_internals import clear_page
from morphgen.viewer.app.workers import SharedResults, Workers, load_function, named
from morphgen.viewer.robot_files import change_tray
from morphgen.viewer.scene.stage import BRAND, set_stage

NOTHING = "This address cannot be shown"  # title of the page for an address that cannot be shown
FAULT_WIDTH = 760.0  # width of that page's panel [pixels]
NUM_WORKERS = 2  # processes that draw thumbnails and compare robots


@dataclass(eq=False)
class Viewer:
    """A running viewer."""

    server: viser.ViserServer
    start: Address  # page for browsers whose URL names none
    files: robot_uri.FileAccess
    workers: Workers
    simulator: Workers  # one process, in which rollouts run
    uploads: TemporaryDirectory[str]  # deleted with the viewer, at the latest when its process ends
    sessions: dict[str, Session] = field(default_factory=dict)
    """Current sessions of the connected browsers, by the secret token that their scripts send."""
    cache: SharedResults = field(default_factory=SharedResults)  # results for all sessions

    @property
    def port(self) -> int:
        """Port on which the viewer listens."""
        return self.server.get_port()

    def warm_up(self) -> None:
        """Load what the first rollout needs, in its process, unless a rollout began before."""
        if not self.simulator.is_used:
            self.simulator.submit(named("morphgen.viewer.simulation:warm_up"), self.files)

    def stop(self) -> None:
        """End all sessions, the server and its workers, and delete the uploads."""
        for session in list(self.sessions.values()):
            session.disconnect()
        stop_server(self.server)
        self.workers.close()
        self.simulator.close()
        self.uploads.cleanup()


def serve(
    words: Sequence[str] = (),
    host: str = "127.0.0.1",
    port: int = 8080,
    library: Sequence[Path] = (),
    origins: Sequence[str] = (),
) -> Viewer:
    """Start a viewer."""
    targets = [Path(word).resolve() for word in words if "=" not in word and Path(word).exists()]
    folders = [path.parent if path.is_file() else path for path in targets]
    roots = tuple(dict.fromkeys((Path.cwd().resolve(), *folders)))
    files = robot_uri.FileAccess(default_library(library).folders, roots, Path("/nowhere"))
    files.library.names()  # reports a missing folder and broken parts before the server starts
    start = start_address(words, files)
    policy = access_policy(host, origins)
    _require_local_address(host)
    uploads = TemporaryDirectory(prefix="morphgen-uploads-", ignore_cleanup_errors=True)
    files = robot_uri.FileAccess(files.library_folders, roots, Path(uploads.name).resolve())
    viewer: Viewer | None = None

    def receive(token: str, query: str) -> bool:
        return viewer is not None and _receive(viewer, token, query)

    server = start_server(host, port, policy, receive)
    viewer = Viewer(server, start, files, Workers(NUM_WORKERS), Workers(1), uploads)
    _accept_browsers(viewer)
    return viewer


def _accept_browsers(viewer: Viewer) -> None:
    async def connect(client: viser.ClientHandle) -> None:
        token = secrets.token_urlsafe(24)
        session = Session(
            client, viewer.files, viewer.workers, viewer.simulator, viewer.start, cache=viewer.cache
        )
        viewer.sessions[token] = session

        def report(reason: str) -> None:
            """Show on the browser's page of that time why its message was rejected."""
            if (current := viewer.sessions.get(token)) is not None:
                current.report_error(reason)

        MessageFilter(client, report)
        # The script of the page then asks for the page of its URL.
        session.enqueue(lambda: session.run_script(call("connect", token)))

    async def disconnect(client: viser.ClientHandle) -> None:
        for token, session in list(viewer.sessions.items()):
            if session.browser is client:
                del viewer.sessions[token]
                session.disconnect()

    viewer.server.on_client_disconnect(disconnect)
    viewer.server.on_client_connect(connect)


def _receive(viewer: Viewer, token: str, query: str) -> bool:
    """Handle a request of a page's script; return whether the browser is connected.

    Its query has an action (``open`` replaces the page), the page's number, theme and width.
    """
    # The token is secret: only the script of a page can change what its browser shows.
    session, fields = viewer.sessions.get(token), parse_qsl(query, keep_blank_values=True)
    if session is None or not fields:
        return False
    (action, value), state = fields[0], dict(fields[1:])
    if action != "open":
        session.enqueue(lambda: change_tray(session, action, value), even_closed=True)
        return True
    visit = parse_count(state.get("visit", ""), 0)
    following = session.next_session(
        visit,
        dark=bool(state.get("dark")),
        width=parse_count(state.get("width", ""), DEFAULT_WIDTH),
    )
    viewer.sessions[token] = following

    def find_address() -> None:
        following.address = parse_address(value) or viewer.start
        # The tray after the changes that were queued before; at first that of the URL.
        following.chosen = session.chosen if visit else following.address.chosen

    following.enqueue(lambda: open_page(following, find_address))
    return True


def open_page(session: Session, find_address: Callable[[], object]) -> None:
    """Build a page, or one that says why it cannot be shown."""
    client, redact = session.client, session.files.redact
    try:
        clear_page(client)
        find_address()
        client.gui.configure_theme(
            show_logo=False, show_share_button=False, dark_mode=session.dark, brand_color=BRAND
        )
        set_stage(client.scene, dark=session.dark)
        address = session.address
        if address.page == CHOSEN:
            session.chosen = tuple(filter(None, address.subjects))
        session.tabs = address.state.get("tab", "")
        session.address = replace(address, chosen=()).with_state(theme="", tab="")
        session.show_address(session.title)
        session.show_tray()
        load_function(PAGES[address.page])(session)  # pages import much that others do not need
        if session.tabs:
            session.run_script(call("openTabs", session.tabs.split(",")))
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
    clear_page(session.client)
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


def start_address(words: Sequence[str], files: robot_uri.FileAccess) -> Address:
    """Return the page that ``morphgen view`` opens."""
    if not words:
        return Address("library")
    if len(words) > 1 or "=" in words[0]:
        robot_uri.resolve_words(" ".join(words), files)
        return Address("robot", (robot_uri.WORDS + " ".join(words),))
    word = words[0]
    if Path(word).exists():
        return _path_address(word, files)
    if word in split_names():
        return Address("split", (word,))
    if word in grammar_names():
        return Address("compose", (word,))
    parts = word.split("-")
    if parts[0] in files.library.paths:
        robot_uri.resolve_words(word, files)  # raises if the parts cannot be joined
        slots = [f"{files.library.manifest(part).kind}={part}" for part in parts]
        return Address("robot", (robot_uri.WORDS + " ".join(slots),))
    valid = (*split_names(), *grammar_names())
    raise robot_uri.UriError(
        f"{word}: no such file or folder, no robot such as ur5-plane, no split and no grammar"
        f"{nearest(word, valid)}; see morphgen list, split list and grammar list"
    )


def _path_address(text: str, files: robot_uri.FileAccess) -> Address:
    path = files.path(text)
    if path.suffix == ".pt" or (path / robot_uri.CHECKPOINT).is_file():
        from morphgen.rl.runs.checkpoint import read_checkpoint

        read_checkpoint(path)
        return Address("play", state={"policy": text})
    if is_data_set(path):
        from morphgen.rl.demonstrations.reader import Demonstrations

        Demonstrations(path)
        return Address("demos", (text,))
    if path.is_file():
        return Address({".yaml": "split", SUFFIX: "compose"}.get(path.suffix, "robot"), (text,))
    if (path / SPLIT_FILE).is_file():
        return Address("split", (text,))
    return Address("robot" if is_robot_folder(path) else "gallery", (text,))
