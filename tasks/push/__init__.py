"""Push: move a block across a line."""
