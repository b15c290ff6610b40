"""The page that ``morphgen view`` opens for what it is given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from morphgen.benchmark.split_file import split_names
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import nearest
from morphgen.grammar.grammar_file import SUFFIX, grammar_names
from morphgen.viewer.address import Address, Page
from morphgen.viewer.robot_uri import (
    CHECKPOINT,
    EPISODE_SUFFIX,
    PLAYED,
    SPLIT_SUFFIX,
    WORDS,
    FileAccess,
    UriError,
    is_robot,
    resolve_words,
)


def target_address(words: Sequence[str], places: FileAccess) -> Address:
    """The page that ``morphgen view`` opens for its words.

    Args:
        words: None of them for the library; a folder, file or split's name; or words to compose.
        places: What may be looked at.

    Raises:
        MorphgenError: If there is no such thing.
    """
    if not words:
        return Address("library")
    if len(words) == 1 and "=" not in words[0]:
        return _single_address(words[0], places)
    resolve_words(" ".join(words), places)
    return Address("robot", (WORDS + " ".join(words),))


def _single_address(word: str, places: FileAccess) -> Address:
    if Path(word).exists():
        path = places.path(word)
        if path.suffix in PLAYED or (path / CHECKPOINT).is_file():
            return _played_address(word, places)
        if path.is_file():
            pages: dict[str, Page] = {SPLIT_SUFFIX: "split", SUFFIX: "compose"}
            return Address(pages.get(path.suffix, "robot"), (word,))
        if (path / SPLIT_FILE).is_file():
            return Address("split", (word,))
        return Address("robot" if is_robot(path) else "gallery", (word,))
    if word in split_names():
        return Address("split", (word,))
    if word in grammar_names():
        return Address("compose", (word,))
    valid = (*split_names(), *grammar_names())
    raise UriError(f"{word}: no such file or folder, no split and no grammar{nearest(word, valid)}")


def _played_address(word: str, places: FileAccess) -> Address:
    """The page that plays an episode, or the policy of a checkpoint or a run's folder."""
    if word.endswith(EPISODE_SUFFIX):
        from morphgen.viewer.episode import read_episode

        read_episode(places.path(word), places)
        return Address("play", (word,))
    from morphgen.rl.runs import read_checkpoint

    read_checkpoint(places.path(word))
    return Address("play", state={"policy": word})
