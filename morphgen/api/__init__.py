"""The functions of ``import morphgen``; the command line uses the same code."""
