"""Hooks of the site's build: the command line's reference, and links that leave the site."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

COMMANDS = "<!-- commands -->"
"""Mark in ``cli.md`` that the commands replace."""
REPOSITORY_ONLY = re.compile(r"<!-- repository -->\n.*?<!-- /repository -->\n", re.DOTALL)
"""Text for readers of the repository, which the site leaves out."""
USAGE_WIDTH = 90
"""Longest line of a synopsis [characters]."""


def on_page_markdown(markdown: str, **_: object) -> str:
    """Return a page's Markdown as the site needs it."""
    if COMMANDS in markdown:
        from morphgen.cli import build_parser  # only for the one page

        markdown = markdown.replace(COMMANDS, "\n".join(command_lines(build_parser())))
    markdown = REPOSITORY_ONLY.sub("", markdown)
    # Source files beside docs/ are no pages: their names stay, without a link.
    markdown = re.sub(r"\[([^]]+)\]\(\.\./[^)]*\)", r"\1", markdown)
    # GitHub needs the backslash in a table's code; Python-Markdown prints it.
    return re.sub(r"`[^`\n]*\\\|[^`\n]*`", lambda code: code[0].replace(r"\|", "|"), markdown)


def command_lines(parser: argparse.ArgumentParser, level: int = 2) -> Iterator[str]:
    """Yield the Markdown of a parser's commands: a section with synopsis, options, examples."""
    for action in parser._actions:
        if not isinstance(action, argparse._SubParsersAction):
            continue
        for command in action.choices.values():
            yield f"{'#' * level} {command.prog.removeprefix('morphgen ')}\n"
            yield f"{_text(' '.join((command.description or '').split()))}\n"
            yield from _synopsis(command)
            yield from _options(command)
            if command.epilog:
                examples = (line.strip() for line in command.epilog.splitlines()[1:])
                yield from ("```", *examples, "```\n")
            yield from command_lines(command, level + 1)


def _synopsis(command: argparse.ArgumentParser) -> Iterator[str]:
    formatter = argparse.HelpFormatter(command.prog, width=USAGE_WIDTH)
    formatter.add_usage(None, command._actions, command._mutually_exclusive_groups, prefix="")
    yield from ("```", formatter.format_help().strip(), "```\n")


def _options(command: argparse.ArgumentParser) -> Iterator[str]:
    formatter = argparse.HelpFormatter(command.prog)
    options = [
        action
        for action in command._actions
        if not isinstance(action, argparse._SubParsersAction | argparse._HelpAction)
    ]
    if options:
        yield "| option | meaning |\n|---|---|"
        for action in options:
            names = formatter._format_action_invocation(action)
            yield f"| `{names}` | {_text(formatter._expand_help(action))} |"
        yield ""


def _text(help_text: str) -> str:
    """Return plain text with the characters escaped that Markdown or HTML would interpret."""
    return re.sub(r"([*`\[\]])", r"\\\1", help_text).replace("<", "&lt;").replace("|", "&#124;")
