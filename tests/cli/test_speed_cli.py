"""``morphgen speed``: output and rejected input."""

import json

import pytest

from helpers.simulators import PYBULLET
from morphgen.cli import main


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("sim", [PYBULLET, "mujoco", "kinematic"])
def test_speed_prints_rates_and_shares(sim, capsys):
    words = ["speed", "reach", "arm3", "--envs", "2", "--seconds", "0.05", "--sim", sim]
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["steps_per_second"] > 0
    assert sum(facts["shares"].values()) == pytest.approx(1)
    assert facts["shares"]["simulator"] > 0
    assert main(words) == 0
    text = capsys.readouterr().out
    assert f"reach, arm3, 2 environments, {sim}, cpu, 1 worker(s)" in text
    assert "physics steps per second" in text


def test_robots_above_the_default_max_links_can_be_measured(capsys):
    words = ["speed", "reach", "chain", "beads=7", "--envs", "1", "--seconds", "0.05"]
    assert main([*words, "--sim", "mujoco"]) == 0
    assert "reach, chain" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["reach", "arm3", "--seconds", "0"], "argument --seconds: 0: expected a number above 0"),
        (["reach", "arm3", "--sim", "mujoco", "--device", "cuda"], "device 'cuda'"),
        (["reach", "ur55-plane"], "'ur55' is not a part"),
        (
            ["push", "prims", "--sim", "kinematic"],
            "has no contacts, and push of 'prims' has a block",
        ),
    ],
)
def test_invalid_arguments_are_rejected(words, named, capsys):
    assert main(["speed", *words]) == 2
    assert named in capsys.readouterr().err
