"""Rendered frames, the automatic camera and video files."""

import resource
from dataclasses import replace

import imageio.v2 as imageio
import numpy as np
import pytest

from helpers.goal_sets import draw_spec
from helpers.robots import arm
from helpers.scenes import door
from morphgen.errors import FormatError
from morphgen.model.geometry import Pose
from morphgen.tasks import renderer
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.renderer import (
    Renderer,
    RenderState,
    render_state,
    require_video_path,
    write_video,
)
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.sim.articulated import ObjectJoints
from morphgen.tasks.sim.base import Block, Scene

SIZE = (160, 120)


@pytest.fixture(scope="module")
def reach(cache):
    config = ReachConfig(num_goals=10, train_layouts=2, eval_layouts=1)
    return draw_spec(load_robot("arm3-stick"), config, obstacles=True, cache=cache)


@pytest.fixture(scope="module")
def push(cache):
    return draw_spec(load_robot("prims"), PushConfig(num_goals=10), cache=cache)


@pytest.fixture
def on(opened):
    return lambda spec, size=SIZE: opened(Renderer.of_spec(spec, size))


@pytest.fixture
def plain(opened):
    return lambda scene: opened(
        Renderer(scene, (), np.array([scene.robot.home]), np.zeros((0, 3)), SIZE)
    )


def at_goal(spec, i):
    """The first start state, with a goal."""
    return RenderState(spec.goals.q[0], markers={"goal": spec.goals.poses[i]})


def changed(a, b):
    """Return the mask of differing pixels, shape (height, width)."""
    return np.abs(a.astype(int) - b).max(axis=2) > 8


def test_frames_have_the_requested_size_and_are_reproducible(on, reach):
    drawing = on(reach)
    frame = drawing.frame(at_goal(reach, 1))
    assert (frame.shape, frame.dtype) == ((SIZE[1], SIZE[0], 3), np.uint8)
    drawing.frame(RenderState(reach.goals.q[5]))
    again = [each.frame(at_goal(reach, 1)) for each in (drawing, on(reach))]
    on(reach, (100, 80)).close()  # another renderer disturbs nothing
    again.append(drawing.frame(at_goal(reach, 1)))
    assert all(np.array_equal(frame, each) for each in again)


def test_goal_is_green_and_drawn_only_on_request(on, reach):
    drawing = on(reach)
    without = drawing.frame(RenderState(reach.goals.q[0]))
    shown = [drawing.frame(at_goal(reach, i)) for i in (1, 2)]
    spots = [changed(without, frame) for frame in shown]
    assert all(8 < spot.sum() < 600 for spot in spots)
    assert not (spots[0] & spots[1]).all()
    red, green, blue = shown[0][spots[0]].mean(axis=0)
    assert green > max(red, blue)


def test_block_and_ground_line_are_drawn_at_their_positions(on, push):
    drawing = on(push)
    start, line, q = push.goals.blocks[0], push.goals.line, push.goals.q[0]
    aside = start.copy()
    aside[1] = line
    x = push.goals.blocks[:, 0]
    markers = {"line": ((x.min() + x.max()) / 2, line, 0.0, 1.0, 0.0, 0.0, 0.0)}
    here, there = (drawing.frame(RenderState(q, block, markers)) for block in (start, aside))
    assert changed(here, there).sum() > 30
    strip = changed(here, drawing.frame(RenderState(q, start)))
    assert 20 < strip.sum() < 1500
    assert here[strip].mean(axis=0).argmax() == 1


def test_obstacles_are_drawn(on, reach):
    bare = replace(reach, scene=replace(reach.scene, obstacles=()))
    q = reach.goals.q[0]
    points = on(reach).points
    drawing = on(bare)
    drawing._camera = renderer._camera(points, SIZE[0] / SIZE[1])
    frame = on(reach).frame(RenderState(q))
    assert changed(frame, drawing.frame(RenderState(q))).sum() > 50
    moved = on(reach).frame(RenderState(q, obstacles=reach.goals.layouts[1]))
    assert changed(frame, moved).sum() > 50


@pytest.mark.parametrize("name", ["reach", "push"])
def test_camera_frames_the_whole_scene(name, request):
    """The test projects points itself, from the position and axes of the camera."""
    points = Renderer.of_spec(request.getfixturevalue(name)).points
    camera = renderer._camera(points, 4 / 3)
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * flat + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = points - (camera.lookat - camera.distance * forward)
    depth = seen @ forward
    half = np.tan(np.radians(renderer.FRONT_FOV / 2)) * depth
    assert depth.min() > 0
    vertical, across = seen @ np.cross(right, forward) / half, seen @ right / half / (4 / 3)
    most = max(np.abs(vertical).max(), np.abs(across).max())
    assert most == pytest.approx(renderer._MARGIN, abs=1e-6)


