"""Compose robots of morphgen's own parts by the words of a request."""

from morphgen.grammar.compose import compose, join
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request

LIBRARY = default_library()


def derive(text, library=LIBRARY):
    return parse_request(text.split(), library)


def composed(text):
    return compose(derive(text), LIBRARY, "robot")


def joined(text):
    return join(derive(text), LIBRARY, "robot")
