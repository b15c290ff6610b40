"""Every command shown on a page is a valid morphgen command."""

import html
import re
import shlex
from pathlib import Path

import pytest

import morphgen.viewer
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.cli import build_parser
from morphgen.formats.bundle import write_bundle

PROSE = ("itself",)
"""Words that stand after the name of the package where no command is meant."""


def commands(client):
    """Return the commands in the copy boxes of a page."""
    boxes = re.findall(r"<pre>(.*?)</pre>", client.text, re.DOTALL)
    lines = [line for box in boxes for line in html.unescape(box).splitlines()]
    return [line for line in lines if line.startswith("morphgen ")]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("?robot=robots/some-arm", "morphgen show robots/some-arm"),
        ("?robot=robots/it's me", "morphgen show 'robots/it'\"'\"'s me'"),
        ("?robot=words:arm=ur5 ee=plane", "morphgen compose arm=ur5 ee=plane"),
        ("?compose=arm=ur5 ee=plane", "morphgen compose base=fixed arm=ur5 ee=plane"),
        ("?compose=chain", "morphgen compose chain"),
        ("?compose=my/own.grammar", "morphgen compose my/own.grammar"),
        ("?compose=chain&seed=3&number=2", "morphgen sample chain -n 3 --seed 3"),
    ],
)
def test_commands_of_a_page_are_valid(shared_viewer, folder, query, expected):
    write_bundle(arm(), folder / "robots" / "it's me", picture=False)
    (folder / "my").mkdir(exist_ok=True)
    (folder / "my" / "own.grammar").write_text("include chain\n")
    with PlainClient(shared_viewer.port, query) as client:
        client.until(lambda: commands(client))
        (command,) = set(commands(client))
    assert command == expected
    args, words = build_parser().parse_known_args(shlex.split(command)[1:])
    assert hasattr(args, "run")
    assert words == [] or hasattr(args, "words")


def test_every_command_in_the_viewers_texts_exists():
    known = build_parser()._subparsers._group_actions[0].choices
    for path in Path(morphgen.viewer.__file__).parent.glob("*.py"):
        for verb in re.findall(r"[`\"'( ]morphgen ([a-z]+)", path.read_text(encoding="utf-8")):
            assert verb in {*known, *PROSE}, f"{path.name}: morphgen {verb}"
