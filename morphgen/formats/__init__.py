"""Robots in and out: URDF, xacro, MJCF, meshes, the bundle and its picture."""
