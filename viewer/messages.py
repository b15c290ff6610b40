"""Validation of the messages that browsers send, before viser acts on them.

Threat: viser sets whatever attribute a message names on whatever control it names, with any value.
Everybody who can connect can write such messages by hand, so a page's code may rely on a control's
value only because it was validated here. Two layers: ``message_fault`` rejects messages that no
page of the viewer sends (the connection is closed), and ``MessageFilter`` rejects values that a
control cannot have and uploads that are too large (the page shows why).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import msgspec
import viser

from morphgen.errors import MorphgenError
from morphgen.viewer.viser_internals import (
    ACCEPTED_MESSAGES,
    GuiUpdate,
    ScenePointer,
    UploadPart,
    UploadStart,
    discard_upload,
    input_handle,
    replace_handlers,
)

MAX_UPLOAD = 100 * 2**20
"""Largest upload [bytes]."""
MAX_TEXT = 200_000
"""Longest value of a text field [characters]."""
MAX_NAME = 1000
"""Longest part of a file name that an error message repeats [characters]."""
MAX_NUMBER = 2**53
"""Limit of number fields without their own: larger integers are not exact in a browser."""
MIN_QUATERNION_NORM = 1e-3
"""Shortest quaternion that still defines a rotation."""


class MessageError(MorphgenError):
    """A message has a value that its control cannot have."""


@dataclass
class _Upload:
    """An upload that is being received."""

    uuid: str
    size: int
    """Announced size [bytes]."""
    received: int = 0
    """Size received so far [bytes]."""


def message_fault(data: object) -> str:
    """Return why data from a websocket is not a message of a page; empty if it is one."""
    if not isinstance(data, bytes):
        return "expected a binary message"
    try:
        content = msgspec.msgpack.decode(data)
        if not isinstance(content, dict) or not isinstance(content.get("type"), str):
            return "expected a message with a type"
        message_type = ACCEPTED_MESSAGES.get(content.pop("type"))
        if message_type is None:
            return "this page accepts no message of that type"
        if not content.keys() <= {field.name for field in fields(message_type)}:
            return "the message has a field that its type does not have"
        msgspec.convert(content, message_type)
    except (msgspec.MsgspecError, TypeError, ValueError, RecursionError) as error:
        return f"malformed message: {error}"
    if message_type is ScenePointer and not _is_gesture(content):
        return "a click needs a ray and a point, a rectangle needs two points"
    norm = math.hypot(*content.get("wxyz", (1.0,)))
    if not _all_finite(content.values()) or norm < MIN_QUATERNION_NORM:
        return "a number of the message is not finite, or a quaternion is zero"
    return ""


def _is_gesture(content: dict[str, Any]) -> bool:
    """Return whether the fields of a pointer message, which have valid types, fit its gesture."""
    points = content["screen_pos"]
    if content["event_type"] != "click":
        return len(points) == 2
    return len(points) == 1 and None not in (content["ray_origin"], content["ray_direction"])


class MessageFilter:
    """Handlers that validate one browser's messages and pass valid ones on to viser."""

    def __init__(self, client: viser.ClientHandle, report: Callable[[str], object]) -> None:
        """Replace viser's handlers of values for controls and of uploads.

        Args:
            client: The browser; its page has no controls yet.
            report: Called with the reason when a value or upload is rejected.
        """
        self._client, self._report = client, report
        self._upload: _Upload | None = None
        self._viser = replace_handlers(
            client,
            {
                GuiUpdate: self.update,
                UploadStart: self.start_upload,
                UploadPart: self.receive_part,
            },
        )

    async def update(self, client_id: Any, message: GuiUpdate) -> None:  # noqa: ANN401
        """Set the value of a control."""
        handle = input_handle(self._client, message.uuid)
        if handle is None:
            return  # a control of the previous page
        try:
            if message.updates.keys() != {"value"}:
                raise MessageError(
                    "a browser may change the value of a control, and nothing else of it"
                )
            message.updates = {"value": _valid_value(handle, message.updates["value"])}
        except MessageError as error:
            self._report(str(error))
            return
        await self._viser[GuiUpdate](client_id, message)

    def start_upload(self, client_id: Any, message: UploadStart) -> None:  # noqa: ANN401
        """Start an upload; an unfinished one is dropped, so a browser holds at most one."""
        self._drop_upload()
        if reason := _upload_fault(message):
            self._report(f"{message.filename[:MAX_NAME]}: {reason}")
            return
        self._upload = _Upload(message.transfer_uuid, message.size_bytes)
        self._viser[UploadStart](client_id, message)

    def receive_part(self, client_id: Any, message: UploadPart) -> None:  # noqa: ANN401
        """Receive a part of the current upload."""
        upload = self._upload
        if upload is None or upload.uuid != message.transfer_uuid:
            return
        upload.received += len(message.content)
        if upload.received > upload.size:
            self._drop_upload()
            self._report("an upload was longer than its announced size; it was dropped")
            return
        self._viser[UploadPart](client_id, message)

    def _drop_upload(self) -> None:
        if self._upload is not None:
            discard_upload(self._client, self._upload.uuid)
            self._upload = None


