"""The language of morphgen: grammars, parts, derivations and their composition to robots."""
