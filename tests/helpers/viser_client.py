"""A client of a viewer without a browser: it speaks viser's protocol over a real websocket."""

import contextlib
import http.client
import json
import re
import socket
import time
import uuid
from urllib.parse import quote

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 1200,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


class PlainClient:
    """Connects, asks for the page of a query when it is connected, and stores all messages."""

    def __init__(self, port, query="", *, origin=None, host=None, address="127.0.0.1", dark=False):
        name = f"[{address}]" if ":" in address else address
        self.query, self.dark, self.messages = query, dark, []
        self.address, self.port, self.host = address, port, host or f"{name}:{port}"
        self.websocket = connect(
            f"ws://{self.host}",
            origin=Origin(origin) if origin else None,
            subprotocols=[f"viser-v{viser.__version__}"],
            sock=socket.create_connection((address, port)),
            max_size=None,
            open_timeout=60,
        )

    def __enter__(self):
        self.send(CAMERA)
        return self

    def __exit__(self, *fault):
        self.websocket.close()

    def send(self, message):
        """Send a message, or bytes as they are."""
        data = message if isinstance(message, bytes) else msgspec.msgpack.encode(message)
        self.websocket.send(data)

    def until(self, condition, seconds=60):
        """Receive messages until a condition returns a true value; return that value."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := condition():
                return found
            try:
                self._take(self.websocket.recv(timeout=0.2))
            except TimeoutError:
                continue
        raise AssertionError(f"not within {seconds} s; the page shows ...{self.text[-2000:]!r}")

    def until_closed(self):
        """Receive messages until the server closes the connection; return code and reason."""
        try:
            while True:
                self._take(self.websocket.recv(timeout=60))
        except ConnectionClosed as closed:
            return closed.rcvd.code, closed.rcvd.reason

    @property
    def text(self):
        """All texts that the page has shown: HTML, notifications, labels."""
        return "\n".join(_texts(self.messages))

    @property
    def sources(self):
        """The JavaScript that the page has got, in its order."""
        return [m["source"] for m in self.messages if m["type"] == "RunJavascriptMessage"]

    @property
    def addresses(self):
        """The addresses that the page has shown, with the numbers of their pages."""
        found = re.findall(r'\.address\((\d+), "((?:[^"\\\\]|\\\\.)*)"', "\n".join(self.sources))
        return [(int(number), json.loads(f'"{query}"')) for number, query in found]

    def shows(self, text):
        """Wait until the page shows a text."""
        self.until(lambda: text in self.text)

    def control(self, kind, label):
        """Wait for the control of a kind with a label; return its identity."""

        def found():
            of_kind = [each for each in self.messages if each["type"] == f"Gui{kind}Message"]
            return next((m["uuid"] for m in of_kind if m["props"]["label"] == label), None)

        identity = self.until(found)
        # viser sends a control before it accepts values for it. A later message, or silence, shows
        # that it accepts them; a browser is never that quick.
        with contextlib.suppress(TimeoutError):
            self._take(self.websocket.recv(timeout=0.5))
        return identity

    def is_visible(self, control):
        """Return whether a control is shown."""
        about = [each for each in self.messages if each.get("uuid") == control]
        states = [each.get("props", each.get("updates", {})) for each in about]
        return [state["visible"] for state in states if "visible" in state][-1]

    def change(self, control, value=True):
        """Change a control's value, or press a button."""
        self.send({"type": "GuiUpdateMessage", "uuid": control, "updates": {"value": value}})

    def upload(self, name, content, *, size=None, parts=None):
        """Upload a file on the first page, in parts as a browser does."""
        button = self.control("UploadButton", "Open a URDF, an MJCF or a zip")
        self.control("Text", "Search")  # comes after the button: the server accepts its uploads
        transfer, step = uuid.uuid4().hex, 512 * 1024
        pieces = [content[at : at + step] for at in range(0, len(content), step)]
        begin = {
            "type": "FileTransferStartUpload",
            "source_component_uuid": button,
            "transfer_uuid": transfer,
            "filename": name,
            "mime_type": "",
            "part_count": len(pieces) if parts is None else parts,
            "size_bytes": len(content) if size is None else size,
        }
        self.send(begin)
        for i, piece in enumerate(pieces):
            part = {"part_index": i, "content": piece, "transfer_uuid": transfer}
            self.send({"type": "FileTransferPart", "source_component_uuid": button, **part})

    def sent_to(self):
        """Wait until the server makes the page open another one; return its query."""

        def found():
            orders = [each for each in self.sources if "?.visit(" in each]
            return orders and json.JSONDecoder().raw_decode(orders[-1].split("(", 1)[1])[0]

        return self.until(found)

    def _take(self, data):
        size = int.from_bytes(data[8:16], "little")
        plain = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
        for message in msgspec.msgpack.decode(plain)["messages"]:
            self.messages.append(message)
            if "?.connect(" in message.get("source", ""):
                self._open(json.JSONDecoder().raw_decode(message["source"].split("(", 1)[1])[0])

    def _open(self, token):
        """Ask for the page of the query, as the script of a page does."""
        connection = http.client.HTTPConnection(self.address, self.port, timeout=60)
        state = f"visit=0&dark={'yes' if self.dark else ''}"
        path = f"/morphgen/{token}?open={quote(self.query, safe='')}&{state}"
        connection.request("GET", path, headers={"Host": self.host})
        assert connection.getresponse().status == 200
        connection.close()


def _texts(value):
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _texts(each)
