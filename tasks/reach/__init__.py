"""Reach: bring the tool to a goal, and keep it there."""

GOAL_KINDS = ("position", "pose")
"""Kinds of goals: the tool's position, or its position and orientation."""
