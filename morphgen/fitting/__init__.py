"""Fit primitives to the meshes of a robot, and measure how well they fit.

``fitted_robot`` fits a whole robot anew, for ``morphgen fit``; ``replace_collision`` gives robots
of any other command their kind of shapes, and takes stored or cached fits before it makes one. Both
call ``robot_fit`` for the links of a robot and ``link_fit`` for one link:
``link_fit.fit_solid`` chooses how many primitives, and ``search`` their kinds, places and sizes by
gradient ascent. ``quality`` measures the result.
"""
