"""What browsers may say: the messages that a page of the viewer sends, checked before viser acts.

viser sets whatever attribute a message names on whatever control it names. Anybody who can connect
can write such a message, so a page's code may rely on values only after they were checked here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import msgspec
import viser
from viser import _messages

from morphgen.errors import MorphgenError

LARGEST_UPLOAD = 100 * 2**20
"""Bytes of an upload."""
LONGEST_TEXT = 200_000
"""Characters of a text field."""
LONGEST_NAME = 1000
"""Characters of a name or of an address."""
LARGEST_NUMBER = 2**53
"""Numbers beyond it are no whole numbers in a browser."""
_SHORTEST = 1e-3
"""Length of a quaternion that still tells a direction."""

_TAKEN: dict[str, type[Any]] = {
    message.__name__: message
    for message in (
        _messages.ViewerCameraMessage,
        _messages.GuiUpdateMessage,
        _messages.TransformControlsUpdateMessage,
        _messages.TransformControlsDragStartMessage,
        _messages.TransformControlsDragEndMessage,
        _messages.LocalStorageGetItemResponseMessage,
        _messages.GetRenderResponseMessage,
        _messages.FileTransferStartUpload,
        _messages.FileTransferPart,
    )
}
"""Messages that the viewer's pages send; viser knows more."""

Refuse = Callable[[str], object]


class MessageError(MorphgenError):
    """A message with a value that its control cannot have."""


@dataclass
class _Transfer:
    """An upload on its way."""

    uuid: str
    size: int
    received: int = 0


def message_fault(data: object) -> str:
    """Why bytes of a websocket are no message of a page; empty if they are one."""
    if not isinstance(data, bytes):
        return "expected a binary message"
    try:
        content = msgspec.msgpack.decode(data)
        if not isinstance(content, dict) or not isinstance(content.get("type"), str):
            return "expected a message with a type"
        kind = _TAKEN.get(content.pop("type"))
        if kind is None:
            return "this page takes no message of that type"
        if not content.keys() <= {field.name for field in fields(kind)}:
            return "the message has a field that its type has not"
        msgspec.convert(content, kind)
    except (msgspec.MsgspecError, TypeError, ValueError, RecursionError) as error:
        return f"malformed message: {error}"
    if not _is_finite(content.values()) or math.hypot(*content.get("wxyz", (1.0,))) < _SHORTEST:
        return "a number of the message is not finite, or a quaternion is zero"
    return ""


def check_values(client: viser.ClientHandle, refuse: Refuse) -> None:
    """Check what a browser sends to controls, and what it uploads, before viser acts on it.

    Args:
        client: The browser; it has no controls yet.
        refuse: Told why something was not taken.
    """
    inbox, gui, connection = _Inbox(client.gui, refuse), client.gui, client._websock_connection
    for kind, handler, checked in (
        (_messages.GuiUpdateMessage, gui._handle_gui_updates, inbox.update),
        (_messages.FileTransferStartUpload, gui._handle_file_transfer_start, inbox.begin_upload),
        (_messages.FileTransferPart, gui._handle_file_transfer_part, inbox.take_part),
    ):
        connection.unregister_handler(kind, handler)  # type: ignore[arg-type]
        connection.register_handler(kind, checked)  # type: ignore[arg-type]


