"""The frame of the pages: links of the top bar, the tray, and the requests of its script."""

import http.client
import json
from urllib.parse import quote

import pytest

from helpers.viser_client import PlainClient
from morphgen.viewer.app.address import (
    MAX_CHOSEN,
    Address,
    parse_address,
)
from morphgen.viewer.app.frame import page_links, shown_address, tray_html

A, B = "words:arm=ur5 ee=plane", "robots/prims/prims-000001"


def targets(address, chosen=()):
    return {label: target.query for label, target in page_links(address, chosen).items()}


def test_links_of_the_bar_keep_the_subject_of_the_page():
    of_set = targets(Address("gallery", ("robots/prims",)))
    assert of_set["Population"] == "?population=robots/prims"
    of_robot = targets(Address("robot", (B,)))
    assert of_robot["Gallery"] == "?gallery=robots/prims"
    assert of_robot["Playback"] == f"?play=reach&robot={B}"
    of_words = targets(Address("robot", (A,)))
    assert of_words["Compose"] == "?compose=arm=ur5%20ee=plane"
    assert targets(Address("split", ("mine",)))["Population"] == "?population=mine"
    assert targets(Address("library"))["Compare"] == "?compare="


def test_links_of_the_bar_take_the_chosen_robots():
    links = targets(Address("robot", ("robots/x",)), [A, B])
    assert links["Compare"] == "?compare=words:arm=ur5%20ee=plane&compare=" + B
    assert links["Playback"].count("robot=") == 2


def test_the_tray_offers_what_its_robots_can_do():
    assert tray_html([]) == ""
    one = tray_html([B])
    assert "1 chosen" in one
    assert "?compare=" not in one
    assert "?play=reach&amp;robot=robots/prims/prims-000001" in one
    assert "?compare=" in tray_html([A, B])
    many = tray_html([f"robots/r{i}" for i in range(12)])
    assert "?compare=" not in many
    assert "?play=" not in many
    assert "?chosen=robots/r0&amp;chosen=robots/r1" in many


def test_the_address_of_every_page_keeps_the_chosen_robots():
    shown = shown_address(Address("library"), [A, B])
    assert parse_address(shown.query).chosen == (A, B)
    chosen = parse_address(f"?chosen={A}&chosen={B}&train=1")
    assert chosen == Address("chosen", (A, B), {"train": "1"})
    assert shown_address(chosen, [B]).query == f"?chosen={B}&train=1"


class Script:
    """Sends what the script of a page sends."""

    def __init__(self, client, port):
        self.client, self.port = client, port
        (source,) = client.until(lambda: [s for s in client.sources if "?.connect(" in s][-1:])
        self.token = json.JSONDecoder().raw_decode(source.split("(", 1)[1])[0]

    def send(self, action, value, visit=0, token=None, *, dark=False, width=1400):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        state = f"visit={visit}&dark={'yes' if dark else ''}&width={width}"
        path = f"/morphgen/{token or self.token}?{action}={quote(value)}&{state}"
        connection.request("GET", path)
        return connection.getresponse().status


