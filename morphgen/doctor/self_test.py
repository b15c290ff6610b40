"""Files that morphgen reads, and the self-test: a robot is composed, checked, loaded and drawn."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from morphgen.checks import check
from morphgen.checks.conformance import ConformanceRow, conformance
from morphgen.doctor import Entry, attempt, failure
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import MorphgenError, PartError, one_line
from morphgen.files import file_sha256
from morphgen.formats.bundle import MJCF, write_bundle
from morphgen.formats.picture import gl_context, render
from morphgen.formats.resolve import REQUIREMENTS, distribution_file
from morphgen.grammar.catalogue import source_digest, stored_facts
from morphgen.grammar.compose import compose
from morphgen.grammar.library import LIBRARY_VARIABLE, Library, default_library, shipped_folders
from morphgen.grammar.manifest import PART_KINDS, PackageSource
from morphgen.grammar.request import parse_words
from morphgen.model.robot import Robot
from morphgen.rl.shipped_policies import POLICIES
from morphgen.splits.split import split_id
from morphgen.splits.split_file import read_split, split_names
from morphgen.tasks.goals.goal_sets import FOLDER, packaged_index
from morphgen.tasks.registry import SIMULATORS

ROBOT = "ur5-plane"  # robot of the self-test: a real arm with meshes, and a template
CONFIGURATIONS = 5  # number of random configurations in which loaders are compared
PICTURE_SIZE = (160, 120)  # width and height of the picture [px]
STEP = 0.1  # distance of the target of the simulators' step from the home position [rad]
ROS_VARIABLES = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
"""Environment variables with folders in which meshes of imported robots are searched first."""


def files() -> Iterator[Entry]:
    """Examine the files."""
    yield attempt("library", _library)
    for package in REQUIREMENTS:
        yield attempt(f"robots of {package}", partial(_robot_package, package))
    for variable in ROS_VARIABLES:
        if os.environ.get(variable):
            text = f"{os.environ[variable]}; imported URDFs find packages there first"
            yield Entry(variable, "ok", text)
    yield attempt("splits", _splits)
    yield attempt("goal sets", _goal_sets)
    yield attempt("policies", _policies)


def _library() -> Entry:
    """Count the parts, and name the folders of the user's own."""
    library = default_library()
    try:
        library.paths  # noqa: B018 - which reads the folders
    except PartError as error:
        variable = f"{LIBRARY_VARIABLE}={os.environ.get(LIBRARY_VARIABLE, '')}"
        return Entry("library", "error", f"{error}; change {variable}")
    kinds = Counter(manifest.kind for manifest in library.manifests())
    counts = {kind: kinds[kind] for kind in PART_KINDS}
    listed = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    text = f"{sum(counts.values())} parts: {listed}"
    for folder in library.folders[len(shipped_folders()) :]:
        text += f"; {len(Library([folder]).paths)} of them in {folder} ({LIBRARY_VARIABLE})"
    data = {"parts": counts, "folders": [str(folder) for folder in library.folders]}
    if faults := library.faults():
        text += f"; left out: {'; '.join(map(str, faults))}"
    return Entry("library", "warning" if faults else "ok", one_line(text), data)


def _robot_package(package: str) -> Entry:
    """Find the files of all parts from a data package, and compare them with the tested ones."""
    name = f"robots of {package}"
    parts = [
        (manifest, manifest.source.file)
        for manifest in Library(shipped_folders()).manifests()
        if isinstance(manifest.source, PackageSource) and manifest.source.package == package
    ]
    errors = []
    for _, file in parts:
        try:
            distribution_file(package, file)
        except MorphgenError as error:
            errors.append(str(error))
    if errors:
        text = f"{len(errors)} of {len(parts)} parts lack their file: {errors[0]}"
        return Entry(name, "error", text, {"errors": errors})
    stored, number = stored_facts(), version(package)
    changed = [
        manifest.name
        for manifest, _ in parts
        if stored.get(manifest.name, {}).get("digest") != source_digest(manifest)
    ]
    data = {"version": number, "parts": len(parts), "changed": changed}
    if changed:
        text = (
            f"{len(changed)} of {len(parts)} parts are not those that this morphgen was tested "
            f"with: {package} {number} is another version, or their YAML files were changed"
        )
        return Entry(name, "warning", text, data)
    return Entry(name, "ok", f"{number}, with the files of {len(parts)} parts", data)


def _splits() -> Entry:
    """Read the shipped splits, whose files have the hashes of their robots."""
    ids = {name: split_id(read_split(name)) for name in split_names()}
    return Entry("splits", "ok", f"{len(ids)} with the ids of their robots", ids)


