"""Generate splits from what they hold out: test robots have it, train robots do not.

The draws are stratified: each arm, then each end-effector, appears before one appears twice. Apart
from what is held out, a test robot has only parts of train robots.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from morphgen.benchmark.generate import RobotStream, SplitRequest, assemble_drawn, require_size
from morphgen.benchmark.hold_out_pool import DraftMaker, make_pool
from morphgen.benchmark.hold_out_rules import parse_rules
from morphgen.benchmark.hold_out_search import ComposeDraft, HoldOutSearch
from morphgen.benchmark.member_names import unique_names
from morphgen.benchmark.robot_factory import Progress, RobotFactory
from morphgen.benchmark.split import HOLD_OUT, HOLD_OUT_KEY, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library

DEFAULT_PATTERN = "arm=* ee=*"
"""Robots that are drawn from if nothing is named."""


def hold_out(
    request: SplitRequest,
    hold_out: Sequence[str],
    library: Library,
    *,
    patterns: Sequence[str] = (),
    grammars: Sequence[Grammar] = (),
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Return splits whose test robots have held-out parts, and whose train robots have none.

    Args:
        request: Sizes, tasks and seed.
        hold_out: Rules, see ``hold_out_rules.parse_rules``.
        library: The library of parts.
        patterns: Patterns of the robots to draw from, see ``pattern_robots``. Parameters with
            held-out ranges are drawn, others have the pattern's values.
        grammars: Grammars to draw from. Without patterns and grammars, robots are drawn from all
            arms with all end-effectors.
        jobs: Number of processes; it does not change the result.
        progress: Receives the number of robots that are finished.

    Returns:
        A split for each size.

    Raises:
        BenchmarkError: If a rule is malformed, or there are too few different robots; the message
            says how many there are.
        MorphgenError: If a pattern names an unknown part, or parts do not fit.
    """
    require_size(request)
    rules = parse_rules(hold_out, library)
    if request.test < len(rules):
        raise BenchmarkError(
            f"--test {request.test}: {len(rules)} rules are held out, and each needs a test robot; "
            f"expected {len(rules)} or more"
        )
    if not grammars and not patterns:
        patterns = (DEFAULT_PATTERN,)
    maker = DraftMaker(rules, library, request.seed)
    factory = RobotFactory(library.folders, with_features=True, max_links=request.max_links)
    pool = dict(enumerate(make_pool(request, maker, patterns, grammars)))
    search = HoldOutSearch(request, maker, ComposeDraft(factory), pool)
    test, train = search.run(jobs, progress)
    robots = [*train, *test]
    names = unique_names(robot.derivation for robot in robots)
    named = [replace(robot, name=name) for robot, name in zip(robots, names, strict=True)]
    provenance: dict[str, object] = {HOLD_OUT_KEY: [str(rule) for rule in rules]}
    if patterns:
        provenance["from"] = list(patterns)
    if grammars:
        streams = [RobotStream.of(grammar, grammar.name, request) for grammar in grammars]
        provenance["grammars"] = {grammar.name: grammar.digest for grammar in grammars}
        provenance["seeds"] = {stream.prefix: stream.seed for stream in streams}
    if search.rejected:
        provenance["left_out"] = dict(sorted(Counter(search.rejected.values()).items()))
    return assemble_drawn(
        request,
        HOLD_OUT,
        f"{{n}} robots without {' or '.join(map(str, rules))}; test: {request.test} with it",
        named[: len(train)],
        named[len(train) :],
        provenance,
    )
