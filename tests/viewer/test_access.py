"""Who and what the viewer serves: hosts, origins, messages, addresses, files outside."""

import base64
import http.client
import random
import re
import string
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus

from helpers.robots import arm
from helpers.viser_client import CAMERA, PlainClient
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.rl.runs.robot_source import OneRobot
from morphgen.viewer import robot_rows, robot_uri, simulation
from morphgen.viewer.app import address as addresses
from morphgen.viewer.app import server
from morphgen.viewer.app.address import PAGES, Address, AddressError, parse_address
from morphgen.viewer.app.app import start_address
from morphgen.viewer.app.server import AccessPolicy, access_policy, refusal_reason
from morphgen.viewer.robot_uri import FileAccess, UriError, read_robot_uri

HUB = "https://hub.example.com"


def asked(gate, host, origin=None, path="/"):
    headers = Headers({"Host": host} if host is not None else {})
    if origin is not None:
        headers["Origin"] = origin
    return refusal_reason(gate, path, headers)


@pytest.mark.parametrize(
    ("bound", "host", "origin"),
    [
        ("127.0.0.1", "localhost:8080", None),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("127.0.0.1", "LOCALHOST:8080", "http://localhost:8080"),
        ("::1", "[::1]:8080", "http://[::1]:8080"),
        ("127.0.0.1", "localhost:9000", "http://localhost:9000"),  # ssh -L 9000:localhost:8080
        ("127.0.0.1", "localhost", "https://localhost"),  # behind a proxy with TLS
        ("127.0.0.1", "localhost:8080", HUB),  # a proxy that keeps the origin
        ("127.0.0.1", "hub.example.com", HUB),  # a proxy that keeps both
        ("box", "box:8080", "http://box:8080"),
        ("192.168.1.5", "192.168.1.5:8080", "http://192.168.1.5:8080"),
        ("0.0.0.0", "192.168.1.5:8080", "http://192.168.1.5:8080"),
        ("0.0.0.0", "localhost:8080", None),
        ("::", "[fe80::1]:8080", "http://[fe80::1]:8080"),
    ],
)
def test_own_host_names_and_allowed_origins_are_accepted(bound, host, origin):
    assert asked(access_policy(bound, [HUB]), host, origin) == ""


@pytest.mark.parametrize(
    ("bound", "host", "origin"),
    [
        ("127.0.0.1", "localhost:8080", "http://evil.example"),
        ("127.0.0.1", "localhost:8080", "null"),
        ("127.0.0.1", "localhost:8080", ""),
        ("127.0.0.1", "localhost:8080", "http://localhost:3000"),
        ("127.0.0.1", "localhost:8080", "http://127.0.0.1:8080"),
        ("127.0.0.1", "localhost:8080", "file://localhost:8080"),
        ("127.0.0.1", "localhost:8080", "http://localhost:99999"),
        ("127.0.0.1", "localhost:8080", "http://localhost.evil.example:8080"),
        ("127.0.0.1", "evil.example:8080", "http://evil.example:8080"),  # DNS rebinding
        ("127.0.0.1", "evil.example:8080", None),
        ("127.0.0.1", "localhost.:8080", None),
        ("127.0.0.1", "me@localhost:8080", None),
        ("127.0.0.1", "localhost:8080/x", None),
        ("127.0.0.1", "192.168.1.5:8080", None),
        ("127.0.0.1", "", None),
        ("127.0.0.1", "[::1", None),
        ("127.0.0.1", None, None),
        ("0.0.0.0", "evil.example:8080", "http://evil.example:8080"),
        ("0.0.0.0", "192.168.1.5:8080", "http://203.0.113.9"),
        ("0.0.0.0", "192.168.1.5:8080", "http://evil.example"),
    ],
)
def test_other_host_names_and_origins_are_rejected(bound, host, origin):
    assert asked(access_policy(bound), host, origin)


