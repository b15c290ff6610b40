"""Streams of random numbers of a batch's environments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def random_streams(seed: int, env_numbers: Sequence[int]) -> dict[str, list[np.random.Generator]]:
    """Return random streams of episodes and of points, one of each for every environment number."""
    return {
        name: [
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, *suffix)))
            for number in env_numbers
        ]
        for name, suffix in (("random", ()), ("points", (0,)))
    }
