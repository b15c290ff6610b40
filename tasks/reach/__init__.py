"""Reach: bring the tool to a goal, and keep it there."""
