"""The table of all commands, in the order of the help."""

from morphgen.cli import (
    check,
    evaluate,
    fit,
    goals,
    grammar,
    play,
    robots,
    sample,
    similarity,
    split,
    study,
    tokens,
    train,
    view,
)
from morphgen.cli.command import Command

COMMANDS: tuple[Command, ...] = (
    robots.compose,
    sample.sample,
    robots.list_parts,
    robots.show,
    check.check,
    check.conform,
    robots.import_robot,
    fit.fit,
    tokens.tokens,
    grammar.grammar,
    sample.derive,
    sample.mutate,
    similarity.similarity,
    split.split,
    goals.goals,
    train.train,
    evaluate.evaluate,
    train.finetune,
    study.study,
    play.play,
    play.speed,
    view.view,
)
