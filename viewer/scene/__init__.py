"""Drawings in the three-dimensional scene of the viewer."""
