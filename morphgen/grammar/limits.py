"""Limits of grammars, so that no text from a stranger runs for hours or fills the memory."""

from __future__ import annotations

MAX_PARTS = 100
"""Largest number of parts of a robot, of copies in a repetition, and of nested symbols. A recursion
that goes deeper is considered endless; loaders of robots have smaller limits."""
MAX_TEXT = 64 * 1024
"""Largest size of a grammar with its includes, and of a condition [bytes]; all shipped grammars
together have 3 kB."""
MAX_FILES = 100
"""Largest number of files of a grammar, including itself."""
MAX_STATEMENTS = 1000
"""Largest number of statements of a grammar with its includes."""
MAX_ALTERNATIVES = 1000
"""Largest number of alternatives of one symbol."""
MAX_WORD = 100
"""Largest length of a name or a number [characters]."""
MAX_NESTING = 100
"""Largest depth of an expression; ``1 + 1 + 1`` has three levels."""
MAX_FAULTS = 20
"""Largest number of faults that ``morphgen grammar check`` reports at once."""
COUNT_DIGITS = 100
"""Exponent of ``MAX_COUNT``."""
MAX_COUNT: int = 10**COUNT_DIGITS
"""Largest number of structures that is counted exactly."""
MAX_SEARCH = 20_000
"""Number of parts without a new structure after which an enumeration is given up."""
MAX_DERIVATION_TEXT = 256 * 1024
"""Largest length of a derivation's text [characters]."""
