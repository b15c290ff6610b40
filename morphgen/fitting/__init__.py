"""Boxes, cylinders and spheres in place of a link's meshes, and how well they stand for them."""
