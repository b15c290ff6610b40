"""Replace the meshes of a gripper by primitives, measure the fit, and cover it with spheres.

Prints for each link the primitives, the share of volume that they have in common with the mesh
(IoU), how far their surfaces are apart, and the number of spheres: planners on GPUs take a robot as
spheres. Takes about 10 s.
"""

import math
from collections.abc import Iterator

import numpy as np

import morphgen
from morphgen.model.geometry import Box, Cylinder, Shape, Sphere

# %%
# Fit up to two boxes, cylinders and spheres to each link.
fitted = morphgen.fit("rethink", max_primitives=2)
for row in fitted.report.links:
    kinds = [type(shape.geometry).__name__ for shape in row.fit.primitives]
    quality = row.fit.quality
    apart = 1000 * max(quality.protrusion_p95, quality.gap_p95)
    print(f"{row.link}: {', '.join(kinds)}, IoU {quality.iou:.3f}, {apart:.1f} mm apart (95%)")


# %%
# Cover a primitive by spheres along its longest edge; each encloses a slice of its bounding box.
def cover(shape: Shape) -> Iterator[tuple[np.ndarray, float]]:
    """Yield centres in the link frame [m] and radii [m] of spheres that enclose a primitive."""
    match shape.geometry:
        case Box(size):
            edges = np.array(size)
        case Cylinder(radius, length):
            edges = np.array([2 * radius, 2 * radius, length])
        case Sphere(radius):
            yield np.array(shape.T_link_shape.position), radius
            return
        case other:
            raise TypeError(f"{type(other).__name__} is not a box, cylinder or sphere")
    axis = int(edges.argmax())
    across = np.delete(edges, axis)
    count = math.ceil(edges[axis] / across.max())
    reach = math.hypot(*across, edges[axis] / count) / 2
    T_link_shape = shape.T_link_shape.matrix
    for i in range(count):
        centre = np.zeros(3)
        centre[axis] = ((i + 0.5) / count - 0.5) * edges[axis]
        yield T_link_shape[:3, :3] @ centre + T_link_shape[:3, 3], reach


# %%
# The fitted robot is a robot like any other: write it, or use its shapes.
for link in fitted.robot.links:
    spheres = [sphere for shape in link.collisions for sphere in cover(shape)]
    if spheres:
        largest = max(radius for _, radius in spheres)
        print(f"{link.name}: {len(spheres)} spheres, largest radius {1000 * largest:.0f} mm")
