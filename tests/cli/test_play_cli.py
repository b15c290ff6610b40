"""``morphgen play``: output, video file and rejected input."""

import re

import imageio.v2 as imageio
import pytest

from helpers.commands import tree

LINE = re.compile(
    r"episode (\d+): (success|failure), (\d+\.\d{3}) m from the (goal|line), "
    r"score (-?\d+\.\d\d), (\d+\.\d\d) s"
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _own_cache(cache, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))


def parse_episodes(out):
    """Parse the printed line of every episode."""
    return [LINE.fullmatch(line).groups() for line in out.splitlines() if "episode" in line]


def test_ik_policy_reaches_the_goal(run, tmp_path):
    code, out, err = run("play", "reach", "arm3-stick", "--policy", "ik", "--sim", "mujoco")
    assert (code, err) == (0, "")
    ((number, result, distance, place, score, seconds),) = parse_episodes(out)
    assert (number, result, place, seconds) == ("1", "success", "goal", "6.00")
    assert float(distance) < 0.03
    assert float(score) > 0
    assert tree(tmp_path) == {}


@pytest.mark.slow
def test_scripted_policy_pushes_before_the_time_limit_and_is_recorded(run, tmp_path):
    words = ("play", "push", "prims", "--policy", "scripted", "--sim", "mujoco")
    code, out, err = run(*words, "--out", "push.mp4")
    assert (code, err) == (0, "")
    ((_, result, distance, place, score, seconds),) = parse_episodes(out)
    assert (result, distance, place, score) == ("success", "0.000", "line", "1.00")
    assert float(seconds) < 6
    assert out.splitlines()[-1] == "push.mp4"
    assert list(tree(tmp_path)) == ["push.mp4"]
    with imageio.get_reader("push.mp4") as film:
        frames, fps = film.count_frames(), film.get_meta_data()["fps"]
    assert fps == 25
    assert 0 <= frames / fps - float(seconds) <= 0.08


def test_baselines_play_with_goals_that_are_poses(run):
    words = ("play", "reach", "arm3-stick", "--policy", "ik", "--sim", "mujoco", "--goal", "pose")
    code, out, err = run(*words)
    assert (code, err) == (0, "")
    result, angle = re.match(r"episode 1: (\w+), .* m and (.*) degrees from the goal", out).groups()
    assert result == "success"
    assert float(angle) < 10


def test_episodes_differ_and_are_reproducible(run):
    words = ("play", "reach", "arm3-stick", "--sim", "mujoco", "--episodes", "2", "--obstacles")
    outs = [run(*words, "--seed", seed, "--kind", "discrete")[1] for seed in (1, 1, 2)]
    assert outs[0] == outs[1] != outs[2]
    first, second = parse_episodes(outs[0])
    assert first[2:] != second[2:]


@pytest.mark.slow
def test_zero_policy_does_not_move(run):
    code, out, _ = run("play", "push", "prims", "--policy", "zero", "--sim", "mujoco")
    assert code == 0
    ((_, result, distance, _, score, seconds),) = parse_episodes(out)
    assert (result, score, seconds) == ("failure", "0.00", "6.00")
    assert 0.3 < float(distance) < 0.5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("reach", "arm3-stick", "--policy", "scripted"), "valid: ik, jacobian, zero, random"),
        (("push", "prims", "--policy", "ik"), "valid: scripted, zero, random"),
        (("push", "prism"), "did you mean 'prims'?"),
        (("push", "prims", "--out", "film.avi"), "the name of a video ends in .mp4 or .gif"),
        (("push", "prims", "--out", "no/film.mp4"), "there is no folder no"),
        (("push", "arm=ur5", "ee=plain"), "did you mean 'plane'?"),
    ],
)
def test_invalid_arguments_are_rejected(refused, words, message):
    assert message in refused("play", *words)


@pytest.mark.parametrize(
    "words", [("lift", "prims"), ("push", "prims", "--policy", "magic"), ("push",)]
)
def test_invalid_choices_are_rejected(words, refused):
    assert "see morphgen play --help" in refused("play", *words)
