"""What a page does beyond viser's own functions: its browser's address, by a line of JavaScript.

viser hands no URL to the server, so the browser is told to leave it in its local storage, under a
name that no other tab uses, and viser reads that.
"""

from __future__ import annotations

import json
import uuid

import viser
from viser import _messages

ANSWER = 20.0
"""How long a browser may take to tell its address, seconds."""


def read_query(client: viser.ClientHandle) -> str:
    """The query of the URL that a browser shows, with its question mark; empty if there is none.

    Raises:
        RuntimeError: If the browser is gone, or keeps no local storage.
        TimeoutError: If it does not answer.
    """
    key = f"morphgen-{uuid.uuid4().hex}"
    client.local_storage.set_item(key, "")
    _run(
        client,
        f"""const name = Object.keys(localStorage).find((k) => k.endsWith({json.dumps(key)}));
        if (name) localStorage.setItem(name, window.location.search);""",
    )
    try:
        return client.local_storage.get_item(key, timeout=ANSWER) or ""
    finally:
        client.local_storage.remove_item(key)


def show_query(client: viser.ClientHandle, query: str, title: str) -> None:
    """Show another query in the browser's address bar, and a title in its tab; nothing is loaded.

    Where only a part of the page changes, the last entry of the history is replaced.
    """
    _run(
        client,
        f"""window.history.replaceState(null, "", {json.dumps(query)});
        document.title = {json.dumps(title)};""",
    )


def go_to(client: viser.ClientHandle, query: str) -> None:
    """Load another page, as a link would."""
    _run(client, f"window.location.assign({json.dumps(query)});")


def _run(client: viser.ClientHandle, source: str) -> None:
    client._websock_connection.queue_message(_messages.RunJavascriptMessage(source=source))
    client.flush()
