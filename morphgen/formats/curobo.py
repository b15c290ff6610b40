"""Robot configurations of cuRobo: spheres, pairs to ignore and joints, beside a URDF.

The keys are those that cuRobo's ``KinematicsLoaderCfg`` and ``CSpaceParams`` read (format version
2.0, https://github.com/NVlabs/curobo). Keys with values that a robot does not determine, such as
limits of acceleration and jerk, are left out, so that cuRobo takes its defaults.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import yaml

from morphgen.errors import FormatError
from morphgen.formats.srdf import LinkSpheres, require_tool
from morphgen.model.robot import TOOL, Pair, Robot

CONFIG = "robot.yml"
"""Name of the configuration in an exported folder."""
FORMAT_VERSION = 2.0


def curobo_text(
    robot: Robot,
    spheres: Sequence[LinkSpheres],
    ignored: Iterable[Pair],
    urdf: str,
    comment: str,
) -> str:
    """Return a robot's configuration as YAML."""
    require_tool(robot)
    # "tool" of a robot with several limbs is the tool of the last one.
    names = (frame.name for frame in robot.frames)
    tools = [name for name in names if name.endswith(f"_{TOOL}")] or [TOOL]
    if not spheres:
        raise FormatError(f"robot {robot.name!r} has no link with spheres")
    links = [link.link for link in spheres]
    joints = [robot.joints[k].name for k in robot.independent_joints]
    ignore = defaultdict(list)
    for a, b in sorted(ignored):
        if a in links and b in links:
            ignore[a].append(b)
    kinematics = {
        "format_version": FORMAT_VERSION,
        "urdf_path": urdf,
        "asset_root_path": "",
        "base_link": robot.root.name,
        "tool_frames": tools,
        "collision_link_names": links,
        "collision_spheres": {
            link.link: [
                {"center": list(sphere.center), "radius": sphere.radius} for sphere in link.spheres
            ]
            for link in spheres
        },
        "collision_sphere_buffer": 0.0,
        "self_collision_ignore": dict(ignore),
        "self_collision_buffer": dict.fromkeys(links, 0.0),
        "mesh_link_names": [link.name for link in robot.links if link.visuals],
        "cspace": {
            "joint_names": joints,
            "default_joint_position": list(robot.home),
            "null_space_weight": [1.0] * len(joints),
            "cspace_distance_weight": [1.0] * len(joints),
        },
    }
    data = {"robot_cfg": {"kinematics": kinematics}}
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
    return f"# {comment}\n{text}"