class _Inbox:
    """One browser's messages, checked and handed on to viser."""

    def __init__(self, gui: viser.GuiApi, refuse: Refuse) -> None:
        self._gui, self._refuse = gui, refuse
        self._transfer: _Transfer | None = None

    async def update(self, client_id: Any, message: _messages.GuiUpdateMessage) -> None:  # noqa: ANN401
        """Change a control."""
        handle = self._gui._gui_input_handle_from_uuid.get(message.uuid)
        if handle is None:
            return  # a control of the page before
        try:
            message.updates = {"value": _checked(handle, message.updates)}
        except MessageError as error:
            self._refuse(str(error))
            return
        await self._gui._handle_gui_updates(client_id, message)

    def begin_upload(
        self,
        client_id: Any,  # noqa: ANN401
        message: _messages.FileTransferStartUpload,
    ) -> None:
        """Begin an upload; one that is on its way is dropped."""
        self._drop()
        if why := _upload_fault(message):
            self._refuse(f"{message.filename[:LONGEST_NAME]}: {why}")
            return
        self._transfer = _Transfer(message.transfer_uuid, message.size_bytes)
        self._gui._handle_file_transfer_start(client_id, message)

    def take_part(self, client_id: Any, message: _messages.FileTransferPart) -> None:  # noqa: ANN401
        """Take a part of the upload that is on its way."""
        transfer = self._transfer
        if transfer is None or transfer.uuid != message.transfer_uuid:
            return
        transfer.received += len(message.content)
        if transfer.received > transfer.size:
            self._drop()
            self._refuse("an upload was longer than it was said to be; it was dropped")
            return
        self._gui._handle_file_transfer_part(client_id, message)

    def _drop(self) -> None:
        if self._transfer is not None:
            self._gui._current_file_upload_states.pop(self._transfer.uuid, None)
            self._transfer = None


def _upload_fault(message: _messages.FileTransferStartUpload) -> str:
    """Why an upload is not taken; empty if it is."""
    if message.size_bytes > LARGEST_UPLOAD:
        return (
            f"{message.size_bytes / 2**20:.0f} MB; at most {LARGEST_UPLOAD // 2**20} MB are taken: "
            "open it on this machine instead, with morphgen view"
        )
    if not 0 <= message.part_count <= message.size_bytes:
        return f"{message.size_bytes} bytes in {message.part_count} parts"
    return ""


@functools.singledispatch
def _checked_value(handle: object, value: object) -> object:
    """A value that a control can have, of what a browser sent."""
    raise MessageError("that control takes no value")


def _checked(handle: Any, updates: dict[str, object]) -> object:  # noqa: ANN401
    if updates.keys() != {"value"}:
        raise MessageError("a browser may change the value of a control, and nothing else of it")
    return _checked_value(handle, updates["value"])


@_checked_value.register(viser.GuiButtonHandle)
@_checked_value.register(viser.GuiCheckboxHandle)
def _(handle: object, value: object) -> bool:
    if not isinstance(value, bool):
        raise MessageError(f"expected true or false, not {value!r:.80}")
    return value


@_checked_value.register
def _(handle: viser.GuiTextHandle, value: object) -> str:
    if not isinstance(value, str) or len(value) > LONGEST_TEXT:
        raise MessageError(f"expected a text of at most {LONGEST_TEXT} characters")
    return value


@_checked_value.register(viser.GuiDropdownHandle)
@_checked_value.register(viser.GuiButtonGroupHandle)
def _(handle: Any, value: object) -> object:  # noqa: ANN401
    if value not in handle.options:
        raise MessageError(f"{value!r:.80} is none of the choices")
    return value


@_checked_value.register(viser.GuiSliderHandle)
@_checked_value.register(viser.GuiNumberHandle)
def _(handle: Any, value: object) -> float:  # noqa: ANN401
    return _within(value, handle.min, handle.max)


@_checked_value.register(viser.GuiMultiSliderHandle)
def _(handle: Any, value: object) -> list[float]:  # noqa: ANN401
    if not isinstance(value, list) or len(value) != len(handle.value):
        raise MessageError(f"expected {len(handle.value)} numbers, not {value!r:.80}")
    return [_within(each, handle.min, handle.max) for each in value]


def _within(value: object, low: float | None, high: float | None) -> float:
    """The nearest number of a range; a browser rounds, and so may leave it by a little."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MessageError(f"expected a number, not {value!r:.80}")
    low = -LARGEST_NUMBER if low is None else low
    high = LARGEST_NUMBER if high is None else high
    return min(max(value, low), high)


def _is_finite(values: Any) -> bool:  # noqa: ANN401
    """Whether all numbers in nested lists are finite."""
    for value in values:
        if isinstance(value, float) and not math.isfinite(value):
            return False
        if isinstance(value, list | tuple) and not _is_finite(value):
            return False
    return True
