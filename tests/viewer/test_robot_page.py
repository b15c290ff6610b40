"""The robot page in a browser."""

import gc
import io
import os
import re
import signal
import subprocess
import weakref
import zipfile

import pytest
from PIL import Image

from helpers.pages import choose, field, nodes, press, wait_until
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.model.kinematics import frame_pose
from morphgen.viewer.pages.robot import format_joints
from morphgen.viewer.robot_uri import read_robot_uri
from morphgen.viewer.scene.robot import RED

ARM = "?robot=robots/some-arm"


def wait_for_page(page):
    page.get_by_text("no self-collision").or_(
        page.get_by_text("collision", exact=True)
    ).first.wait_for()


def show_tab(page, name):
    page.get_by_role("tab", name=name).click()


@pytest.mark.slow
def test_colliding_links_are_red(see, viewer):
    on = viewer()
    q = [0.0, -1.0, 2.6, 2.5, 0.0, 0.0]
    page = see(
        f"?robot=words:arm=ur5 ee=plane&q={format_joints(q)}&show=visual,ignored pairs", on=on
    )
    page.get_by_text("collision", exact=True).wait_for()
    robot = read_robot_uri("words:arm=ur5 ee=plane", on.files)
    (pairs,) = SelfCollisionChecker(robot).penetrations([q])
    assert len(pairs) > 0
    links = [robot.link_index[name] for pair in pairs for name in pair]
    for link in links:
        assert tuple(nodes(on)[f"/robot/{link}/visual0"].color) == RED
    assert nodes(on)["/robot/ignored"].visible
    show_tab(page, "Links")
    choose(page, "Link", "arm_forearm_link")
    page.wait_for_url(re.compile("link=arm_forearm_link"))
    assert all(tuple(nodes(on)[f"/robot/{link}/visual0"].color) == RED for link in links)
    show_tab(page, "Move")
    press(page, "home")
    page.get_by_text("no self-collision").wait_for()
    for link in links:
        assert tuple(nodes(on)[f"/robot/{link}/visual0"].color) != RED
    press(page, "random")
    page.wait_for_url(re.compile(r"[?&]q="))


@pytest.mark.slow
def test_workspace_and_gizmo(see, viewer, picture):
    on = viewer()
    page = see(f"{ARM}&show=visual,workspace,drag the tool", on=on)
    wait_for_page(page)
    field(page, "shoulder").last.fill("-0.5")
    page.wait_for_url(re.compile(r"q=-0\.5"))
    field(page, "shoulder").last.fill("0.5")
    page.wait_for_url(re.compile(r"q=0\.5"))
    names = nodes(on)
    page.wait_for_timeout(1000)
    assert {"/robot/workspace", "/gizmo"} <= names.keys()
    robot = read_robot_uri("robots/some-arm", on.files)
    pose = frame_pose(robot, [0.5, *robot.home[1:]])
    assert names["/gizmo"].position == pytest.approx(pose[:3, 3], abs=1e-6)
    picture(page)


@pytest.mark.slow
def test_a_bundle_is_downloaded_whole(see, folder):
    page = see(ARM)
    wait_for_page(page)
    show_tab(page, "Get")
    with page.expect_download() as found:
        page.get_by_role("button", name="Bundle (.zip)").click()
    with zipfile.ZipFile(found.value.path()) as archive:
        names = set(archive.namelist())
    assert {"arm/robot.urdf", "arm/robot.xml", "arm/card.json"} <= names
    with page.expect_download() as found:
        page.get_by_role("button", name="Screenshot").click()
    picture = Image.open(io.BytesIO(found.value.path().read_bytes()))
    assert picture.size[0] > 300
    assert len(picture.convert("RGB").getcolors(10**6)) > 20


@pytest.mark.slow
def test_killed_browser_leaves_no_resources(see, viewer, browser_command, tmp_path, capfd):
    on = viewer()
    query = "?robot=words:arm=panda%20ee=panda_hand&show=visual,workspace,primitives"
    own = ("--headless", f"--user-data-dir={tmp_path}", f"http://127.0.0.1:{on.port}/{query}")
    browser = subprocess.Popen(
        [*browser_command, *own], stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        wait_until(lambda: any(session.status for session in list(on.sessions.values())))
        (session,) = on.sessions.values()
    finally:
        os.killpg(browser.pid, signal.SIGKILL)
        browser.wait()
    wait_until(lambda: not on.sessions)
    for threads in (session.events, session.background):
        threads.shutdown(wait=True)
    freed = weakref.ref(session)
    del session, threads
    wait_for_page(see(ARM, on=on))
    gc.collect()
    assert freed() is None
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.slow
def test_an_upload_is_shown(see, tmp_path):
    page = see("?library=")
    button = page.get_by_role("button", name="Open a URDF")
    button.wait_for()
    (tmp_path / "some.xml").write_text(
        '<mujoco model="sent"><worldbody><body name="a"><geom type="box" size="1 1 1"/></body>'
        "</worldbody></mujoco>"
    )
    with page.expect_file_chooser() as chooser:
        button.click()
    chooser.value.set_files(tmp_path / "some.xml")
    page.wait_for_url(re.compile(r"robot=upload:"))
    page.get_by_text("sent").first.wait_for()
