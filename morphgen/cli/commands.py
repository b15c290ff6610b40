"""The table of all commands, in the order of the help."""

from morphgen.cli import (
    check,
    demo,
    doctor,
    evaluate,
    export,
    fit,
    play,
    robots,
    sample,
    similarity,
    split,
    study,
    train,
    view,
)
from morphgen.cli import play as zeroshot
from morphgen.cli import robots as import_robots
from morphgen.cli import sample as grammar
from morphgen.cli import similarity as tokens
from morphgen.cli import split as goals
from morphgen.cli import study as score
from morphgen.cli import train as finetune
from morphgen.cli.command import Command

COMMANDS: tuple[Command, ...] = (
    demo.demo,
    robots.compose,
    sample.sample,
    robots.list_parts,
    robots.show,
    check.check,
    check.conform,
    import_robots.import_robots,
    export.export,
    fit.fit,
    tokens.tokens,
    grammar.grammar,
    sample.derive,
    sample.mutate,
    similarity.similarity,
    split.split,
    goals.goals,
    zeroshot.zeroshot,
    train.train,
    evaluate.evaluate,
    finetune.finetune,
    study.study,
    score.score,
    play.play,
    play.speed,
    view.view,
    doctor.doctor,
)