def test_duplicate_host_or_origin_headers_are_rejected():
    for key in ("Host", "Origin"):
        headers = Headers([("Host", "localhost"), ("Origin", "http://localhost")])
        headers[key] = headers[key]
        assert refusal_reason(AccessPolicy(), "/", headers).startswith("expected one Host")


@pytest.mark.parametrize(
    "query",
    [
        "websocket=wss://evil.example",
        "robot=x&websocket=ws://evil.example:8080/",
        "websocket=",
        "playbackPath=a.viser",
        "%77ebsocket=wss://evil.example&robot=x",
    ],
)
def test_url_cannot_connect_to_another_server(query):
    assert "another server" in asked(AccessPolicy(), "localhost:8080", path=f"/?{query}")


@pytest.mark.parametrize(
    "origin", ["null", "*", "evil.example", "http://", "http://a/b", "ftp://a", "http://u@a", ""]
)
def test_malformed_origin_is_rejected(origin):
    with pytest.raises(MorphgenError, match=re.escape(f"--allow-origin {origin!r}: expected")):
        access_policy("127.0.0.1", [origin])


@pytest.mark.parametrize(
    ("host", "origin", "why"),
    [
        (None, "http://evil.example", b"may not use this viewer"),
        ("evil.example", "http://evil.example", b"is not a name of this viewer"),
    ],
)
def test_foreign_origin_or_host_name_gets_no_websocket(shared_viewer, host, origin, why):
    with pytest.raises(InvalidStatus) as refused:
        PlainClient(shared_viewer.port, host=host, origin=origin)
    assert refused.value.response.status_code == 403
    assert why in refused.value.response.body


def test_own_pages_and_allowed_origins_get_a_websocket(viewer):
    on = viewer(origins=[HUB])
    for origin in (None, f"http://127.0.0.1:{on.port}", HUB):
        with PlainClient(on.port, origin=origin) as client:
            client.shows("Grammars")


def fetched(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for key, value in headers.items():
        connection.putheader(key, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer, answer.read()


def test_pages_are_served_only_to_own_host_names(viewer, quiet):
    port = viewer().port
    answer, page = fetched(port, Host=f"localhost:{port}")
    assert (answer.status, b"<html" in page) == (200, True)
    assert b">Playback</a>" in page  # the bar is there before a page is built
    assert f"connect-src 'self' ws://localhost:{port} " in answer.headers["Content-Security-Policy"]
    assert "frame-ancestors 'self' ;" in answer.headers["Content-Security-Policy"]
    for headers in (
        {"Host": "evil.example"},
        {"Host": f"localhost:{port}", "Origin": "http://evil.example"},
        {},
    ):
        answer, page = fetched(port, **headers)
        assert (answer.status, b"<html" in page) == (403, False)
    answer, page = fetched(port, "/?websocket=wss://evil.example", Host="localhost")
    assert (answer.status, b"another server" in page) == (403, True)
    for path in ("/%00", "/" + "a" * 9000, "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd"):
        answer, page = fetched(port, path, Host="localhost")
        assert (answer.status, b"root:" in page) == (404, False)


def test_invalid_requests_leave_no_traceback(viewer, quiet):
    port = viewer().port
    for data in (b"\x16\x03\x01\x02\x00", b"GET / HTTP/1.1\r\nHost", b"a" * 70_000, b"\r\n\r\n"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.connect()
        connection.sock.sendall(data)
        connection.close()
    assert fetched(port, Host="localhost")[0].status == 200


def test_recording_server_rejects_all_clients():
    made = server.start_server("127.0.0.1", 0, AccessPolicy(names=frozenset()))
    try:
        with pytest.raises(InvalidStatus):
            PlainClient(made.get_port())
    finally:
        made.stop()


RECTANGLE = {"type": "ScenePointerMessage", "event_type": "rect-select", "modifier": None}
RECTANGLE |= {"ray_origin": None, "ray_direction": None, "screen_pos": [[0.1, 0.1], [0.5, 0.5]]}


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\xc1",
        b"\x91" * 100_000,
        msgspec.msgpack.encode([1, 2]),
        msgspec.msgpack.encode({"no": "type"}),
        {"type": "NoSuchMessage"},
        {"type": "ShareUrlRequest"},
        {"type": "RunJavascriptMessage", "source": "alert()"},
        {"type": "GuiUpdateMessage", "uuid": 3, "updates": {}},
        {**RECTANGLE, "screen_pos": [[0.5, 0.5]]},
        {**RECTANGLE, "event_type": "click", "screen_pos": [[0.5, 0.5]]},  # no page takes it
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {}, "more": 1},
        {"type": "GuiUpdateMessage", "uuid": "x"},
        {**CAMERA, "wxyz": [1.0, 0.0]},
        {**CAMERA, "wxyz": [0.0, 0.0, 0.0, 0.0]},
        {**CAMERA, "position": [float("nan"), 0.0, 0.0]},
        {**CAMERA, "image_width": "wide"},
    ],
    ids=lambda message: repr(message)[:50],
)
def test_malformed_message_closes_only_its_connection(shared_viewer, quiet, message):
    with PlainClient(shared_viewer.port) as client, PlainClient(shared_viewer.port) as other:
        client.shows("Grammars")
        client.send(message)
        code, reason = client.until_closed()
        assert (code, bool(reason)) == (1008, True)
        other.shows("Grammars")


