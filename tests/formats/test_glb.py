"""Binary glTF: nodes, bounds and colours as trimesh reads them."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.glb import T_GLTF_ROOT, glb_bytes
from morphgen.model.geometry import Box, Shape
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Frame


def loaded(robot):
    return trimesh.load(io.BytesIO(glb_bytes(robot)), file_type="glb")


def bounds_at_home(robot):
    points = []
    for link, T in zip(robot.links, forward_kinematics(robot, robot.home), strict=True):
        for shape in link.visuals:
            mesh = solid_mesh(shape.geometry)
            T_scene_shape = T_GLTF_ROOT @ T @ shape.T_link_shape.matrix
            points.append(trimesh.transform_points(mesh.vertices, T_scene_shape))
    points = np.concatenate(points)
    return np.array([points.min(axis=0), points.max(axis=0)])


def test_bounds_are_those_of_the_robot_at_home():
    robot = arm()
    np.testing.assert_allclose(loaded(robot).bounds, bounds_at_home(robot), atol=1e-6)


def test_links_and_frames_are_nodes_below_their_parents():
    robot = arm()
    data = glb_bytes(robot)
    assert data == glb_bytes(robot)
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    nodes = document["nodes"]
    children = {
        node["name"]: {nodes[i]["name"] for i in node.get("children", ())} for node in nodes
    }
    assert children["slider"] == {
        "left", "right", "tool", "slider_visual_0", "slider_visual_1"
    }  # fmt: skip
    assert children["upper"] == {"lower", "upper_visual_0"}
    scene = loaded(robot)
    T_root_link = forward_kinematics(robot, robot.home)
    for link, T in zip(robot.links, T_root_link, strict=True):
        np.testing.assert_allclose(scene.graph[link.name][0], T_GLTF_ROOT @ T, atol=1e-7)


def test_colours_are_kept():
    see_through = Shape(Box((0.1, 0.1, 0.1)), rgba=(0.2, 0.4, 0.6, 0.6))
    robot = arm()
    base = replace(robot.links[0], visuals=(see_through, Shape(Box((0.2, 0.1, 0.1)))))
    scene = loaded(replace(robot, links=(base, *robot.links[1:])))
    materials = {name: mesh.visual.material for name, mesh in scene.geometry.items()}
    assert materials["base_visual_0"].baseColorFactor.tolist() == [51, 102, 153, 153]
    assert materials["base_visual_0"].alphaMode == "BLEND"
    assert materials["base_visual_1"].baseColorFactor[3] == 255
    assert materials["upper_visual_0"].baseColorFactor.tolist() == [204, 102, 26, 255]


def test_frame_named_like_a_link_gets_a_free_name():
    robot = replace(arm(), frames=(Frame("upper", "slider"),))
    graph = loaded(robot).graph
    assert {"upper", "upper_2"} <= set(graph.nodes)


def test_robot_without_visuals_is_refused():
    robot = arm()
    bare = replace(robot, links=tuple(replace(link, visuals=()) for link in robot.links))
    with pytest.raises(FormatError, match="'arm' has no visual shape, so a GLB would be empty"):
        glb_bytes(bare)
