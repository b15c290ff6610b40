"""Fit primitives to every link of a robot, and store the fits of parts beside their manifests.

Meshes that are equal up to a rigid motion or a mirroring share one fit. Two landmarks are chosen
among the vertices of a mesh: vertices whose distance from the mean is rare. Each pair of vertices
of the other mesh at the same distances gives a candidate rotation and mirroring, which all vertices
then refine and confirm. Unlike principal axes, landmarks fix the pose of bodies of revolution, too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray

from morphgen.errors import FitError
from morphgen.fitting.canonical import canonical
from morphgen.fitting.link_fit import FitOptions, LinkFit, fit_shapes
from morphgen.fitting.quality import Quality, quality
from morphgen.fitting.solid import Solid, solid_of
from morphgen.fitting.token_shapes import token_of_primitives
from morphgen.formats import fits as fit_files
from morphgen.formats.files import write_file
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest
from morphgen.grammar.part import load_part
from morphgen.model.findings import Finding
from morphgen.model.geometry import Mesh, Pose, Shape, StoredFit, StoredFits
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map
from morphgen.typing import Array

_MAX_PAIRS = 2000
"""Largest number of landmark pairs that are tried, each as a rotation and as a mirroring."""
_NUM_SAMPLES = 32  # number of vertices that a candidate is tested on before all are
_ROUGH_TOLERANCE = 30.0
"""Largest error of a candidate before it is refined, relative to the tolerance."""


def congruence(a: trimesh.Trimesh, b: trimesh.Trimesh, tolerance: float = 1e-4) -> Array | None:
    """Return the motion (preferred) or mirroring (4, 4) that maps mesh a to b; None if none.

    Both must have as many vertices and faces. One of a body like a sphere may not be found.
    """
    if a.vertices.shape != b.vertices.shape or a.faces.shape != b.faces.shape:
        return None
    if np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces):
        return np.eye(4)
    centred_a, centred_b = _centred(a), _centred(b)
    radii, other_radii = (np.linalg.norm(points, axis=1) for points in (centred_a, centred_b))
    error = tolerance * 2 * float(radii.max())
    # If vertices move by the error, their mean moves by at most as much, and distances by twice.
    if np.abs(np.sort(radii) - np.sort(other_radii)).max() > 2 * error:
        return None
    for R in _candidate_rotations(centred_a, centred_b, 2 * error):
        sample = centred_a[:: max(len(centred_a) // _NUM_SAMPLES, 1)] @ R.T
        if b.kdtree.query(sample + b.vertices.mean(axis=0))[0].max() > _ROUGH_TOLERANCE * error:
            continue
        for T_b_a in (_transform(a, b, R), _refine(a, b, R)):
            if _maps(a, b, T_b_a, error):
                return T_b_a
    return None


def moved(shape: Shape, T_b_a: Array) -> Shape:
    """Return a primitive of frame a in frame b after a motion or mirroring, which is the same."""
    if isinstance(shape.geometry, Mesh):
        raise ValueError(f"{shape.geometry} is not a primitive")
    R = T_b_a[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6):
        raise ValueError(f"{R.tolist()} is neither a rotation nor a mirroring")
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(R)), 1.0])
    T_b_shape = T_b_a @ shape.T_link_shape.matrix @ mirror
    return canonical(replace(shape, T_link_shape=Pose.from_matrix(T_b_shape)))


def representatives(meshes: Sequence[trimesh.Trimesh]) -> list[tuple[int, Array]]:
    """Return each mesh's first congruent one, perhaps itself, and the transform from it."""
    shared: list[tuple[int, Array]] = []
    for index, mesh in enumerate(meshes):
        firsts = (first for first in range(index) if shared[first][0] == first)
        matches = ((first, congruence(meshes[first], mesh)) for first in firsts)
        match = next(((first, T) for first, T in matches if T is not None), None)
        shared.append(match or (index, np.eye(4)))
    return shared


def _centred(mesh: trimesh.Trimesh) -> Array:
    vertices = np.asarray(mesh.vertices)
    return np.asarray(vertices - vertices.mean(axis=0))


def _candidate_rotations(a: Array, b: Array, slack: float) -> Iterator[Array]:
    """Yield matrices (3, 3) that may map centred points to others: rotations, then mirrorings."""
    yield np.eye(3)
    radii, other_radii = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    ordered = np.sort(other_radii)
    # Number of points of b at the distance of each point of a.
    alike = np.searchsorted(ordered, radii + slack) - np.searchsorted(ordered, radii - slack)
    first = _landmark(alike, radii)
    off_axis = np.linalg.norm(np.cross(a, a[first]), axis=1) / radii[first]
    second = _landmark(alike, off_axis)
    apart = np.linalg.norm(a[first] - a[second])
    firsts, seconds = (
        np.flatnonzero(np.abs(other_radii - radii[landmark]) <= slack)
        for landmark in (first, second)
    )
    pairs = []
    for i in firsts:
        errors = np.abs(np.linalg.norm(b[seconds] - b[i], axis=1) - apart)
        pairs += [(i, j) for j in seconds[errors <= slack] if np.cross(b[i], b[j]).any()]
        if len(pairs) >= _MAX_PAIRS:
            break
    frame = _frame(a[first], a[second])
    for handedness in (1.0, -1.0):
        for i, j in pairs[:_MAX_PAIRS]:
            yield _frame(b[i], b[j]) @ np.diag([1.0, 1.0, handedness]) @ frame.T


