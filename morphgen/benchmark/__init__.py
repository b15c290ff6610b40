"""The life of a split: rules, audit, build, goals, licences, release and scores."""

from importlib.resources import files


def read_text(name: str) -> str:
    """Return a template or a table of the folder ``texts``."""
    return (files("morphgen.benchmark") / "texts" / name).read_text(encoding="utf-8")
