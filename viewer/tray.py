"""The tray of robots that a user has chosen on any page, and the download of robots' bundles."""

from __future__ import annotations

import re
from collections.abc import Sequence

from morphgen.viewer.address import AddressError
from morphgen.viewer.robot_files import bundle_files, zip_files
from morphgen.viewer.robot_uri import UriError, uri_name
from morphgen.viewer.session import Session

MAX_EXPORT = 200 * 2**20
"""Largest export before compression [bytes]."""
MAX_NAME = 60
"""Longest name of a robot's folder in an export, after its number [characters]."""
_NOT_IN_NAMES = re.compile(r"[^\w.-]+")


def change_tray(session: Session, action: str, uri: str) -> None:
    """Do what a page's script asks for: an action of the page, or one of the tray.

    Args:
        session: The page.
        action: One of ``session.actions``, or ``choose`` or ``drop`` a robot, ``clear`` the tray,
            or ``download`` its robots.
        uri: Value of the action: URI of the robot.

    Raises:
        AddressError: If there is no such action, or the tray is full.
    """
    if action in session.actions:
        session.actions[action](uri)
    elif action == "choose":
        session.choose((*session.chosen, uri))
    elif action == "drop":
        session.choose([other for other in session.chosen if other != uri])
    elif action == "clear":
        session.choose(())
    elif action == "download":
        session.run_in_background(lambda: send_bundles(session, session.chosen))
    else:
        raise AddressError(
            f"{action!r:.40}: no action of the tray; expected choose, drop, clear or download"
        )


def send_bundles(session: Session, uris: Sequence[str]) -> None:
    """Send a zip with the bundles of robots, each in a folder of its name.

    Raises:
        UriError: If they are too large.
        MorphgenError: If a robot cannot be read.
    """
    futures = [session.workers.submit(bundle_files, uri, session.files) for uri in uris]
    files: dict[str, bytes] = {}
    size = 0
    for i, (uri, future) in enumerate(zip(uris, futures, strict=True)):
        session.set_status(f"packing {len(uris)} robots", i / len(uris))
        bundle = session.workers.result(future)
        name = _NOT_IN_NAMES.sub("-", uri_name(uri))[:MAX_NAME]
        files |= {f"{i:04d}-{name}/{path}": data for path, data in bundle.items()}
        size += sum(map(len, bundle.values()))
        if size > MAX_EXPORT:
            for waiting in futures:
                waiting.cancel()
            raise UriError(
                f"the first {i + 1} of {len(uris)} robots have {size / 2**20:.0f} MB; at most "
                f"{MAX_EXPORT // 2**20} MB are exported: select fewer, or copy their folders"
            )
    content = zip_files("robots", files)
    session.client.send_file_download("robots.zip", content, save_immediately=True)
    session.set_status("")
