"""Variants of the agent ``me-graph`` that lack one of its parts, for ``graph_ablation.py``."""
