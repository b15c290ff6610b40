"""The history and the offspring of a robot as HTML, with what the user can do with them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from html import escape

from morphgen.viewer import markup
from morphgen.viewer.compose_view import change_text, robot_facts
from morphgen.viewer.evolution import History, Individual, change_lines

_MAX_CHANGES = 4
"""Lines of changes on a card."""


def history_html(history: History) -> str:
    """Return a tag for each individual; a click recalls it, the current one is coloured."""
    chips = []
    for i, individual in enumerate(history.individuals):
        name = escape(individual.robot.name.rpartition("-")[2][:6])
        style = "info" if i == history.position else ""
        chips.append(f'<a data-do="recall" data-value="{i}">{markup.tag(name, style)}</a>')
    return " ".join(chips)


def offspring_html(
    parent: Individual, generation: Sequence[Individual], picked: Collection[int]
) -> str:
    """Return cards of the offspring with what differs from the parent; empty without offspring.

    Args:
        parent: The parent.
        generation: The offspring.
        picked: Indices of those that are to be crossed.
    """
    cards = []
    for i, individual in enumerate(generation):
        lines = change_lines(parent.derivation, individual.derivation)
        changes = "<br>".join(map(escape, lines[:_MAX_CHANGES]))
        changes += "<br>..." if lines[_MAX_CHANGES:] else ""
        facts = change_text(robot_facts(parent.robot), robot_facts(individual.robot))
        checked = " checked" if i in picked else ""
        cards.append(
            f'<div><b>{i + 1}</b> <a data-do="adopt" data-value="{i}">adopt</a> '
            f'<label><input type="checkbox" data-do="pick" data-value="{i}"{checked}> cross</label>'
            f"{markup.dim(f'{escape(facts)}<br>{changes}' if facts else changes)}</div>"
        )
    return f'<div class="offspring">{"".join(cards)}</div>' if cards else ""
