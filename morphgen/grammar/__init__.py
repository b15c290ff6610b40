"""The language of morphgen: parts, derivations and composition."""
