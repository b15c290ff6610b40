"""The camera that is pointed at robots."""

from types import SimpleNamespace

import numpy as np
import pytest

from morphgen.viewer.scene.stage import add_scale_bar, look_at

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
