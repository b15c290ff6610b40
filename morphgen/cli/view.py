"""``morphgen view``: robots in the browser."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import threading
import time
import warnings
from contextlib import suppress
from typing import TYPE_CHECKING

from morphgen.cli.command import command, option, repeated, whole_number
from morphgen.cli.options import LIBRARY
from morphgen.cli.progress import note
from morphgen.processes import STOP_SIGNALS

if TYPE_CHECKING:
    from morphgen.viewer.app.app import Viewer

SIGNAL_POLL = 0.5
"""Longest delay before a signal is handled [s]."""
STOP_GRACE = 5.0
"""Time in which work has to end after a signal; then it is given up [s]."""
LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")


@command(
    "view",
    "show robots in the browser: browse, compose, compare and run them",
    option(
        "words TARGET",
        "a folder of robots, a bundle, a URDF, xacro or MJCF, a split's name or file, a "
        "grammar, words of morphgen compose, a checkpoint or a run's folder (its policy is run), "
        "or an episode that was saved from the page",
        nargs="*",
    ),
    option("--host", "address to listen on", default="127.0.0.1"),
    option("--port", "default: 8080", whole_number(1, 65535), default=8080),
    repeated(
        "--allow-origin ORIGIN",
        "a website whose pages may use this one, such as https://hub.example.com if a proxy shows "
        "it there, or http://box:8080 for the name of this machine",
    ),
    LIBRARY,
    details="The server runs until it is interrupted. Without a target, it shows the library, the "
    "splits and grammars that come with morphgen, and the robots of this folder.",
    examples=(
        "view",
        "view robots/arm3",
        "view extrapolation/arms/reach",
        "view arm=ur5 ee=plane",
        "view some.urdf",
        "view runs/reach/checkpoint.pt",
        "view episode.npz",
    ),
)
def view(args: argparse.Namespace) -> None:
    """Serve until interrupted."""
    from morphgen.viewer.app.app import serve

    with suppress(KeyboardInterrupt), warnings.catch_warnings():
        # Work that ends after its browser has disconnected still writes to the page: harmless.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        viewer = serve(args.words, args.host, args.port, args.library, args.allow_origin)
        _wait(args.host, viewer)


def _wait(host: str, viewer: Viewer) -> None:
    """Print the address, and wait until the server is interrupted."""
    try:
        if host not in LOCAL_HOSTS:
            note(
                f"morphgen: warning: --host {host}: whoever can reach this machine can use this "
                "page, see the robots of this folder and write into it; there is no password"
            )
        name = f"[{host}]" if ":" in host else host
        print(f"http://{name}:{viewer.port}  (stop with Ctrl-C)", flush=True)
        while True:  # a signal that another thread receives does not end a sleep
            time.sleep(SIGNAL_POLL)
    finally:
        for signal_name in (signal.SIGINT, *STOP_SIGNALS):
            signal.signal(signal_name, signal.SIG_IGN)  # a second one would leave uploads behind
        deadline = threading.Timer(STOP_GRACE, _give_up, (viewer,))
        deadline.daemon = True  # it must not keep alive the process that it is to end
        deadline.start()
        viewer.stop()


def _give_up(viewer: Viewer) -> None:
    """End the process although work still runs, such as a library that cannot be interrupted.

    Python itself would wait for all threads, and for the worker processes.
    """
    for process in multiprocessing.active_children():
        process.kill()
    viewer.uploads.cleanup()
    time.sleep(SIGNAL_POLL)  # without its processes, Python ends by itself unless a thread hangs
    os._exit(0)