def test_robot_without_visuals_is_drawn_with_its_collision_shapes(plain):
    bare = replace(arm(), links=tuple(replace(link, visuals=()) for link in arm().links))
    block = Block((0.2, 0.2, 0.2), Pose((0.2, -0.5, 0.1)), 0.1)
    still, home = plain(Scene(bare, object=block, ground=None)), arm().home
    a, b = (still.frame(RenderState(q)) for q in (home, (-1.0, -0.5, 0.0, 0.0)))
    assert changed(a, b).sum() > 50
    with_block = still.frame(RenderState(home, (0.2, -0.5, 0.1, 1.0, 0.0, 0.0, 0.0)))
    assert changed(a, with_block).sum() > 50


def test_articulated_object_is_drawn_where_its_joint_is(plain):
    thing = door(Pose((0.3, 0.0, 0.0)))
    drawing, joints = plain(Scene(arm(), object=thing, ground=None)), ObjectJoints([thing])
    shut, ajar = (
        drawing.frame(RenderState(arm().home, joints.poses(np.array([q]))[0])) for q in (0.0, 1.0)
    )
    assert changed(shut, ajar).sum() > 50


def test_snapshot_is_one_environment_of_a_batch(reach, push):
    batch = batch_from_specs([reach, push], 2, sim="mujoco")
    batch.reset()
    reaching, pushing = render_state(batch, 0), render_state(batch, 1)
    assert reaching.block is None
    assert np.array_equal(pushing.block, batch.simulation.object_pose[1].numpy())
    assert np.array_equal(reaching.markers["goal"], batch.field("goal")[0].numpy())
    for env, now in enumerate((reaching, pushing)):
        assert len(now.q) == batch.specs[env].robot.dof
        assert np.array_equal(now.q, batch.q[env, : len(now.q)].numpy())
    assert pushing.markers["line"][1] == pytest.approx(batch.specs[1].goals.line)
    batch.close()


FRAMES = [np.full((48, 64, 3), value, dtype=np.uint8) for value in range(0, 250, 25)]


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_video_has_all_frames_the_frame_rate_and_reproducible_bytes(tmp_path, suffix):
    for name in ("a", "b"):
        write_video(iter(FRAMES), tmp_path / f"{name}{suffix}", fps=25)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a{suffix}", f"b{suffix}"]
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    with imageio.get_reader(tmp_path / f"a{suffix}") as reader:
        frames = [np.asarray(frame)[..., :3] for frame in reader]
        facts = reader.get_meta_data()
    assert len(frames) == len(FRAMES)
    assert frames[0].shape == FRAMES[0].shape
    for found, written in zip(frames, FRAMES, strict=True):
        assert abs(found.mean() - written.mean()) < 4
    assert facts.get("fps", 1000 / facts.get("duration", 1)) == 25


def test_failed_recording_leaves_no_partial_video(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")

    def broken():
        yield FRAMES[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(broken(), path, fps=25)
    assert [each.name for each in tmp_path.iterdir()] == ["film.mp4"]
    assert path.read_bytes() == b"old"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("film.avi", "the name of a video ends in .mp4 or .gif"),
        ("film", "the name of a video ends in .mp4 or .gif"),
        ("no/film.mp4", "there is no folder"),
    ],
)
def test_unwritable_video_path_is_rejected_at_once(tmp_path, name, says):
    with pytest.raises(FormatError, match=says):
        require_video_path(tmp_path / name)
    with pytest.raises(FormatError, match=says):
        write_video(FRAMES, tmp_path / name, fps=25)
    assert list(tmp_path.iterdir()) == []


NOISE = np.random.default_rng(0).integers(0, 255, (12, 120, 160, 3), dtype=np.uint8)


@pytest.fixture
def full_disk():
    """Limit the files of this process and of ffmpeg to 20 kB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_full_disk_while_recording_is_an_error(tmp_path, full_disk, name):
    with pytest.raises(FormatError, match=rf"cannot write .*{name}: (ffmpeg .* full, or|File too)"):
        write_video(NOISE, tmp_path / name, fps=25)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("exit 0", "ffmpeg ended early"),
        ("head -c 100000 >/dev/null; kill -9 $$", "ffmpeg ended early"),
        ("cat >/dev/null; exit 1", "No such file|ffmpeg left a video that cannot be read"),
        (None, "No such file or directory"),
    ],
)
def test_failing_or_missing_ffmpeg_is_an_error(tmp_path, monkeypatch, script, says):
    program = tmp_path / "ffmpeg"
    if script:
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    (tmp_path / "films").mkdir()
    with pytest.raises(FormatError, match=rf"cannot write .*film.mp4: ({says})") as refused:
        write_video(NOISE, tmp_path / "films" / "film.mp4", fps=25)
    assert "\n" not in str(refused.value)
    assert list((tmp_path / "films").iterdir()) == []
