"""Templates and tables of the benchmark."""

from importlib.resources import files


def read_text(name: str) -> str:
    """Return the text of a file of this folder."""
    return (files("morphgen.benchmark.texts") / name).read_text(encoding="utf-8")
