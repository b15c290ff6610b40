"""Use the controls of a page of the viewer in a browser, and what tests upload to it."""

import gc
import io
import time
import zipfile

FIELD = "xpath=ancestor::*[.//input][1]//input"


def field(page, label, nth=0):
    """Return the input fields of viser's control with a label; a slider's number is the last."""
    return page.get_by_text(label, exact=True).nth(nth).locator(FIELD)


def choose(page, label, option, nth=0):
    """Choose an option of a dropdown."""
    field(page, label, nth).first.click()
    page.get_by_role("option", name=option, exact=True).click()


def press(page, name):
    """Press a button."""
    page.get_by_role("button", name=name, exact=True).click()


def nodes(viewer):
    """Return the scene nodes of the only browser by name, as stored on the server."""
    (session,) = viewer.sessions.values()
    return session.client.scene._handle_from_node_name


def wait_until(condition):
    """Wait until a condition holds; collect garbage meanwhile."""
    until = time.monotonic() + 60
    while not condition() and time.monotonic() < until:
        gc.collect()
        time.sleep(0.1)
    assert condition()


def click_on(node, **more):
    """Return the message of a click on a scene node that a client was sent."""
    message = {"type": "SceneNodeClickMessage", "name": node["name"], "owner": node["owner"]}
    message |= {"instance_index": None, "modifier": None, "screen_pos": [0.5, 0.5]}
    ray = {"ray_origin": [1.0, 0.0, 0.0], "ray_direction": [-1.0, 0.0, 0.0]}
    return {**message, **ray, **more}


URDF = b'<robot name="r"><link name="a"/></robot>'


def archive(files, how=zipfile.ZIP_STORED):
    """Return a zip of files by their paths."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", how) as made:
        for name, data in files.items():
            made.writestr(name, data)
    return content.getvalue()
