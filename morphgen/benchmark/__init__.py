"""Bodies as data: tokens, similarity, and splits of train and test robots."""
