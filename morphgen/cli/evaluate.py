"""``morphgen eval``: score a policy or a baseline on each robot."""

from __future__ import annotations

import argparse

from morphgen.api import evaluation
from morphgen.cli import options as opt
from morphgen.cli.progress import training_progress
from morphgen.rl.scores import require_table


def evaluate(args: argparse.Namespace) -> None:
    """Evaluate and print the scores."""
    if args.out is not None:
        require_table(args.out)
    with training_progress():
        robots, given = " ".join(args.words) or None, opt.arguments(args, evaluation.evaluate)
        result = evaluation.evaluate(args.checkpoint, robots, **given)
    opt.print_result(args, result.as_dict(), lambda: str(result))
    if args.out is not None:
        result.write(args.out)
