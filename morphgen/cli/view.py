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

from morphgen.cli.progress import note
from morphgen.progress import STOP_SIGNALS
from morphgen.viewer.app.app import Viewer, serve

SIGNAL_POLL = 0.5  # longest delay before a signal is handled [s]
QUIET_TIME = 2.0
"""Time without work for a browser after which the first rollout is prepared [s]: the first page
draws pictures, which would take longer beside it."""
STOP_GRACE = 5.0  # time in which work has to end after a signal; then it is given up [s]
LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")


def view(args: argparse.Namespace) -> None:
    """Serve until interrupted."""
    with suppress(KeyboardInterrupt):
        viewer = serve(args.words, args.host, args.port, args.library, args.allow_origin)
        # Work that ends after its browser has disconnected still writes to the page: harmless. Some
        # ends after this command, when Python waits for all threads, so that the filter stays.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
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
        connected = 0.0  # time for which a browser has been connected [s]
        while True:  # a signal that another thread receives does not end a sleep
            time.sleep(SIGNAL_POLL)
            connected += SIGNAL_POLL * bool(viewer.sessions)
            if min(connected, viewer.workers.idle_time) >= QUIET_TIME:
                viewer.warm_up()
    finally:
        for signal_name in (signal.SIGINT, *STOP_SIGNALS):
            signal.signal(signal_name, signal.SIG_IGN)  # a second one would leave uploads behind
        deadline = threading.Timer(STOP_GRACE, _give_up, (viewer,))
        deadline.daemon = True  # it must not keep alive the process that it is to end
        deadline.start()
        viewer.stop()


def _give_up(viewer: Viewer) -> None:
    """End the process although threads work that cannot be interrupted."""
    for process in multiprocessing.active_children():
        process.kill()
    viewer.uploads.cleanup()
    time.sleep(SIGNAL_POLL)  # without its processes, Python ends by itself unless a thread hangs
    os._exit(0)
