"""The functions of ``import morphgen``; each calls what its command of the command line calls."""
