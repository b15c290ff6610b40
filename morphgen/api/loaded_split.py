"""A split with the library of its parts: its robots, statistics, audit and files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any

from morphgen.benchmark.audit import Audit, audit
from morphgen.benchmark.licences import LicencedPart, licenced_parts
from morphgen.benchmark.near_duplicates import NEAR_THRESHOLDS, NearThresholds
from morphgen.benchmark.split import Split, compose_side
from morphgen.benchmark.split_folder_files import BuildSettings
from morphgen.benchmark.split_writing import split_paths, write_new_splits
from morphgen.benchmark.statistics import statistics
from morphgen.benchmark.verify import Difference, compare_robots, verify
from morphgen.extras import explain_missing_extras
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import Progress, no_progress
from morphgen.tasks.env_specs import GoalConfig
from morphgen.tasks.goal_audit import audit_goals, goals_to_audit, with_goal_findings
from morphgen.tasks.split_building import build_with_goals
from morphgen.tasks.split_goals import sample_split_goals


@dataclass(frozen=True)
class LoadedSplit:
    """A split, and the library that its robots are composed from."""

    definition: Split
    """Content of the split's file: for each robot its derivation, task and hash."""
    library: Library
    """Library of the parts."""
    folder: Path | None = None
    """Folder where the split is built, if it was loaded from there."""

    @property
    def name(self) -> str:
        """Name of the split, such as ``interpolation/arm3/reach``."""
        return self.definition.name

    @cached_property
    def train(self) -> tuple[Robot, ...]:
        """The train robots, composed at the first access.

        Raises:
            MorphgenError: As ``compose_member``.
        """
        return tuple(compose_side(self.definition, "train", self.library))

    @cached_property
    def test(self) -> tuple[Robot, ...]:
        """The test robots, composed at the first access.

        Raises:
            MorphgenError: As ``compose_member``.
        """
        return tuple(compose_side(self.definition, "test", self.library))

    def licences(self) -> tuple[LicencedPart, ...]:
        """Return the parts of the robots with their licences, and what these restrict.

        Examples:
            >>> scenario = morphgen.split("extrapolation/arms/reach")
            >>> [part.part for part in scenario.licences() if part.licence.restrictions]
            ['sake_ez']

        Raises:
            MorphgenError: If the library lacks a part, or a derivation is malformed.
        """
        return licenced_parts(self.definition, self.library)

    @explain_missing_extras()
    def statistics(self, *, jobs: int = 1, progress: Progress = no_progress) -> dict[str, Any]:
        """Compute sizes of the robots, and the similarity of test and train robots.

        Args:
            jobs: Number of processes.
            progress: Receives the number of robots that are finished, and of all.

        Returns:
            Plain data; see ``morphgen.benchmark.statistics.summarize_survey``.

        Raises:
            BenchmarkError: If a robot cannot be composed, or train or test is empty.
            MissingDependencyError: If a part's primitives must be fitted, and ``fit`` is missing.
        """
        return statistics(self.definition, self.library, jobs=jobs, progress=progress)

    @explain_missing_extras()
    def audit(
        self,
        *,
        near: NearThresholds = NEAR_THRESHOLDS,
        goals: bool = False,
        goal_seed: int | None = None,
        jobs: int = 1,
        progress: Progress = no_progress,
    ) -> Audit:
        """Find leaks between train and test robots, and between the goal sets of a built split.

        See ``morphgen.benchmark.audit.audit`` and ``morphgen.tasks.goal_audit.audit_goals``.

        Args:
            near: Thresholds of near duplicates.
            goals: Whether to audit goal sets even if the split ships none.
            goal_seed: Seed that the goal sets must have; by default that of the shipped ones, or 0.
            jobs: Number of processes.
            progress: Receives the number of robots that are finished, and of all: first of the
                robots, then of their goal sets.

        Raises:
            BenchmarkError: If the provenance of the split is malformed.
            MissingDependencyError: If a part's primitives must be fitted, and ``fit`` is missing.
        """
        split, library = self.definition, self.library
        result = audit(split, library, near=near, jobs=jobs, progress=progress)
        sample = partial(sample_split_goals, split, library, jobs=jobs) if goals else None
        sets = goals_to_audit(self.folder, goal_seed, sample)
        findings = None
        if sets is not None:
            findings = audit_goals(split, sets, library, jobs=jobs, progress=progress)
        return with_goal_findings(result, split, findings)

    def write(self, path: str | PathLike[str] = ".") -> Path:
        """Write the split's file.

        Examples:
            >>> scenario = morphgen.split("interpolation/arm3/reach")
            >>> print(scenario.write("mine"))
            mine/interpolation/arm3/reach.yaml

        Args:
            path: A file that ends in ``.yaml``, or a folder for ``<name>.yaml``.

        Returns:
            The file. One that has the same content is kept.

        Raises:
            BenchmarkError: If it exists with another content, or cannot be written.
        """
        paths = split_paths(Path(path), [self.definition])
        write_new_splits([self.definition], paths)
        return paths[0]

    @explain_missing_extras()
    def build(
        self,
        folder: str | PathLike[str] = "data",
        *,
        light: bool = False,
        picture: bool = False,
        goals: bool = False,
        goal_seed: int = 0,
        jobs: int = 1,
        progress: Progress = no_progress,
    ) -> Path:
        """Write every robot and its tokens into a folder; continue an interrupted build.

        Examples:
            >>> scenario = morphgen.split("interpolation/arm3/reach")
            >>> folder = scenario.build("data", light=True, goals=True)
            >>> print(folder)
            data/interpolation/arm3/reach
            >>> morphgen.split(folder).verify()
            ()

        Args:
            folder: Folder in which the split's folder is created.
            light: Whether to write only the URDF and the derivation of each robot.
            picture: Whether to draw ``preview.png`` of each robot.
            goals: Whether to ship the goal set of every robot.
            goal_seed: Seed of the goal sets.
            jobs: Number of processes; the files do not depend on it.
            progress: Receives the number of robots that are finished, and of all: first of the
                goal sets, then of the robots' files.

        Returns:
            The split's folder.

        Raises:
            BenchmarkError: If a robot is not the one that the split names or has no goal set, or
                the folder has another content or cannot be written.
            MissingDependencyError: If the extra ``fit`` is needed and missing.
            MorphgenError: If a robot cannot be composed.
        """
        settings, config = BuildSettings(light=light, picture=picture), GoalConfig(goal_seed)
        sets = (
            sample_split_goals(self.definition, self.library, config, jobs=jobs, progress=progress)
            if goals
            else ()
        )
        report = build_with_goals(
            self.definition,
            Path(folder),
            self.library,
            settings,
            sets,
            config,
            jobs=jobs,
            progress=progress,
        )
        return report.folder

    @explain_missing_extras()
    def verify(self, *, jobs: int = 1, progress: Progress = no_progress) -> tuple[Difference, ...]:
        """Compose every robot and compare it: with its hash, and with all files of a built split.

        Examples:
            >>> morphgen.split("interpolation/arm3/reach").verify()
            ()

        Args:
            jobs: Number of processes.
            progress: Receives the number of robots that are finished, and of all.

        Returns:
            Differences; none if all robots are the same here.
        """
        if self.folder is None:
            return compare_robots(self.definition, self.library, jobs=jobs, progress=progress)
        return verify(self.folder, self.library, jobs=jobs, progress=progress).differences
