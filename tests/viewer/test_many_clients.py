"""Many clients at once: each sees its own page, and nothing of them remains."""

import contextlib
import re
import threading
import weakref
from pathlib import Path

import pytest

from helpers.pages import wait_until
from helpers.viser_client import PlainClient

GROWTH = 1.05
"""Largest accepted ratio of the memory after a second crowd to the memory after the first."""


def robot_name(i):
    return f"prims-{i % 30:06d}"


def robot_query(i):
    return f"?robot=robots/prims/{robot_name(i)}"


def session_threads():
    return [t.name for t in threading.enumerate() if t.name.startswith("morphgen-")]


def resident():
    """Return the resident memory of this process [pages]."""
    return int(Path("/proc/self/statm").read_text().split()[1])


def crowd(on, n, check=lambda: None):
    """Connect clients, each to the page of another robot; return weak references to sessions."""
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(PlainClient(on.port, robot_query(i))) for i in range(n)]
        for i, client in enumerate(clients):
            client.shows(f"<h3>{robot_name(i)}</h3>")
            client.until(lambda client=client: "no self-collision" in client.text)
            assert f"<h3>{robot_name(i + 1)}</h3>" not in client.text
        check()
        return [weakref.ref(session) for session in on.sessions.values()]


def require_nothing_left(on, sessions):
    wait_until(lambda: not on.sessions)
    wait_until(lambda: not session_threads())
    wait_until(lambda: all(session() is None for session in sessions))


@pytest.mark.slow
def test_thirty_clients_see_their_own_pages_and_leave_nothing(see, viewer, capfd):
    on = viewer()
    memory = []

    def look():
        pages = [see(robot_query(i), on=on) for i in range(27, 30)]
        for i, page in zip(range(27, 30), pages, strict=True):
            page.get_by_role("heading", level=3, name=robot_name(i)).wait_for()
            page.get_by_text(re.compile("no self-collision")).wait_for()
        assert len(on.sessions) == 30
        assert len({id(session.client) for session in on.sessions.values()}) == 30
        for page in pages:
            page.context.close()

    for _ in range(2):
        sessions = crowd(on, 27, look)
        assert len(sessions) >= 27
        require_nothing_left(on, sessions)
        memory.append(resident())
    assert memory[1] < GROWTH * memory[0]
    assert "Traceback" not in capfd.readouterr().err
