"""Fit primitives to the meshes of a robot, and measure how well they fit."""
