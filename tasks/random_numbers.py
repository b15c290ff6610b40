"""Random numbers of episodes by a counter-based generator: Philox4x32-10.

A counter-based generator is a function of a key and a counter, without a state (Salmon, Moraes,
Dror and Shaw 2011, "Parallel random numbers: as easy as 1, 2, 3"). The key is a seed. The counter
is the number of an environment, the number of its episode, a stream, and a block of four numbers.
Thus the episodes of an environment do not depend on its batch, and are the same on CPU and GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import torch

from morphgen.errors import TaskError

MAX_SEED = 2**64 - 1  # largest seed
ROUNDS = 10  # number of rounds of the generator
WORD = 2**32  # number of values of a word, the unit in which the generator computes
_MULTIPLIERS = (0xCD9E8D57 - WORD, 0xD2511F53 - WORD)
"""Multipliers of the third and the first word of a counter, minus ``WORD``: products with words
then fit into 64 bits with a sign, and ``WORD`` times the other factor is added afterwards."""
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)  # increments of the two words of the key from round to round
_FLOAT_BITS = 24  # bits of a number in [0, 1) in single precision


class Stream(IntEnum):
    """Purposes of random numbers; each has its own numbers in every episode."""

    LAYOUT = 0
    """Layout of the obstacles."""
    START = 1
    """Start of the episode, and its goal."""
    SPREAD = 2
    """Step at which a first episode begins; see ``TaskBatch.reset``."""
    POINTS = 3
    """Points of clouds."""
    TASK = 16
    """First of the numbers that tasks are free to use for purposes of their own."""


@dataclass(frozen=True, eq=False)
class EpisodeRandom:
    """Random numbers of an episode in each of k environments; the same however often it is asked.

    The numbers of an environment depend on the seed and on its row of the two tensors.
    """

    key: int | torch.Tensor
    """Seed of all environments, 0 to ``MAX_SEED``, or the low and high words of the seed of each,
    shape (k, 2), int64."""
    env_number: torch.Tensor
    """Number of each environment, shape (k,), int64, 0 to 2^32 - 1."""
    episode: torch.Tensor
    """Number of the episode of each environment, shape (k,), int64, 0 to 2^32 - 1."""

    def select(self, rows: torch.Tensor) -> EpisodeRandom:
        """Return the numbers of some of the environments, by their rows (m,), int64."""
        key = self.key if isinstance(self.key, int) else self.key[rows]
        return EpisodeRandom(key, self.env_number[rows], self.episode[rows])

    def uniform(self, stream: int, count: int) -> torch.Tensor:
        """Return numbers that are uniform in [0, 1), multiples of 2^-24.

        Args:
            stream: A ``Stream``, or a number from ``Stream.TASK`` on.
            count: Numbers of each environment.

        Returns:
            Numbers, shape (k, count), float32.
        """
        words = self._words(stream, count)
        return (words >> (32 - _FLOAT_BITS)).float() * 2.0**-_FLOAT_BITS

    def integers(self, stream: int, high: torch.Tensor) -> torch.Tensor:
        """Return integers that are uniform in [0, high).

        Their probabilities differ by 2^-32 at most: a word times ``high``, divided by 2^32.

        Args:
            stream: As of ``uniform``.
            high: Bounds, shape (k,) or (k, count), int64, 1 to 2^31; a bound of 0 gives 0.

        Returns:
            Integers of the shape of ``high``, int64.
        """
        words = self._words(stream, high.shape[1] if high.ndim > 1 else 1)
        return (words.reshape(high.shape) * high) >> 32

    def _words(self, stream: int, count: int) -> torch.Tensor:
        """Return uniform words, shape (k, count), int64."""
        k, num_blocks = len(self.episode), -(-count // 4)
        counter = self.episode.new_empty(4, k, num_blocks)
        counter[0], counter[1] = self.env_number[:, None], self.episode[:, None]
        counter[2].fill_(stream)
        counter[3] = torch.arange(num_blocks, device=counter.device)
        key = self.key
        if not isinstance(key, int):
            key = key.repeat_interleave(num_blocks, dim=0)  # the blocks of an environment follow
        words = philox(counter.flatten(1), key)
        return words.T.reshape(k, 4 * num_blocks)[:, :count]


class EpisodeSequence:
    """The episodes of n environments, one after the other.

    Attributes:
        seed: Seed of the random numbers, 0 to ``MAX_SEED``, or a seed of each environment.
        env_number: Number of each environment, shape (n,), int64; 0 where each has its own seed.
        next_episode: Number of the next episode of each environment, shape (n,), int64.
    """

    seed: int | tuple[int, ...]

    def __init__(self, seed: int, env_number: torch.Tensor) -> None:
        """Begin with the first episodes; for the arguments see the attributes."""
        self._numbers, self.next_episode = env_number, torch.zeros_like(env_number)
        self.restart(seed, self.next_episode)

    def restart(self, seed: int | Sequence[int], next_episode: torch.Tensor) -> None:
        """Go on with another seed and other episodes; see the attributes."""
        self._key: int | torch.Tensor
        if isinstance(seed, int):
            require_seed(seed)
            self.seed, self._key, self.env_number = seed, seed, self._numbers
        else:
            if len(seed) != len(self._numbers):
                raise TaskError(f"{len(seed)} seeds for {len(self._numbers)} environments")
            for env_seed in seed:
                require_seed(env_seed)
            words = [divmod(env_seed, WORD)[::-1] for env_seed in seed]
            self._key = torch.tensor(words, device=self._numbers.device)
            self.seed, self.env_number = tuple(seed), torch.zeros_like(self._numbers)
        self.next_episode.copy_(next_episode)

    def begin(self, mask: torch.Tensor) -> EpisodeRandom:
        """Begin episodes in some environments (n,); return the numbers of all next episodes."""
        random = EpisodeRandom(self._key, self.env_number, self.next_episode.clone())
        self.next_episode += mask  # in place, as a CUDA graph has to
        return random


def require_seed(seed: int) -> None:
    """Require a seed of episodes."""
    if not 0 <= seed <= MAX_SEED:
        raise TaskError(f"seed {seed}: expected 0 to 2^64 - 1")


def philox(counter: torch.Tensor, seed: int | torch.Tensor) -> torch.Tensor:
    """Return the random words (4, m) of m counters (4, m) by Philox4x32-10, lowest words first.

    The seed is the key, 0 to ``MAX_SEED``, or low and high words of each counter's key, (m, 2).
    """
    # A round multiplies the third and the first word, in this order, and mixes in the others.
    factors, others = counter[::2].flip(0), counter[1::2]
    low_key, high_key = (seed % WORD, seed // WORD) if isinstance(seed, int) else seed.T
    multipliers = _column(_MULTIPLIERS, counter)
    for k in range(ROUNDS):
        keys = (low_key + k * _KEY_STEPS[0]) % WORD, (high_key + k * _KEY_STEPS[1]) % WORD
        product = factors * multipliers
        high = (product >> 32).add_(factors).bitwise_xor_(others)  # see ``_MULTIPLIERS``
        factors = high.bitwise_xor_(_column(keys, counter)).flip(0)
        others = product.bitwise_and_(WORD - 1)
    return torch.stack([factors[1], others[0], factors[0], others[1]])


def _column(
    numbers: tuple[int | torch.Tensor, int | torch.Tensor], like: torch.Tensor
) -> torch.Tensor:
    """Return two numbers as a column, shape (2, 1), without a copy from the CPU; or two rows."""
    if isinstance(numbers[0], torch.Tensor):
        return torch.stack(numbers)  # type: ignore[arg-type]  # then the other is a tensor, too
    column = like.new_empty(2, 1)
    column[0].fill_(numbers[0])
    column[1].fill_(numbers[1])
    return column
