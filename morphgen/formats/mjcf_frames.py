"""Frames of compiled MuJoCo models."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import mujoco

from morphgen.formats.mjcf_shapes import pose_of
from morphgen.model.geometry import Pose
from morphgen.model.robot import TOOL, Frame, Joint
from morphgen.model.tree import take_name

_TOOL_WORDS = ("tool", "tcp", "attachment", "pinch", "grip", "grasp", "ee", "eef", "end_effector")
"""Words in the name of a site that make it the tool, the most specific first."""


def read_frames(
    model: mujoco.MjModel,
    links: Mapping[int, str],
    T_link_body: Mapping[int, Pose],
    joints: Sequence[Joint],
) -> tuple[Frame, ...]:
    """Return a frame for every site with a name.

    A URDF has a link and a joint for a frame; a site whose name they would take from another link
    or joint gets ``_site`` appended. If neither a site nor a link is called ``tool``, the first
    site with a word such as ``attachment``, ``tcp`` or ``grip`` in its name is the frame ``tool``,
    besides its own. The order of the words decides, then that of the file.

    Args:
        model: The compiled model.
        links: Name of the link of every body of the robot, by index.
        T_link_body: Pose of every body's frame in its link's frame.
        joints: Joints of the robot.
    """
    taken = {*links.values(), *(joint.parent for joint in joints), *(j.child for j in joints)}
    joint_names = {joint.name for joint in joints}
    sites = []
    for site in range(model.nsite):
        body = int(model.site_bodyid[site])
        if model.site(site).name and body in links:
            T_body_site = pose_of(model.site_pos[site], model.site_quat[site])
            sites.append((model.site(site).name, links[body], T_link_body[body] @ T_body_site))
    names = {*taken, *(name for name, _, _ in sites)}
    frames = []
    for name, link, T_link_site in sites:
        is_taken = name in taken or f"{name}_joint" in joint_names
        own = take_name(f"{name}_site", names) if is_taken else name
        frames.append(Frame(own, link, T_link_site))
    if TOOL in taken or any(frame.name == TOOL for frame in frames):
        return tuple(frames)
    tool = next(
        (frame for word in _TOOL_WORDS for frame in frames if _has_word(frame.name, word)), None
    )
    if tool is None:
        return tuple(frames)
    return (*frames, Frame(TOOL, tool.link, tool.T_link_frame))


def _has_word(name: str, word: str) -> bool:
    """Return whether a name has a word: ``grip`` in ``left_gripper``, ``ee`` only on its own."""
    ending = "" if len(word) > 3 else r"(?![a-z])"
    return re.search(rf"(?<![a-z]){word}{ending}", name.lower()) is not None
