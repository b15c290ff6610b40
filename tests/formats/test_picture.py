"""Offscreen OpenGL contexts, and the libraries that a process must load in a certain order."""

import subprocess
import sys
from importlib.util import find_spec

import pytest

import morphgen
from morphgen.errors import MissingDependencyError
from morphgen.formats import picture


def test_triton_is_imported_before_an_opengl_library(monkeypatch):
    imported = []

    def import_module(name):
        imported.append(name)
        raise ImportError(f"no {name}")

    monkeypatch.setattr(picture, "import_module", import_module)
    monkeypatch.setattr(picture, "find_spec", lambda name: name == "triton")
    with pytest.raises(MissingDependencyError, match=r"egl: no mujoco\.egl; osmesa: no mujoco\."):
        picture.gl_context(8, 8)
    assert imported == ["triton", "mujoco.egl", "mujoco.osmesa"]


@pytest.mark.skipif(find_spec("triton") is None, reason="this PyTorch has no triton")
def test_a_process_can_draw_and_then_import_triton():
    code = "from morphgen.formats.picture import gl_context; gl_context(8, 8).free(); import triton"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("words", ["prims", "arm3-stick", "base=gantry ee=plane"])
def test_a_picture_does_not_depend_on_optional_packages(words, tmp_path, monkeypatch):
    composed = morphgen.compose(words)
    mjcf = morphgen.write(composed, tmp_path, picture=False) / "robot.xml"
    image = picture.render(composed, mjcf, size=(64, 48))
    for package in ("pybullet", "trimesh", "viser"):
        monkeypatch.setitem(sys.modules, package, None)
    assert picture.render(composed, mjcf, size=(64, 48)).tobytes() == image.tobytes()
    assert len(image.getcolors()) > 1
