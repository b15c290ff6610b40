"""Validation and editing of ``Robot``."""

from dataclasses import replace

import pytest

from helpers.robots import arm
from morphgen.errors import RobotError
from morphgen.model.robot import Frame, Joint, Link, Mimic, Robot
from morphgen.model.tree import rename, subtree


def test_duplicate_link_names_are_an_error():
    with pytest.raises(RobotError, match="two links are named 'a'"):
        Robot("r", (Link("a"), Link("a")), (Joint("j", "fixed", "a", "a"),))


def test_links_out_of_topological_order_are_an_error():
    joints = (Joint("j", "fixed", "c", "b"), Joint("k", "fixed", "a", "c"))
    with pytest.raises(RobotError, match="topological order"):
        Robot("r", (Link("a"), Link("b"), Link("c")), joints)


def test_a_home_of_the_wrong_length_is_an_error():
    with pytest.raises(RobotError, match="home has 1 values for 4 joints"):
        replace(arm(), home=(0.0,))


def test_a_frame_on_an_unknown_link_suggests_the_nearest():
    with pytest.raises(RobotError, match="did you mean 'upper'"):
        replace(arm(), frames=(Frame("tool", "uper"),))


def test_unknown_leaders_and_mimic_loops_are_errors():
    links = (Link("a"), Link("b"))
    with pytest.raises(RobotError, match="mimics 'nobody'"):
        Robot("r", links, (Joint("j", "revolute", "a", "b", mimic=Mimic("nobody")),))
    with pytest.raises(RobotError, match="j -> j"):
        Robot("r", links, (Joint("j", "revolute", "a", "b", mimic=Mimic("j")),))


def test_subtree_keeps_home_frames_and_mimics():
    part = subtree(arm(), "lower")
    assert [link.name for link in part.links] == ["lower", "slider", "left", "right"]
    assert part.home == (0.01, 0.02)
    assert part.frame("tool").link == "slider"


def test_a_subtree_without_a_mimic_leader_is_an_error():
    with pytest.raises(RobotError, match="mimics 'left'"):
        subtree(arm(), "lower", without=["left"])


def test_renaming_updates_every_reference():
    robot = rename(arm(), {"slider": "s"}, {"left": "l"})
    assert robot.frame("tool").link == "s"
    assert robot.joints[-1].mimic == Mimic("l", -1.0, 0.0)
    assert robot.joints[-1].parent == "s"
