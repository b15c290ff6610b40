"""Overlays of the robot page, and the camera that is pointed at robots."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.pages import nodes as scene_nodes
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.formats.bundle import write_bundle
from morphgen.viewer.scene import overlays as workspace
from morphgen.viewer.scene.stage import add_scale_bar, look_at

ARM = "?robot=robots/some-arm"


@pytest.fixture(scope="module")
def ball():
    """Points in a spherical shell with radii 0.5 to 1 m around (0, 0, 0.3)."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.uniform(0.5, 1.0, (200_000, 1)) * directions + [0, 0, 0.3]


def test_the_shell_encloses_the_points(ball):
    vertices, faces = workspace.shell(ball)
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.05)


def test_a_slice_has_the_hole_of_the_workspace(ball):
    section = workspace.cut(ball, 0.0)
    radii = np.linalg.norm(section.centres - [0, 0, 0.3], axis=1)
    assert radii.min() > 0.5 - 2 * section.side
    assert radii.max() < 1.0 + 2 * section.side
    assert len(radii) * section.side**2 == pytest.approx(np.pi * 0.75, rel=0.15)
    assert section.density.max() == pytest.approx(1.0)


def test_toggles_draw_grown_shapes_names_boxes_and_the_workspace(viewer):
    on = viewer()
    shown = "visual,collision,inertia,x-ray,frames,joint axes,centres of mass,names,workspace"
    with PlainClient(on.port, f"{ARM}&show={shown}&slice=0.05") as client:
        client.shows("no self-collision")
        nodes = scene_nodes(on)
        client.until(lambda: "/robot/workspace_slice" in nodes)
        client.shows("slice=0.05")
        client.shows("200,000 random configurations")
        slide = client.control("Slider", "slice at y [m]")
        client.change(slide, 0.03)
        client.shows("slice=0.03")
        assert nodes["/robot/1/visual0"].opacity == pytest.approx(0.2)
        assert nodes["/robot/1/name"].text == "upper"
        assert {"/robot/1/inertia", "/robot/1/axis", "/robot/1/com"} <= nodes.keys()
        assert nodes["/robot/1"].show_axes
        radius = np.linalg.norm(nodes["/robot/1/collision0"].vertices[:, :2], axis=1).max()
        assert 0.0205 < radius < 0.03  # the cylinder has 0.02 m
        client.change(client.control("Checkbox", "visual"), False)
        client.shows("show=collision,inertia,x-ray,frames")
        assert nodes["/robot/1/visual0"].visible
        client.change(client.control("Checkbox", "x-ray"), False)
        client.until(lambda: not nodes["/robot/1/visual0"].visible)
        client.until(
            lambda: (
                np.linalg.norm(nodes["/robot/1/collision0"].vertices[:, :2], axis=1).max() < 0.0201
            )
        )
        client.change(client.control("Checkbox", "workspace"), False)
        client.until(lambda: "/robot/workspace" not in nodes)


def test_findings_about_inertia_are_written_beside_the_boxes(shared_viewer, folder):
    links = [replace(link, inertial=None) if link.name == "lower" else link for link in arm().links]
    write_bundle(replace(arm(), links=tuple(links)), folder / "robots" / "light", picture=False)
    with PlainClient(shared_viewer.port, "?robot=robots/light&show=visual,inertia") as client:
        (found,) = client.until(
            lambda: [
                m["props"]["text"]
                for m in client.messages
                if m["type"] == "LabelMessage" and "lower" in m["props"]["text"]
            ]
        )
        assert found == "lower: inertia-missing"


POINT = np.zeros(3)
LOW, HIGH = np.array([-1.0, -0.2, 0.0]), np.array([1.0, 0.2, 0.5])


class Camera(SimpleNamespace):
    """A camera of a browser with a picture of an aspect."""

    def __init__(self, aspect):
        callbacks = []
        state = SimpleNamespace(camera_cb=callbacks)
        super().__init__(aspect=aspect, position=np.zeros(3), callbacks=callbacks, _state=state)

    def on_update(self, callback):
        self.callbacks.append(callback)

    def resize(self, aspect):
        self.aspect = aspect
        for callback in self.callbacks:
            callback(self)

    @property
    def distance(self):
        return float(np.linalg.norm(self.position - self.look_at))


def looking(aspect):
    camera = Camera(aspect)
    look_at(SimpleNamespace(camera=camera), LOW, HIGH, (0.0, -1.0, 0.2))
    return camera


@pytest.mark.parametrize("before", [0.14, 1.5])
def test_the_camera_is_placed_again_when_panels_open_or_close(before):
    camera = looking(before)
    camera.resize(0.9)
    assert camera.distance == pytest.approx(looking(0.9).distance)
    assert camera.distance > 1.2 * looking(1.5).distance


def test_the_strip_beside_a_gallery_does_not_decide_the_distance():
    assert looking(0.14).distance == looking(1.0).distance


def test_a_camera_that_the_user_has_moved_stays():
    camera = looking(1.2)
    camera.position = camera.position + 0.1
    before = camera.position.copy()
    camera.resize(0.9)
    np.testing.assert_array_equal(camera.position, before)


def test_a_robot_without_shapes_has_a_scale_bar():
    labels = []
    scene = SimpleNamespace(
        add_batched_meshes_simple=lambda *args, **options: None,
        add_label=lambda name, text, position: labels.append(text),
    )
    add_scale_bar(scene, POINT, POINT, (1.0, 0.0, 0.0))
    assert labels == ["1 cm"]