def _landmark(alike: NDArray[np.intp], distance: Array) -> int:
    """Return the point with the fewest counterparts; near points would fix angles badly."""
    score = np.where(distance >= distance.max() / 2, alike, len(alike) + 1)
    return int(np.lexsort((-distance, score))[0])


def _frame(first: Array, second: Array) -> Array:
    """Return a right-handed frame, axes as columns: x to the first point, z normal to both."""
    x = first / np.linalg.norm(first)
    z = np.cross(first, second)
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _transform(a: trimesh.Trimesh, b: trimesh.Trimesh, R: Array) -> Array:
    """Return the transform that rotates and maps the mean of the vertices to the mean."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = R
    T_b_a[:3, 3] = b.vertices.mean(axis=0) - R @ a.vertices.mean(axis=0)
    return T_b_a


def _refine(a: trimesh.Trimesh, b: trimesh.Trimesh, R: Array) -> Array:
    """Return the least-squares transform between nearest vertices, of the same handedness.

    Orthogonal Procrustes: Umeyama, "Least-squares estimation of transformation parameters between
    two point patterns", 1991.
    """
    centred_a, centred_b = _centred(a), _centred(b)
    _, nearest = b.kdtree.query(centred_a @ R.T + b.vertices.mean(axis=0))
    U, _, Vt = np.linalg.svd(centred_b[nearest].T @ centred_a)
    handedness = np.sign(np.linalg.det(R) * np.linalg.det(U @ Vt))
    return _transform(a, b, U @ np.diag([1.0, 1.0, handedness]) @ Vt)


def _maps(a: trimesh.Trimesh, b: trimesh.Trimesh, T_b_a: Array, error: float) -> bool:
    """Test that vertices map to vertices, both ways, and triangle centres to triangles."""
    for mesh, other, T in ((a, b, T_b_a), (b, a, np.linalg.inv(T_b_a))):
        if other.kdtree.query(trimesh.transform_points(mesh.vertices, T))[0].max() > error:
            return False
    centres = trimesh.transform_points(a.triangles_center, T_b_a)
    squared, _, _ = igl.point_mesh_squared_distance(
        centres, np.asarray(b.vertices, np.float64), np.asarray(b.faces, np.int64)
    )
    return bool(squared.max() <= error**2)


TOKEN_OPTIONS = FitOptions(max_primitives=1)  # options of the primitive in a link's token
COLLISION_OPTIONS = FitOptions(max_primitives=4, iou=0.9)
"""Options of the primitives that replace a link's collision meshes."""


@dataclass(frozen=True)
class LinkReport:
    """The fit of one link."""

    link: str
    fit: LinkFit
    same_as: str | None = None  # the congruent link whose fit this link shares


