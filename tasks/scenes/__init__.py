"""Scenes of the tasks: robots, obstacles and collision shapes."""
