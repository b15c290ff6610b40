"""The documentation pages match the code, and build as a site."""

import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from morphgen.cli import build_parser, main
from morphgen.cli.command import parse
from morphgen.grammar.library import default_library
from morphgen.tasks.registry import register_gym_envs

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:(?P<file>\S+)`:\n\n)?```(?P<language>\w*)\n(?P<code>.*?)```\n"
    r"|(?P<commands>(?:^    [^\n]*\n)+)",
    re.DOTALL | re.MULTILINE,
)
"""A fenced block, with the name of the file that it is to be saved as, or indented lines."""

SLOW_PAGES = ("similarity", "splits", "tasks")
"""Pages whose Python examples take seconds."""
