"""The self-test: compose a robot, check it, load it, step it, draw it, and compute a score.

Drawing is not needed for anything else, so its failures are warnings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.checks import check
from morphgen.checks.conformance import ConformanceRow, conformance
from morphgen.doctor import reference
from morphgen.doctor.entry import Entry, attempt, failure
from morphgen.formats.bundle import MJCF, write_bundle
from morphgen.formats.picture import gl_context, render
from morphgen.grammar.library import Library, default_library
from morphgen.model.robot import Robot
from morphgen.tasks.registry import SIMULATORS

CONFIGURATIONS = 5
"""Number of random configurations in which loaders are compared."""
PICTURE_SIZE = (160, 120)
"""Width and height of the picture [px]."""
STEP = 0.1
"""Distance of the target of the simulators' step from the home position [rad]."""


def entries() -> Iterator[Entry]:
    """Test an installation with one robot; stop if it cannot be composed."""
    library = default_library()
    try:
        robot = reference.reference_robot(library)
    except Exception as error:  # whatever a broken package raises
        yield failure("compose", error)
        return
    yield attempt("compose", partial(_compose, robot))
    yield attempt("sample", partial(_sample, library))
    yield attempt("tokens", partial(_tokens, robot, library))
    yield attempt("files", partial(_files, robot))
    yield attempt("check", partial(_check, robot))
    with TemporaryDirectory() as folder:
        bundle = write_bundle(robot, Path(folder) / robot.name, (), picture=False)
        yield from _loaders(bundle)
        for simulator in SIMULATORS:
            name = f"simulator {simulator}"
            yield attempt(name, partial(_simulator, name, simulator, robot))
        yield attempt("score", _score)
        picture = attempt("picture", partial(_picture, robot, bundle))
        yield picture if picture.status == "ok" else replace(picture, status="warning")
        film = attempt("film", partial(_film, Path(folder)))
        yield replace(film, status="warning") if film.status == "error" else film


def _compose(robot: Robot) -> Entry:
    return _compared("compose", robot.name, robot_hash(robot))


def _sample(library: Library) -> Entry:
    robot = reference.sampled_robot(library)
    return _compared("sample", robot.name, robot_hash(robot))


def _tokens(robot: Robot, library: Library) -> Entry:
    present = reference.token_hash(robot, library)
    return _compared("tokens", f"tokens of {robot.name}", present)


def _compared(name: str, key: str, present: str) -> Entry:
    """Compare a hash with the recorded one."""
    expected = reference.recorded()["robots"][key]
    data = {"hash": present, "recorded": expected}
    if present != expected:
        text = f"{key}: hash {present}, not {expected} as recorded; splits refuse such robots"
        return Entry(name, "error", text, data)
    return Entry(name, "ok", f"{key} has its recorded hash {present}", data)


def _files(robot: Robot) -> Entry:
    """Compare the bytes of a bundle's files."""
    key = f"files of {robot.name}"
    present, expected = reference.file_hashes(robot), reference.recorded()["robots"][key]
    names = present.keys() | expected.keys()
    changed = sorted(name for name in names if present.get(name) != expected.get(name))
    if changed:
        text = f"other bytes than recorded: {', '.join(changed)}; the last digits of numbers differ"
        return Entry("files", "warning", text, {"changed": changed})
    text = f"{len(present)} files of {robot.name} have their recorded bytes"
    return Entry("files", "ok", text, {"files": len(present)})


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
    if not 0 < moved < STEP:
        text = f"a step towards {STEP} rad moved the joints of {robot.name} by {moved:.3g} rad"
        return Entry(name, "error", text, {"moved": moved})
    return Entry(name, "ok", f"one control step of {robot.name}", {"moved": moved})


def _score() -> Entry:
    """Evaluate a baseline, whose score depends on robots, goal set, constants and formulas."""
    present, expected = reference.score(), reference.recorded()["score"]
    data = {"score": present, "recorded": expected}
    what = f"{reference.BASELINE} on {reference.SCORED}"
    if not abs(present - expected) <= reference.SCORE_TOLERANCE:
        text = f"{what}: {present:.2f}, not {expected:.2f} as recorded; scores do not compare"
        return Entry("score", "error", text, data)
    return Entry("score", "ok", f"{what}: {present:.2f}, as recorded", data)


def _picture(robot: Robot, bundle: Path) -> Entry:
    """Draw the robot as for ``preview.png``."""
    picture = np.asarray(render(robot, bundle / MJCF, size=PICTURE_SIZE))
    if picture.min() == picture.max():
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