def test_a_script_opens_another_page_in_place(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=") as client:
        script = Script(client, on.port)
        client.shows("Grammars")
        (first,) = on.sessions.values()
        assert script.send("open", f"?robot={A}", visit=1) == 200
        client.control("Checkbox", "x-ray")
        client.until(lambda: (1, "?robot=words:arm=ur5%20ee=plane") in client.addresses)
        (second,) = on.sessions.values()
        assert first.closed.is_set()
        assert second.events is first.events
        assert script.send("open", "?robot=nowhere", visit=2) == 200
        client.shows("no such file or folder")


def test_a_script_chooses_robots(viewer):
    on = viewer()
    with PlainClient(on.port, f"?population=&chosen={A}") as client:
        script = Script(client, on.port)
        client.shows("1 chosen")
        assert script.send("choose", B) == 200
        client.shows("2 chosen")
        client.until(
            lambda: (
                f"?population=&chosen={quote(A, safe='/=:')}&chosen={B}"
                in dict(client.addresses).values()
            )
        )
        script.send("open", "?gallery=", visit=1)
        client.until(lambda: any(n == 1 and query.endswith(B) for n, query in client.addresses))
        script.send("drop", A)
        script.send("download", "")
        client.shows("robots.zip")
        script.send("clear", "")
        client.until(lambda: client.addresses[-1] == (1, "?gallery="))
        script.send("choose", "x" * MAX_CHOSEN)
        client.shows("choose fewer")
        script.send("explode", "")
        client.shows("unknown action; expected choose, drop")


def test_a_narrow_window_has_its_cards_above_the_panel(shared_viewer):
    with PlainClient(shared_viewer.port, "?split=") as client:
        script = Script(client, shared_viewer.port)
        assert script.send("open", "?gallery=robots/prims", visit=1, width=420) == 200
        (html, *_) = client.until(lambda: [s for s in client.sources if "?.cards(" in s])
        assert html.count('class=\\"card\\"') == 24


def test_a_script_shows_the_range_of_a_joint_and_of_no_other_number(shared_viewer, capfd):
    with PlainClient(shared_viewer.port, "?robot=robots/some-arm") as client:
        script = Script(client, shared_viewer.port)
        client.shows("no self-collision")
        for row in ("9" * 5000, "²", "0"):
            assert script.send("hover", row) == 200
        client.until(lambda: any(m.get("name", "").endswith("/range") for m in client.messages))
    assert capfd.readouterr().err == ""


def test_only_the_script_of_a_page_can_change_it(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=") as client:
        script = Script(client, on.port)
        assert script.send("open", "?split=", token="x" * 32) == 404
        assert script.send("choose", A, token="../library") == 404
    client.websocket.close()
    with PlainClient(on.port, "?population=") as other:
        other.shows("Grammars")
        assert script.send("open", "?split=") == 404


@pytest.mark.parametrize("page", ["gallery", "population", "split"])
def test_pages_without_a_subject_list_what_there_is(shared_viewer, page):
    with PlainClient(shared_viewer.port, f"?{page}=") as client:
        client.shows(f"{page}=extrapolation/arms/reach" if page != "gallery" else "robots/prims")


def test_playback_without_a_task_offers_tasks(shared_viewer):
    with PlainClient(shared_viewer.port, f"?play=&chosen={B}") as client:
        client.shows("Play which task?")
        client.shows(f'href="?play=push&amp;robot={B}"')


def test_compare_without_robots_offers_a_picker(shared_viewer):
    on = shared_viewer
    with PlainClient(on.port, "?compare=") as client:
        client.shows("Compare two to four robots")
        client.change(client.control("Text", "or words"), "arm=ur5 ee=plane")
        client.change(client.control("Button", "Add"))
        assert client.sent_to() == "?compare=words:arm=ur5%20ee=plane"


def test_chosen_robots_become_the_sides_of_a_split(shared_viewer):
    uris = [f"robots/prims/prims-00000{i}" for i in range(3)]
    query = "?" + "&".join(f"chosen={uri}" for uri in uris) + "&train=1"
    with PlainClient(shared_viewer.port, query) as client:
        client.shows("train (1)")
        client.shows("test (2)")


def test_a_page_opens_the_tabs_of_its_address(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims&tab=A,B") as client:
        client.shows('?.openTabs(["A", "B"])')
        assert client.addresses[-1] == (0, "?gallery=robots/prims&tab=A,B")


def test_the_dark_theme_is_remembered(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=", dark=True) as client:
        script = Script(client, on.port)
        client.shows(">light</a>")  # the way back
        (theme, *_) = [m for m in client.messages if m["type"] == "ThemeConfigurationMessage"]
        assert theme["dark_mode"] is True
        client.messages.clear()
        script.send("open", "?split=", visit=1, dark=True)
        client.shows(">light</a>")
        script.send("open", "?split=", visit=2)
        client.shows(">dark</a>")
