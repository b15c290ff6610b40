"""Random numbers of episodes: known answers of the generator, uniformity and independence."""

import pytest
import torch

from morphgen.errors import TaskError
from morphgen.tasks.random_numbers import MAX_SEED, EpisodeRandom, EpisodeSequence, Stream, philox

ZERO, ONES, PI = "00000000", "ffffffff", "243f6a88 85a308d3 13198a2e 03707344"
KNOWN_ANSWERS = [
    (" ".join([ZERO] * 4), f"{ZERO} {ZERO}", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    (" ".join([ONES] * 4), f"{ONES} {ONES}", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    (PI, "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]
"""Counter, key and result of philox4x32 with 10 rounds in the file kat_vectors of Random123."""
MANY = 200_000
BOUND = 6.0
"""Largest accepted deviation [standard deviations]; chance exceeds it once in 5e8 numbers."""


def words(text):
    return [int(word, 16) for word in text.split()]


def numbers(n, seed=0, first=0, episode=0):
    return EpisodeRandom(seed, torch.arange(first, first + n), torch.full((n,), episode))


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_the_generator_gives_the_known_answers(counter, key, expected):
    low, high = words(key)
    columns = torch.tensor([words(counter)] * 3).T
    result = philox(columns, low + high * 2**32)
    assert result.T.tolist() == [words(expected)] * 3


def test_numbers_are_uniform():
    uniform = numbers(MANY).uniform(Stream.POINTS, 5)
    assert uniform.dtype == torch.float32
    assert uniform.min() >= 0
    assert uniform.max() < 1
    error = (MANY * 12) ** -0.5
    assert (uniform.mean(dim=0) - 0.5).abs().max() < BOUND * error
    correlation = torch.corrcoef(uniform.T) - torch.eye(5)
    assert correlation.abs().max() < BOUND * MANY**-0.5


def test_integers_are_uniform_below_their_bounds():
    high = torch.tensor([1, 2, 3, 7, 100]).repeat(MANY // 5)
    drawn = numbers(len(high)).integers(Stream.START, high)
    assert drawn.dtype == torch.int64
    assert (drawn < high).all()
    for bound in (1, 2, 3, 7, 100):
        counts = torch.bincount(drawn[high == bound], minlength=bound)
        expected = len(high) / 5 / bound
        assert (counts - expected).abs().max() <= BOUND * expected**0.5
    assert not numbers(4).integers(Stream.START, torch.zeros(4, 2, dtype=torch.int64)).any()


@pytest.mark.parametrize("change", [{"seed": 1}, {"seed": 2**32}, {"first": 5}, {"episode": 1}])
def test_numbers_depend_on_seed_environment_and_episode(change):
    one, other = numbers(50), numbers(50, **change)
    assert not torch.equal(one.uniform(Stream.START, 4), other.uniform(Stream.START, 4))
    assert not torch.equal(one.uniform(Stream.START, 4), one.uniform(Stream.LAYOUT, 4))
    assert not torch.equal(one.uniform(Stream.START, 4), one.uniform(Stream.TASK + 1, 4))


def test_numbers_do_not_depend_on_other_rows_or_on_how_many_are_drawn():
    whole = numbers(40, seed=7)
    rows = torch.tensor([3, 21, 20])
    part = whole.select(rows)
    drawn = whole.uniform(Stream.POINTS, 11)
    assert torch.equal(part.uniform(Stream.POINTS, 11), drawn[rows])
    assert torch.equal(whole.uniform(Stream.POINTS, 3), drawn[:, :3])


def test_environments_begin_one_episode_after_the_other():
    numbers_of = torch.arange(3, 7)
    sequence = EpisodeSequence(MAX_SEED, numbers_of)
    first = sequence.begin(torch.tensor([True, False, True, False]))
    second = sequence.begin(torch.tensor([True, True, False, False]))
    assert first.episode.tolist() == [0, 0, 0, 0]
    assert second.episode.tolist() == [1, 0, 1, 0]
    assert sequence.next_episode.tolist() == [2, 1, 1, 0]
    plain = EpisodeRandom(MAX_SEED, numbers_of, second.episode)
    assert torch.equal(second.uniform(Stream.START, 9), plain.uniform(Stream.START, 9))


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_seeds_out_of_range_are_rejected(seed):
    with pytest.raises(TaskError, match=rf"seed {seed}: expected 0 to 2\^64 - 1"):
        EpisodeSequence(seed, torch.arange(1))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cpu_and_gpu_give_the_same_bits():
    cpu = numbers(1000, seed=11)
    gpu = EpisodeRandom(11, cpu.env_number.cuda(), cpu.episode.cuda())
    assert torch.equal(gpu.uniform(Stream.POINTS, 9).cpu(), cpu.uniform(Stream.POINTS, 9))
    high = torch.arange(1, 1001)
    drawn = gpu.integers(Stream.START, high.cuda())
    assert torch.equal(drawn.cpu(), cpu.integers(Stream.START, high))