def _goal_sets() -> Entry:
    """Compare the shipped goal sets with their index."""
    records = list(packaged_index().values())
    damaged = [
        record["file"]
        for record in records
        if not (path := FOLDER / record["file"]).is_file() or file_sha256(path) != record["sha256"]
    ]
    if damaged:
        text = f"{len(damaged)} damaged: {', '.join(damaged[:3])}; install morphgen again"
        return Entry("goal sets", "error", text, {"damaged": damaged})
    return Entry("goal sets", "ok", f"{len(records)} with the hashes of their index")


def _policies() -> Entry:
    """Read the shipped policies, whose files have a hash of their content."""
    from morphgen.rl.runs.checkpoint import read_checkpoint

    for name in POLICIES.builtin:
        read_checkpoint(POLICIES[name].file)
    return Entry("policies", "ok", f"{', '.join(POLICIES.builtin)}: their files are whole")


def self_test() -> Iterator[Entry]:
    """Compose a robot, check it, load it, step it and draw it; failures to draw are warnings."""
    try:
        library = default_library()
        robot = compose(parse_words([ROBOT], library)[0], library, ROBOT)
    except Exception as error:  # whatever a broken package raises
        yield failure("compose", error)
        return
    yield Entry("compose", "ok", f"{ROBOT} has hash {robot_hash(robot)}")
    yield attempt("check", partial(_check, robot))
    with TemporaryDirectory() as folder:
        bundle = write_bundle(robot, Path(folder) / robot.name, (), picture=False)
        yield from _loaders(bundle)
        for simulator in SIMULATORS:
            name = f"simulator {simulator}"
            yield attempt(name, partial(_simulator, name, simulator, robot))
        picture = attempt("picture", partial(_picture, robot, bundle))
        yield picture if picture.status == "ok" else replace(picture, status="warning")
        film = attempt("film", partial(_film, Path(folder)))
        yield replace(film, status="warning") if film.status == "error" else film


def _check(robot: Robot) -> Entry:
    """Check the robot as ``morphgen check`` does."""
    severities = [finding.severity for finding in check(robot)]
    counts = {name: severities.count(name) for name in ("error", "warning", "info")}
    text = f"{robot.name}: {', '.join(f'{count} {name}' for name, count in counts.items())}"
    return Entry("check", "error" if counts["error"] else "ok", text, counts)


def _loaders(bundle: Path) -> Iterator[Entry]:
    """Compare the loaders of ``morphgen conform``."""
    try:
        rows = conformance(bundle, CONFIGURATIONS).rows
    except Exception as error:  # whatever a broken loader raises
        yield failure("loaders", error)
        return
    yield from map(_loader, rows)


def _loader(row: ConformanceRow) -> Entry:
    name = f"loader {row.loader}"
    if row.passed is None:
        extra = "usd" if row.loader == "usd" else "conform"
        return Entry(name, "absent", f"{row.message}: pip install 'morphgen[{extra}]'")
    if not row.passed:
        return Entry(name, "error", f"disagrees with morphgen: {row.message}")
    return Entry(name, "ok", f"agrees with morphgen in {CONFIGURATIONS} configurations")


def _simulator(name: str, simulator: str, robot: Robot) -> Entry:
    """Make one control step."""
    import torch

    from morphgen.tasks.sim.base import Scene

    device = SIMULATORS[simulator].devices[0]
    if device == "cuda" and not torch.cuda.is_available():
        return Entry(name, "absent", "it needs a CUDA device, and this machine has none")
    simulation = SIMULATORS[simulator].load([Scene(robot)], None, 1, torch.device(device))
    try:
        home = simulation.q.clone()
        simulation.step(home + STEP)
        moved = (simulation.q - home).abs().max().item()
    finally:
        simulation.close()
    if not 0 < moved < STEP:  # motors need longer than one control step of 20 ms
        text = f"a step towards {STEP} rad moved the joints of {robot.name} by {moved:.3g} rad"
        return Entry(name, "error", text, {"moved": moved})
    return Entry(name, "ok", f"one control step of {robot.name}", {"moved": moved})


def _picture(robot: Robot, bundle: Path) -> Entry:
    """Draw the robot as for ``preview.png``."""
    picture = np.asarray(render(robot, bundle / MJCF, size=PICTURE_SIZE))
    if picture.min() == picture.max():  # one colour: a driver without errors may still draw nothing
        return Entry("picture", "error", "the renderer draws nothing; say --no-picture")
    return Entry("picture", "ok", "drawn by MuJoCo without a display")


def _film(folder: Path) -> Entry:
    """Create MuJoCo's offscreen context, and write a film of two frames."""
    from morphgen.tasks.render.renderer import write_video

    context = gl_context(*PICTURE_SIZE)
    context.free()
    width, height = PICTURE_SIZE
    frame = np.zeros((height, width, 3), dtype=np.uint8)
    write_video([frame, frame], folder / "film.mp4", fps=2)
    return Entry("film", "ok", "offscreen OpenGL for MuJoCo, and ffmpeg with H.264")
