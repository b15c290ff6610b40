"""Episodes of one robot with a controller."""

from contextlib import closing

from morphgen.rl.play import make_env_and_controller, play, read_controller


def test_an_episode_ends_early_after_successes_in_a_row(tmp_path):
    spec = read_controller("ik", "reach")
    env, controller = make_env_and_controller(spec, "arm3-stick", 0, sim="mujoco", cache=tmp_path)
    with closing(env):
        early, whole = [], []
        list(play(env, controller, 2, 0, early.append, max_successes=5))
        list(play(env, controller, 2, 0, whole.append))
    assert [episode.steps for episode in whole] == [300, 300]
    for episode in early:
        assert episode.success
        assert 5 <= episode.steps < 300
