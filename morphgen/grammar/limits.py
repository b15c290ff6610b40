"""Limits of what a grammar may ask for: no text keeps a command busy for long or fills memory."""

from __future__ import annotations

MAX_PARTS = 100
"""Parts of one robot, and levels of symbols above a part; loaders hold fewer parts. A recursion
that goes further is taken to be endless, and no repetition may ask for more."""
MAX_TEXT = 64 * 1024
"""Length of a grammar with its includes, and of a condition [bytes]; all shipped grammars together
have 3 kB."""
MAX_FILES = 100
"""Files that a grammar may be read from, itself among them."""
MAX_STATEMENTS = 1000
"""Statements of a grammar with its includes."""
MAX_ALTERNATIVES = 1000
"""Alternatives of one symbol."""
MAX_WORD = 100
"""Length of a name or a number [characters]."""
MAX_NESTING = 100
"""Levels of an expression; ``1 + 1 + 1`` has three."""
MAX_FAULTS = 20
"""Faults of items that are reported at once."""
COUNT_DIGITS = 100
MAX_COUNT: int = 10**COUNT_DIGITS
"""Structures beyond which they are not counted exactly."""
MAX_SEARCH = 20_000
"""Parts that are placed in search of one more structure before the search is given up."""
MAX_DERIVATION_TEXT = 256 * 1024
"""Length of a derivation's text [characters]."""