def _upload_fault(message: UploadStart) -> str:
    """Return why an upload is rejected; empty if it is accepted."""
    if message.size_bytes > MAX_UPLOAD:
        return (
            f"{message.size_bytes / 2**20:.0f} MB; at most {MAX_UPLOAD // 2**20} MB are accepted: "
            "open it on this machine instead, with morphgen view"
        )
    # viser waits for all parts in memory: more parts than bytes would never end.
    if not 0 <= message.part_count <= message.size_bytes:
        return f"{message.size_bytes} bytes in {message.part_count} parts"
    return ""


@functools.singledispatch
def _valid_value(handle: object, value: object) -> object:
    """Return a browser's value for a control, clipped to the range of a slider or number field."""
    raise MessageError("that control takes no value")


@_valid_value.register(viser.GuiButtonHandle)
@_valid_value.register(viser.GuiCheckboxHandle)
def _(handle: object, value: object) -> bool:
    if not isinstance(value, bool):
        raise MessageError(f"expected true or false, not {value!r:.80}")
    return value


@_valid_value.register
def _(handle: viser.GuiTextHandle, value: object) -> str:
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise MessageError(f"expected a text of at most {MAX_TEXT} characters")
    return value


@_valid_value.register(viser.GuiDropdownHandle)
@_valid_value.register(viser.GuiButtonGroupHandle)
def _(handle: Any, value: object) -> object:  # noqa: ANN401
    if value not in handle.options:
        raise MessageError(f"{value!r:.80} is not one of the choices")
    return value


@_valid_value.register(viser.GuiSliderHandle)
@_valid_value.register(viser.GuiNumberHandle)
def _(handle: Any, value: object) -> float:  # noqa: ANN401
    return _clip(value, handle.min, handle.max)


@_valid_value.register(viser.GuiMultiSliderHandle)
def _(handle: Any, value: object) -> list[float]:  # noqa: ANN401
    if not isinstance(value, list) or len(value) != len(handle.value):
        raise MessageError(f"expected {len(handle.value)} numbers, not {value!r:.80}")
    return [_clip(number, handle.min, handle.max) for number in value]


def _clip(value: object, low: float | None, high: float | None) -> float:
    """Clip a number to a range; browsers round, and so may leave it by a little."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MessageError(f"expected a number, not {value!r:.80}")
    low = -MAX_NUMBER if low is None else low
    high = MAX_NUMBER if high is None else high
    return min(max(value, low), high)


def _all_finite(values: Any) -> bool:  # noqa: ANN401
    """Return whether all numbers in nested lists are finite."""
    return all(
        _all_finite(value)
        if isinstance(value, list | tuple)
        else not isinstance(value, float) or math.isfinite(value)
        for value in values
    )
