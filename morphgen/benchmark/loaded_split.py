"""A split with the library of its parts: its robots, statistics and audit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from morphgen.benchmark.audit import NEAR_THRESHOLDS, Audit, NearThresholds, audit
from morphgen.benchmark.split import Split, compose_side
from morphgen.benchmark.statistics import statistics
from morphgen.extras import explain_missing_extras
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import Progress, no_progress


@dataclass(frozen=True)
class LoadedSplit:
    """A split, and the library that its robots are composed from."""

    definition: Split
    """Content of the split's file: for each robot its derivation, task and hash."""
    library: Library
    """Library of the parts."""

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
        jobs: int = 1,
        progress: Progress = no_progress,
    ) -> Audit:
        """Find leaks between train and test robots; see ``morphgen.benchmark.audit.audit``.

        Args:
            near: Thresholds of near duplicates.
            jobs: Number of processes.
            progress: Receives the number of robots that are finished, and of all.

        Raises:
            BenchmarkError: If the provenance of the split is malformed.
            MissingDependencyError: If a part's primitives must be fitted, and ``fit`` is missing.
        """
        return audit(self.definition, self.library, near=near, jobs=jobs, progress=progress)
