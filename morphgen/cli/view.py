"""``morphgen view``: robots in the browser."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from types import FrameType
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_library, whole_number

if TYPE_CHECKING:
    from morphgen.viewer.app import Viewer

_ENDS = (signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))
"""Signals that end it as Ctrl-C does: of a service manager, of a terminal that is closed."""
_NAP = 0.5
"""Seconds after which a signal is seen for certain."""
LOCAL = ("127.0.0.1", "localhost", "::1")


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "view",
        help="look at robots in the browser: browse, compose, compare, see them at work",
        description="Look at robots in the browser, until interrupted. Without a target: the "
        "library, the splits and the robots of this folder.",
        epilog="examples: morphgen view; morphgen view robots/arm3; "
        "morphgen view extrapolation/arms/reach; morphgen view arm=ur5 ee=plane; "
        "morphgen view some.urdf; morphgen view runs/reach/checkpoint.pt; "
        "morphgen view episode.npz",
    )
    parser.add_argument(
        "words",
        nargs="*",
        metavar="TARGET",
        help="a folder of robots, a bundle, a URDF or xacro, a split's name or file, a grammar, "
        "words as for morphgen compose, a checkpoint or a run's folder whose policy is to be seen "
        "at work, or an episode that the page has saved",
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to bind (default: this machine)"
    )
    parser.add_argument("--port", type=whole_number(1, 65535), default=8080)
    parser.add_argument(
        "--allow-origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="a site whose pages may use this one, such as https://hub.example.com where a proxy "
        "shows it, or the name of this machine, http://box:8080; may be repeated",
    )
    add_library(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    from morphgen.viewer.app import serve

    for name in _ENDS:
        signal.signal(name, _interrupt)
    try:
        viewer = serve(args.words, args.host, args.port, args.library, args.allow_origin)
        _sleep(args.host, viewer)
    except KeyboardInterrupt:
        pass
    return 0


def _sleep(host: str, viewer: Viewer) -> None:
    """Say where it serves, and wait until it is interrupted."""
    try:
        if host not in LOCAL:
            print(
                f"morphgen: warning: --host {host}: whoever can reach this machine can use this "
                "page, see the robots of this folder and write into it; there is no password",
                file=sys.stderr,
            )
        name = f"[{host}]" if ":" in host else host
        print(f"http://{name}:{viewer.port}  (stop with Ctrl-C)", flush=True)
        while True:  # a signal that another thread takes does not end a sleep
            time.sleep(_NAP)
    finally:
        for signal_name in (signal.SIGINT, *_ENDS):
            signal.signal(signal_name, signal.SIG_IGN)  # a second one would leave uploads behind
        viewer.stop()


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End as Ctrl-C does."""
    raise KeyboardInterrupt
