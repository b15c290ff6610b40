"""The parts of viser that the viewer needs and that viser keeps private.

No other module of the viewer uses a private name of viser. ``pyproject.toml`` requires viser below
1.2; check this module before raising that limit. Why each part is needed:

- ``RunJavascriptMessage``: viser has no public way to change a browser's URL.
- Callbacks of the camera: viser can add them, but not remove them.
- Message classes and handlers: viser applies what browsers send without validating it, so
  ``app.server`` has to see it first. Public callbacks run only after the value has been applied.
- Share links: a browser may ask viser to publish the page on the internet through another server,
  and viser has no option that forbids it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import viser
from viser import _messages

GuiUpdate = _messages.GuiUpdateMessage
UploadStart = _messages.FileTransferStartUpload
UploadPart = _messages.FileTransferPart
ScenePointer = _messages.ScenePointerMessage

ACCEPTED_MESSAGES: Mapping[str, type[Any]] = {
    message_type.__name__: message_type
    for message_type in (
        GuiUpdate,
        UploadStart,
        UploadPart,
        ScenePointer,
        _messages.SceneNodeClickMessage,
        _messages.ViewerCameraMessage,
        _messages.TransformControlsUpdateMessage,
        _messages.TransformControlsDragStartMessage,
        _messages.TransformControlsDragEndMessage,
    )
}
"""Messages that browsers send on the viewer's pages, by type name. viser itself accepts more."""

Handler = Callable[[Any, Any], Any]


def run_javascript(client: viser.ClientHandle, source: str) -> None:
    """Run JavaScript in a browser."""
    client._websock_connection.queue_message(_messages.RunJavascriptMessage(source=source))
    client.flush()


def clear_page(client: viser.ClientHandle) -> None:
    """Remove everything that a page has added to a browser: controls, nodes and callbacks."""
    with client.atomic():
        client.gui.reset()
        client.scene.reset()
    client.scene.remove_click_callback()
    client.scene.remove_rect_select_callback()
    client.camera._state.camera_cb.clear()


def remove_camera_callbacks(camera: viser.CameraHandle, kind: type) -> None:
    """Remove the callbacks of a camera that are instances of a class."""
    callbacks = camera._state.camera_cb
    callbacks[:] = [callback for callback in callbacks if not isinstance(callback, kind)]


def replace_handlers(
    client: viser.ClientHandle, handlers: Mapping[type[Any], Handler]
) -> Mapping[type[Any], Handler]:
    """Replace viser's handlers of a browser's messages; return viser's own by message class."""
    gui, connection = client.gui, client._websock_connection
    original: Mapping[type[Any], Handler] = {
        GuiUpdate: gui._handle_gui_updates,
        UploadStart: gui._handle_file_transfer_start,
        UploadPart: gui._handle_file_transfer_part,
    }
    for message_type, handler in handlers.items():
        connection.unregister_handler(message_type, original[message_type])
        connection.register_handler(message_type, handler)
    return original


def input_handle(client: viser.ClientHandle, uuid: str) -> Any | None:  # noqa: ANN401
    """Return the control that a browser's message names; None if the page has no such control."""
    return client.gui._gui_input_handle_from_uuid.get(uuid)


def discard_upload(client: viser.ClientHandle, transfer_uuid: str) -> None:
    """Free what has been received of an unfinished upload."""
    client.gui._current_file_upload_states.pop(transfer_uuid, None)


def disable_share_links(server: viser.ViserServer) -> None:
    """Ignore requests of browsers to publish the viewer on the internet."""
    for request in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(request)