def test_a_text_message_closes_its_connection(shared_viewer):
    with PlainClient(shared_viewer.port) as client:
        client.shows("Grammars")  # a closed connection has no page to open
        client.websocket.send("text")
        assert client.until_closed() == (1008, "expected a binary message")


@pytest.mark.parametrize(
    ("kind", "label", "value", "why"),
    [
        ("Text", "Search", 3, "expected a text"),
        ("Text", "Search", "x" * 200_001, "expected a text"),
        ("Dropdown", "Sort by", "/etc/passwd", "not one of the choices"),
        ("Dropdown", "Sort by", ["name"], "not one of the choices"),
        ("ButtonGroup", "Page", "beyond", "not one of the choices"),
        ("UploadButton", "Open a URDF, an MJCF or a zip", "x", "takes no value such as"),
    ],
)
def test_invalid_control_values_are_rejected(shared_viewer, quiet, kind, label, value, why):
    with PlainClient(shared_viewer.port) as client:
        client.change(client.control(kind, label), value)
        client.shows("That did not work")
        client.shows(why)


@pytest.mark.parametrize(
    "updates", [{}, {"update_cb": []}, {"value": "x", "sync_cb": None}, {"_impl": 1}]
)
def test_messages_can_change_only_control_values(shared_viewer, quiet, updates):
    with PlainClient(shared_viewer.port) as client:
        search = client.control("Text", "Search")
        client.send({"type": "GuiUpdateMessage", "uuid": search, "updates": updates})
        client.shows("the value of a control, and nothing else of it")
        client.change(search, "ur5")
        client.until(lambda: "search=ur5" in client.text)


def test_slider_accepts_only_numbers_in_its_range(shared_viewer, capfd):
    with PlainClient(shared_viewer.port, "?robot=robots/some-arm") as client:
        shoulder = client.control("Slider", "shoulder")
        for value in (float("nan"), float("inf"), "far", None, True, [1]):
            client.change(shoulder, value)
            client.shows(f"expected a number, not {value!r}")
        client.change(shoulder, 1e300)
        client.until(lambda: "q=2,0.5,0.01,0.02" in client.text)
    assert capfd.readouterr().err == ""


KEYS = st.from_regex(r"[a-z][a-z_ ]{0,8}", fullmatch=True)
TEXTS = st.text(st.characters(codec="utf-8"), max_size=20)


