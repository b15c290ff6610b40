"""The page about versions has the formats of the code."""

import re
from pathlib import Path

from morphgen.benchmark import release_file, split, split_folder
from morphgen.formats import bundle
from morphgen.grammar.robot_set import SetConfig
from morphgen.rl.runs import checkpoint as runs
from morphgen.rl.runs import robot_source
from morphgen.rl.scores import submission
from morphgen.tasks.goals import split_goals
from morphgen.viewer import episode

PAGE = (Path(__file__).parents[2] / "docs" / "versions.md").read_text(encoding="utf-8")
FORMATS = {
    "NAME.yaml": split.FORMAT,
    "build.json": split_folder.FORMAT,
    "goals/index.json": split_goals.FORMAT,
    "card.json": bundle.CARD_FORMAT,
    "set.json": SetConfig(Path(), "", "", 0, (), False, False, ()).settings()["format"],
    runs.CONFIG: runs.FORMAT,
    runs.CHECKPOINT: runs.FORMAT,
    robot_source.FILE: robot_source.FORMAT,
    "episodes.csv.gz": "",
    "release.json": release_file.FORMAT,
    "eval --submission": submission.FORMAT,
    ".npz": f"{episode.FORMAT}; 1 is read",
}


def test_formats_of_files_are_those_of_the_code():
    _, _, section = PAGE.partition("## What the files record")
    rows = re.findall(r"(?m)^\| [^`|]*`([^`]+)`[^|]*\| ?([^|]*?) ?\|", section.split("\n## ")[0])
    assert dict(rows) == {file: str(number) for file, number in FORMATS.items()}