@dataclass(frozen=True)
class FitReport:
    """The fits of the links of a robot."""

    robot: str
    options: FitOptions
    links: tuple[LinkReport, ...]  # links with shapes, in the robot's order
    findings: tuple[Finding, ...]  # links without a primitive, and meshes that were decimated

    @property
    def mean(self) -> Quality | None:
        """Means over the links, of Hausdorff distances the largest; None without links."""
        if not self.links:
            return None
        values = {
            name: [getattr(report.fit.quality, name) for report in self.links]
            for name in Quality.__dataclass_fields__
        }
        means = {name: float(np.mean(column)) for name, column in values.items()}
        return Quality(**means | {"hausdorff": max(values["hausdorff"])})

    def without_times(self) -> dict[str, object]:
        """Return plain data for a bundle's card: equal for the same robot, options and seed."""
        data = self.as_dict()
        for link in cast(list[dict[str, object]], data["links"]):
            del link["seconds"]
        return data

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON."""
        options = self.options
        of_spheres, of_primitives = ("spheres", "cover"), ("max_primitives", "iou")
        names = of_primitives if options.spheres is None else of_spheres
        return {
            "robot": self.robot,
            **{name: getattr(options, name) for name in names},
            "seed": options.seed,
            "links": [
                {"link": report.link, "same_as": report.same_as, **report.fit.as_dict()}
                for report in self.links
            ],
            "findings": [finding.as_dict() for finding in self.findings],
        }


def fit_links(
    robot: Robot, options: FitOptions, *, only: Collection[str] | None = None, jobs: int = 1
) -> FitReport:
    """Fit the collision shapes, or visuals, of every link or of some; congruent links share one."""
    solids: dict[str, Solid] = {}
    failures: dict[str, FitError] = {}
    links = [
        link for link in robot.links if link.solid_shapes and (only is None or link.name in only)
    ]
    for link in links:
        try:
            solids[link.name] = solid_of(link.solid_shapes)
        except FitError as error:
            failures[link.name] = error
    solid_links = [link for link in links if link.name in solids]
    shared = representatives([solids[link.name].mesh for link in solid_links])
    unique = [link for i, link in enumerate(solid_links) if shared[i][0] == i]
    inputs = [(link.solid_shapes, solids[link.name]) for link in unique]
    # A fit takes seconds: one item a worker at a time.
    attempts = parallel_map(partial(_try_fit, options), inputs, jobs, chunk=1)
    fits = {link.name: fit for link, fit in zip(unique, attempts, strict=True)}
    reports = []
    for i, link in enumerate(solid_links):
        first, T_link_first = shared[i]
        fit = fits[solid_links[first].name]
        if isinstance(fit, FitError):
            failures[link.name] = fit
        elif i == first:
            reports.append(LinkReport(link.name, fit))
        else:
            primitives = tuple(moved(shape, T_link_first) for shape in fit.primitives)
            single = fit.single and moved(fit.single, T_link_first)
            copy = replace(fit, primitives=primitives, single=single, seconds=0.0)
            reports.append(LinkReport(link.name, copy, solid_links[first].name))
    findings = []
    for link in links:
        where, solid = f"link {link.name}", solids.get(link.name)
        if link.name in failures:
            why = f"no primitive can stand for its shapes: {failures[link.name]}"
            fix = "give the link a collision shape with a volume, or none"
            findings.append(Finding("no-primitive", "warning", where, why, fix))
        elif solid and solid.decimated_from:
            counts = f"{solid.decimated_from} triangles were decimated to {len(solid.mesh.faces)}"
            fix = "give the link a lighter collision mesh"
            findings.append(Finding("mesh-decimated", "info", where, f"its {counts}", fix))
    return FitReport(robot.name, options, tuple(reports), tuple(findings))


def _try_fit(options: FitOptions, work: tuple[tuple[Shape, ...], Solid]) -> LinkFit | FitError:
    """Return the error instead: a link without a fit does not end the fits of the others."""
    shapes, solid = work
    try:
        return fit_shapes(shapes, options, solid=solid)
    except FitError as error:
        return error


def parts_with_meshes(library: Library, *, missing: bool = False) -> list[Manifest]:
    """Return unscaled parts with meshes; with ``missing``, those whose fits are not all stored."""
    stored = fit_files.read_stored_fits(library.folders) if missing else {}
    return [
        manifest
        for manifest in library.manifests()
        if not manifest.scaling and _mesh_keys(manifest) - stored.keys()
    ]


def _mesh_keys(manifest: Manifest) -> set[str]:
    shapes = (link.solid_shapes for link in load_part(manifest).fragment.links)
    return {fit_files.shapes_key(each) for each in shapes if fit_files.has_meshes(each)}


def store_parts(manifests: Sequence[Manifest], *, jobs: int = 1) -> Iterator[Path]:
    """Fit and store several parts; yield the path of each file when it is written."""
    yield from parallel_map(store_part, manifests, jobs, chunk=1)


def store_part(manifest: Manifest) -> Path:
    """Fit the links of a part, write the fits beside its manifest, and return the path."""
    fragment = load_part(manifest).fragment
    fits = {}
    for report in fit_links(fragment, COLLISION_OPTIONS).links:
        shapes = fragment.link(report.link).solid_shapes
        fit = _with_token(report.link, shapes, report.fit)
        fits[fit_files.shapes_key(shapes)] = fit.scaled(1 / fit_files.shapes_scale(shapes))
    path = manifest.path.with_name(manifest.path.stem + fit_files.SUFFIX)
    write_file(path, fit_files.fits_text(fits))
    return path


def fits_of(robot: Robot, report: FitReport, stored: StoredFits) -> dict[str, StoredFit]:
    """Return a report's fits by link, each with the link's token, by preference the known one."""
    fits = {}
    for row in report.links:
        shapes = robot.link(row.link).solid_shapes
        if known := fit_files.find_fit(shapes, robot, stored):
            fits[row.link] = replace(
                known, collision=row.fit.primitives, collision_iou=row.fit.quality.iou
            )
        else:
            fits[row.link] = _with_token(row.link, shapes, row.fit)
    return fits


def _with_token(link: str, shapes: Sequence[Shape], fit: LinkFit) -> StoredFit:
    """Return a link's fit with the primitive of its token, which is fitted if it is missing."""
    solid = solid_of(shapes)
    single = fit.single
    if single is None and fit_files.are_primitives(shapes):
        single = token_of_primitives(shapes)
    if single is None:
        fitted = fit_shapes(shapes, TOKEN_OPTIONS, solid=solid)
        (single,), token_iou = fitted.primitives, fitted.quality.iou
    elif fit.primitives == (single,):
        token_iou = fit.quality.iou
    else:
        token_iou = quality(solid, [single]).iou
    return StoredFit(link, single, fit.primitives, token_iou, fit.quality.iou)