@settings(max_examples=50)
@given(
    st.sampled_from(tuple(PAGES)),
    st.lists(TEXTS, min_size=1, max_size=4),
    st.lists(TEXTS, max_size=3),
    st.dictionaries(KEYS.filter(lambda key: key not in PAGES), TEXTS.filter(bool), max_size=3),
)
def test_formatted_url_is_parsed_back(page, subjects, robots, state):
    address = Address(page, tuple(subjects), state, tuple(robots) if page == "play" else ())
    assert parse_address(address.query) == address


def test_empty_query_is_the_first_page():
    assert parse_address("") is None
    assert parse_address("?") is None


@pytest.mark.parametrize(
    ("query", "why"),
    [
        ("?robbot=a", "did you mean 'robot'"),
        ("?robot=a&split=b", "two pages: robot and split"),
        ("?play=reach&robot=a&split=b", "two pages: split and play"),
    ],
)
def test_invalid_url_is_rejected(query, why):
    with pytest.raises(AddressError, match=why):
        parse_address(query)


def test_default_state_is_omitted():
    address = Address("gallery", ("robots",), {"n": "2", "sort": "name"})
    assert address.with_state(n="", sort="-mass").query == "?gallery=robots&sort=-mass"


@given(st.text(max_size=300))
def test_text_is_restored_from_a_url(text):
    address = Address("compose", ("chain",), {"text": addresses.pack_text(text)})
    assert "%" not in address.query
    assert addresses.unpack_text(parse_address(address.query).state["text"]) == text


def test_a_text_that_is_too_long_for_an_address_is_rejected():
    letters = random.Random(0).choices(string.printable, k=2 * addresses.MAX_PACKED)
    says = f"too long for the page.*at most {addresses.MAX_PACKED}"
    with pytest.raises(AddressError, match=says):
        addresses.pack_text("".join(letters))


BOMB = zlib.compress(b"a" * (addresses.MAX_UNPACKED + 1))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"no zlib", "no readable text"),
        (zlib.compress(b"a text")[:-3], "an incomplete text"),
        (zlib.compress(b"\xff\xfe"), "no readable text"),
        (BOMB, f"more than {addresses.MAX_UNPACKED} bytes"),
        ("!!", "no readable text"),
        ("A" * (addresses.MAX_PACKED + 1), f"at most {addresses.MAX_PACKED} are read"),
    ],
    ids=["zlib", "cut", "utf-8", "bomb", "letters", "long"],
)
def test_an_invalid_packed_text_is_rejected(content, why):
    if isinstance(content, bytes):
        content = base64.urlsafe_b64encode(content).decode().rstrip("=")
    with pytest.raises(AddressError, match=why):
        addresses.unpack_text(content)


@pytest.fixture
def opened(tmp_path, access, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_bundle(arm(), tmp_path / "robots" / "one", picture=False)
    return access


SPLIT = "extrapolation/primitives/reach"


@pytest.mark.parametrize(
    ("words", "query"),
    [
        ([], "?library="),
        (["robots"], "?gallery=robots"),
        (["robots/one"], "?robot=robots/one"),
        (["robots/one/robot.urdf"], "?robot=robots/one/robot.urdf"),
        ([SPLIT], f"?split={SPLIT}"),
        (["multi_finger"], "?compose=multi_finger"),
        (["base=planar", "ee=cube"], "?robot=words:base=planar%20ee=cube"),
        (["planar-cube"], "?robot=words:base=planar%20ee=cube"),
    ],
)
def test_a_target_opens_its_page(opened, words, query):
    assert start_address(words, opened).query == query


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["robotz"], "no such file or folder, .*, no split and no grammar; .* are valid, such as"),
        (["planar-cubw"], "'cubw' is not a part; did you mean 'cube'"),
        (["extrapolation/arm/reach"], "did you mean 'extrapolation/arms/reach'"),
        (["arm=ur6"], "did you mean 'ur5'|nearest"),
        (["/etc"], "outside of the folders"),
    ],
)
def test_an_unknown_target_is_rejected(opened, words, why):
    with pytest.raises(MorphgenError, match=why):
        start_address(words, opened)


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("robots/one", "arm"),
        ("robots/one/robot.urdf", "arm"),
        ("words:base=planar ee=cube", "planar-cube"),
        ("derivation:base=planar[top: ee=cube]", "planar-cube"),
        (f"split:{SPLIT}@test/chain-000001", "chain-000001"),
    ],
)
def test_robots_are_read(opened, uri, name):
    robot = read_robot_uri(uri, opened)
    assert robot.name.startswith(name)
    assert robot.dof > 0


