"""The page that ``morphgen view`` opens for a target of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from morphgen.benchmark.split_file import split_names
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import nearest
from morphgen.grammar.grammar_file import SUFFIX, grammar_names
from morphgen.grammar.robot_source import is_robot_folder
from morphgen.viewer.app.address import Address
from morphgen.viewer.robot_uri import (
    CHECKPOINT,
    EPISODE_SUFFIX,
    WORDS,
    FileAccess,
    UriError,
    resolve_words,
)


def start_address(words: Sequence[str], files: FileAccess) -> Address:
    """Return the page that ``morphgen view`` opens."""
    if not words:
        return Address("library")
    if len(words) > 1 or "=" in words[0]:
        resolve_words(" ".join(words), files)
        return Address("robot", (WORDS + " ".join(words),))
    word = words[0]
    if Path(word).exists():
        return _path_address(word, files)
    if word in split_names():
        return Address("split", (word,))
    if word in grammar_names():
        return Address("compose", (word,))
    valid = (*split_names(), *grammar_names())
    raise UriError(f"{word}: no such file or folder, no split and no grammar{nearest(word, valid)}")


def _path_address(text: str, files: FileAccess) -> Address:
    """Return the page of a file or folder."""
    path = files.path(text)
    if path.suffix == EPISODE_SUFFIX:
        from morphgen.viewer.episode import read_episode

        read_episode(path, files)
        return Address("play", (text,))
    if path.suffix == ".pt" or (path / CHECKPOINT).is_file():
        from morphgen.rl.runs.checkpoint import read_checkpoint

        read_checkpoint(path)
        return Address("play", state={"policy": text})
    if path.is_file():
        return Address({".yaml": "split", SUFFIX: "compose"}.get(path.suffix, "robot"), (text,))
    if (path / SPLIT_FILE).is_file():
        return Address("split", (text,))
    return Address("robot" if is_robot_folder(path) else "gallery", (text,))
