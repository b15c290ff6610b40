"""Fit primitives to the meshes of a robot, and measure how well they fit.

``collision_geometry`` chooses the kind of shapes by name, ``replace_collision`` takes stored or
cached fits, ``robot_fit`` fits the links of a robot and ``link_fit`` one link: with ``search`` by
gradient ascent, or with ``enclose`` around all of it. ``quality`` measures the result.
"""