@pytest.mark.parametrize(
    ("uri", "why"),
    [
        (f"split:{SPLIT}@both/x", "expected split:NAME@train/ROBOT"),
        (f"split:{SPLIT}@test/chain-000009", "did you mean 'chain-000001'|no test robot"),
        ("split:nothing@test/x", "no such file"),
        ("words:arm", "'arm' is not a part"),
    ],
)
def test_invalid_uris_give_the_reason(opened, uri, why):
    with pytest.raises(MorphgenError, match=why):
        read_robot_uri(uri, opened)


def test_the_content_hash_changes_with_the_file(opened):
    before = robot_uri.content_hash("robots/one", opened)
    assert robot_uri.content_hash("robots/one", opened) == before
    urdf = opened.path("robots/one/robot.urdf")
    urdf.write_text(urdf.read_text() + "\n")
    assert robot_uri.content_hash("robots/one", opened) != before
    words = "words:base=planar ee=cube"
    derivation = f"derivation:{robot_uri.resolve_derivation(words, opened)}"
    assert robot_uri.content_hash(words, opened) == robot_uri.content_hash(derivation, opened)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{uploads}/ab/a.urdf:3: bad", "upload:ab/a.urdf:3: bad"),
        ("{uploads}: bad", "upload:: bad"),
        ("{root}/robots/a: bad", "robots/a: bad"),
        ("{root} is not a bundle", ". is not a bundle"),
        ("{temporary}/tmpa1_b2/robot/robot.urdf: bad", "robot.urdf: bad"),
        ("{temporary}/tmpa1_b2/episode.mp4: bad", "episode.mp4: bad"),
        ("{temporary}/morphgen-uploads-x/a: bad", "a: bad"),
        ("x" * 2000, "x" * 1000 + "..."),
        ("a\0b\nc", "a\\x00b\\nc"),
    ],
)
def test_errors_contain_no_absolute_paths(text, expected):
    root, temporary = Path("/home/me/work"), tempfile.gettempdir()
    opened = FileAccess((), (root,), Path(temporary) / "morphgen-uploads-1")
    given = text.format(uploads=opened.uploads, root=root, temporary=temporary)
    assert opened.redact(given) == expected


def test_bundle_uses_library_meshes_only_if_the_robot_is_unchanged(opened, tmp_path):
    made = read_robot_uri("words:arm=ur5 ee=plane", opened)
    bundle = write_bundle(made, tmp_path / "robots" / "ur5", picture=False)
    read = read_robot_uri("robots/ur5", opened)
    assert robot_hash(robot_uri.with_library_meshes(read, opened.library)) == robot_hash(made)
    text = (bundle / "robot.urdf").read_text()
    (bundle / "robot.urdf").write_text(text.replace('mass value="3.7"', 'mass value="3.8"'))
    changed = read_robot_uri("robots/ur5", opened)
    assert changed.mass != made.mass
    assert robot_uri.with_library_meshes(changed, opened.library) is changed


