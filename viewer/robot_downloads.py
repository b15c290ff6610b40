"""What can be taken from a robot's page."""

from __future__ import annotations

import io
import shlex
from collections.abc import Callable

import viser
from PIL import Image

from morphgen.errors import MorphgenError
from morphgen.formats.bundle import MJCF, URDF
from morphgen.viewer import markup
from morphgen.viewer.address import Address
from morphgen.viewer.downloads import bundle_files, zipped
from morphgen.viewer.robot_state import (
    RobotPage,
)
from morphgen.viewer.robot_uri import UPLOAD, WORDS
from morphgen.viewer.session import (
    Session,
    in_worker,
    later,
    say,
    when,
)


def add_downloads(page: RobotPage) -> None:
    """Add buttons for the bundle, its files and a picture, and the command that makes the robot."""
    gui, session = page.session.client.gui, page.session
    for label, work in (
        ("Bundle (.zip)", lambda: _send_bundle(page)),
        ("URDF", lambda: _send_file(page, URDF)),
        ("MJCF", lambda: _send_file(page, MJCF)),
        ("Screenshot", lambda: _send_screenshot(page)),
    ):
        button = gui.add_button(label, icon=viser.Icon.DOWNLOAD)
        when(button, session, _in_background(session, work))
    gui.add_html(
        markup.framed("<h3>The same on the command line</h3>", markup.code(_command(page)))
    )
    compare = Address("compare", (page.place, page.place))
    gui.add_html(markup.framed(markup.link(compare, "compare it with another robot")))


def _command(page: RobotPage) -> str:
    if page.place.startswith(WORDS):
        return shlex.join(["morphgen", "compose", *page.place.removeprefix(WORDS).split()])
    derivation = page.robot.provenance.get("derivation")
    made = f"# {derivation}" if derivation else ""
    if ":" not in page.place:
        return f"morphgen show {shlex.quote(page.place)}\n{made}".rstrip()
    if page.place.startswith(UPLOAD):
        return f"# of the file that you sent: morphgen show FILE\n{made}".rstrip()
    return made


def _in_background(session: Session, work: Callable[[], object]) -> Callable[[], None]:
    return lambda: later(session, work)


def _send_bundle(page: RobotPage) -> None:
    say(page.session, "packing the bundle")
    files = in_worker(page.session, bundle_files, page.place, page.session.places)
    name = page.robot.name or "robot"
    page.session.client.send_file_download(
        f"{name}.zip", zipped(name, files), save_immediately=True
    )
    say(page.session, "")


def _send_file(page: RobotPage, file: str) -> None:
    files = in_worker(page.session, bundle_files, page.place, page.session.places)
    name = f"{page.robot.name or 'robot'}{file[-4:] if file == MJCF else '.urdf'}"
    page.session.client.send_file_download(name, files[file], save_immediately=True)


def _send_screenshot(page: RobotPage) -> None:
    camera = page.session.client.camera
    try:
        picture = page.session.client.get_render(
            camera.image_height, camera.image_width, transport_format="png", timeout=60.0
        )
    except (OSError, ValueError, RuntimeError, TimeoutError) as error:
        raise MorphgenError(f"the browser sent no picture: {error}") from error
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "PNG")
    name = f"{page.robot.name or 'robot'}.png"
    page.session.client.send_file_download(name, content.getvalue(), save_immediately=True)