def test_folders_are_listed(opened, tmp_path):
    broken = write_bundle(arm(), tmp_path / "robots" / "two", picture=False)
    (broken / "card.json").write_text("{")
    (tmp_path / "robots" / "three.urdf").write_text("<robot/>")
    rows = robot_rows.folder_rows("robots", opened)
    assert [(row.name, row.dof, row.findings) for row in rows] == [
        ("one", 4, ()),
        ("three.urdf", None, None),
        ("two", None, ("unreadable",)),
    ]
    assert robot_rows.robot_subfolders(tmp_path) == ["robots"]
    with pytest.raises(UriError, match="holds no robot"):
        robot_rows.folder_rows("uploads", opened)


def test_a_part_without_a_licence_leaves_the_facts_of_its_card(opened, tmp_path):
    parts = [{"label": "arm", "part": "a"}, {"label": "ee", "part": "b", "licence": "MIT"}]
    robot = replace(arm(), provenance={"parts": parts})
    write_bundle(robot, tmp_path / "robots" / "four", picture=False)
    row = next(row for row in robot_rows.folder_rows("robots", opened) if row.name == "four")
    assert (row.dof, row.licence, row.findings) == (4, "MIT", ())


def test_the_folder_of_all_uploads_has_no_address(opened):
    (opened.uploads / "secret").mkdir(parents=True)
    assert opened.path("upload:secret").name == "secret"
    for uri in ("upload:", "upload:.", "upload:secret/.."):
        with pytest.raises(UriError, match="no such file or folder"):
            opened.path(uri)


def test_splits_and_parts_are_listed(opened):
    rows = robot_rows.split_rows(SPLIT, robot_uri.resolve_split(SPLIT, opened))
    assert [row.role for row in rows] == ["train"] * 10 + ["test"] * 2
    parts = robot_rows.part_rows(opened.library)
    assert {row.role for row in parts} == {"arm", "ee", "body", "object"}
    assert "words:arm=ur5" in [row.uri for row in parts]


WORD = "tellnobody"
DEEP = "a=b[c:" * 1000 + "a=b" + "]" * 1000
NOTHING = "This address cannot be shown"


def error_of(on, query):
    """Return what the page of an invalid address shows."""
    with PlainClient(on.port, query) as client:
        client.until(lambda: NOTHING in client.text or "tag error" in client.text)
        return client.text.replace("&#x27;", "'")


@pytest.fixture
def secret(tmp_path):
    """Files outside the viewer's folder whose parse errors would quote a secret word."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    robot = f'<robot name="{WORD}"><link name="{WORD}"'
    contents = {"a.urdf": robot, "a.xacro": robot, "card.json": f'{{"{WORD}"'}
    contents |= {"a.grammar": f"robot -> {WORD} }}{WORD}\n", "a.yaml": f"{WORD}: {{{WORD}\n"}
    contents |= dict.fromkeys(("checkpoint.pt", "index.jsonl"), WORD)
    for name, content in contents.items():
        (folder / name).write_text(content)
    return folder


@pytest.mark.parametrize(
    "query",
    [
        "?compose={}/a.grammar",
        "?compose={}/a.yaml",
        "?robot={}/a.urdf",
        "?robot={}/a.xacro",
        "?robot={}",
        "?robot=words:{}/a.grammar",
        "?robot=words:{}/a.yaml more",
        "?robot=words:{}/a.urdf",
        "?robot=split:{}/a.yaml@test/x",
        "?robot=upload:{}/a.urdf",
        "?robot=upload:..",
        "?gallery={}",
        "?population={}",
        "?split={}/a.yaml",
        "?split={}",
        "?compare={}/a.urdf&compare={}/a.grammar",
        "?play=reach&policy={}/checkpoint.pt",
        "?play=reach&policy={}",
        "?play=&policy={}/a.yaml",
        "?play=reach&robot={}/a.urdf",
        "?play=reach&robot=words:{}/a.grammar",
        "?robot=../elsewhere/a.urdf",
        "?robot=robots/../../elsewhere/a.urdf",
        "?compose=./../elsewhere/a.grammar",
    ],
)
def test_url_reveals_nothing_outside_the_folders(shared_viewer, quiet, secret, query):
    shown = error_of(shared_viewer, query.replace("{}", str(secret)))
    assert re.search("outside of the folders|no such file", shown)
    assert WORD not in shown


@pytest.mark.parametrize(
    ("query", "why"),
    [
        ("?robot=%00", r"\\x00: no such file or folder"),
        ("?robot=" + "a" * 7000, "no such file or folder"),
        ("?robot=" + "a" * 10_000, "at most 8000 are read"),
        ("?robot=" + "a/" * 3000, "no such file or folder"),
        ("?robot=%ff%fe", "no such file or folder"),
        ("?robot=words:%00", "is not a part"),
        ("?robot=words:", "no robot is named"),
        ("?compose=%00.grammar", "no such file or folder"),
        ("?gallery=%00", "no such file or folder"),
        ("?split=%00", "no such file or folder"),
        ("?compare=%00&compare=%00", "no such file or folder"),
        ("?play=reach&policy=%00", "neither a checkpoint nor a policy"),
        ("?play=reach&policy=ikk", "did you mean 'ik'"),
        ("?robot=derivation:" + DEEP, "more than 100 parts"),
        ("?play=reach&robot=derivation:" + DEEP, "more than 100 parts"),
        ("?compare=derivation:" + DEEP, "more than 100 parts"),
        ("?robot=" + "&robot=".join("a" * 50), "no such file or folder"),
        ("?" + "&".join(f"k{i}=1" for i in range(1000)), "names no page"),
    ],
    ids=lambda each: each[:30],
)
def test_invalid_url_shows_an_error_message(shared_viewer, quiet, query, why):
    shown = error_of(shared_viewer, query)
    assert re.search(why, shown), shown[-600:]


@pytest.mark.parametrize("query", ["?compose=arm3&seed=²", f"?compose=arm3&number={'9' * 5000}"])
def test_an_invalid_number_counts_as_zero(shared_viewer, quiet, query):
    with PlainClient(shared_viewer.port, query) as client:
        client.until(lambda: "The same on the command line" in client.text)


def test_grammar_file_cannot_include_outside_files(shared_viewer, folder, secret):
    (folder / "mine.grammar").write_text(f'include "{secret}/a.grammar"\nrobot -> ur5\n')
    with PlainClient(shared_viewer.port, "?compose=mine.grammar") as client:
        client.shows("leads outside of")
        assert WORD not in client.text


def test_grammar_text_cannot_include_files(shared_viewer, secret):
    with PlainClient(shared_viewer.port, "?compose=arm3") as client:
        text = client.control("Text", "grammar")
        client.change(text, f'include "{secret}/a.grammar"\nrobot -> ur5\n')
        client.shows("a grammar given as text cannot include others")
        assert WORD not in client.text


def test_checkpoint_cannot_name_an_outside_robot(files, folder, secret, monkeypatch):
    (folder / "runs").mkdir(exist_ok=True)
    (folder / "runs" / "some.pt").touch()
    for name in (f"{secret}/a.urdf", f"{secret}/a.grammar", f"{secret}"):
        run = SimpleNamespace(source=OneRobot(name=name, task="reach", robot_hash=""))
        monkeypatch.setattr(simulation, "read_checkpoint", lambda path, run=run: (run, None))
        with pytest.raises(MorphgenError, match="outside of the folders") as refused:
            simulation.training_robots("runs/some.pt", files)
        assert WORD not in str(refused.value)


def test_card_cannot_name_an_outside_file(shared_viewer, folder, secret):
    bundle = write_bundle(arm(), folder / "robots" / "nosy", picture=False)
    card = (bundle / "card.json").read_text()
    (bundle / "card.json").write_text(card.replace('"robot.xml":', f'"{secret}/a.urdf":'))
    with PlainClient(shared_viewer.port, "?robot=robots/nosy") as client:
        client.shows("leads out of the folder")
