"""A random draw is a function of its seed, its stream and its counter only."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pcil import seeds
from pcil.seeds import Stream

law = settings(deadline=None, derandomize=True, max_examples=100)
names = st.tuples(st.integers(0, 2**32 - 1), st.sampled_from(Stream), st.integers(0, 2**32 - 1))


def numbers(seed: int, stream: Stream, counter: int) -> tuple[int, ...]:
    return tuple(seeds.rng(seed, stream, counter).integers(2**62, size=2).tolist())


def jax_numbers(seed: int, stream: Stream, counter: int) -> tuple[int, ...]:
    return tuple(np.asarray(jax.random.key_data(seeds.key(jax.random.key(seed), stream, counter))).tolist())


def test_the_streams_numbers_stay_what_they_were() -> None:
    """Every published result depends on them. A new stream is added at the end, and to this table."""
    assert {stream.name: stream.value for stream in Stream} == {
        "INIT_AGENT": 0,
        "INIT_REWARD": 1,
        "EPISODE": 2,
        "ACT": 3,
        "SAMPLE": 4,
        "UPDATE": 5,
        "LABEL": 6,
        "EVALUATE": 7,
        "RECORD": 8,
        "CLONE": 9,
        "NOISE": 10,
        "SELECT": 11,
    }


def test_the_draws_stay_what_they_were() -> None:
    """The first value is `SeedSequence((1, 2, 3)).generate_state(1)[0] >> 1` in NumPy; the second is `fold_in` written out."""
    assert seeds.episode_seed(1, Stream.EPISODE, 3) == int(np.random.SeedSequence((1, 2, 3)).generate_state(1)[0]) // 2
    root = jax.random.key(1)
    expected = jax.random.key_data(jax.random.fold_in(jax.random.fold_in(root, 5), 7))
    np.testing.assert_array_equal(jax.random.key_data(seeds.key(root, Stream.UPDATE, 7)), expected)
    expected = np.random.default_rng(np.random.SeedSequence((1, 4, 9))).random(3)
    np.testing.assert_array_equal(seeds.rng(1, Stream.SAMPLE, 9).random(3), expected)


@law
@given(names, names)
def test_other_names_draw_other_numbers_and_the_same_name_the_same(first: tuple, second: tuple) -> None:
    assume(first != second)
    assert numbers(*first) != numbers(*second)
    assert numbers(*first) == numbers(*first)
    assert seeds.episode_seed(*first) == seeds.episode_seed(*first)


@pytest.mark.parametrize("draw", [numbers, jax_numbers, lambda *name: seeds.episode_seed(*name)])
def test_neighbouring_seeds_streams_and_counters_are_all_different(draw) -> None:
    every = {draw(seed, stream, counter) for seed in range(4) for stream in Stream for counter in range(4)}
    assert len(every) == 4 * len(Stream) * 4


def test_streams_share_no_number_however_long_they_are_drawn_from() -> None:
    """Nor do the episodes of one stream. Equal 64-bit draws would occur by chance once in 10^11 such tests."""
    drawn = [
        seeds.rng(1, stream, episode).integers(2**64, size=500, dtype=np.uint64) for stream in Stream for episode in range(3)
    ]
    assert len(np.unique(np.concatenate(drawn))) == 500 * 3 * len(Stream)
    keys = [seeds.key(jax.random.key(1), stream, counter) for stream in Stream for counter in range(3)]
    bits = [np.asarray(jax.random.bits(k, (8, 2))) for key in keys for k in jax.random.split(key, 3)]
    assert len(np.unique(np.concatenate(bits), axis=0)) == 8 * 3 * len(keys)


def test_a_new_consumer_shifts_no_other() -> None:
    alone = [numbers(1, Stream.ACT, counter) for counter in range(5)]
    among = []
    for counter in range(5):
        seeds.rng(1, Stream.SAMPLE, counter).random(17)
        np.random.default_rng().random(3)
        among.append(numbers(1, Stream.ACT, counter))
        seeds.episode_seed(1, Stream.RECORD, counter)
    assert among == alone


def test_draws_do_not_depend_on_the_order_in_which_they_are_made() -> None:
    forwards = [jax_numbers(0, Stream.UPDATE, counter) for counter in range(5)]
    backwards = [jax_numbers(0, Stream.UPDATE, counter) for counter in reversed(range(5))]
    assert forwards == backwards[::-1]


def test_a_compiled_counter_gives_the_key_of_a_plain_one() -> None:
    root = jax.random.key(3)
    compiled = jax.jit(lambda counter: jax.random.key_data(seeds.key(root, Stream.UPDATE, counter)))
    for counter in (0, 1, 1_000_000):
        np.testing.assert_array_equal(compiled(np.int32(counter)), jax_numbers(3, Stream.UPDATE, counter))


def test_seeds_of_episodes_have_31_bits_and_do_not_repeat() -> None:
    drawn = [seeds.episode_seed(0, Stream.EPISODE, counter) for counter in range(3000)]
    assert min(drawn) >= 0
    assert 2**30 < max(drawn) < 2**31
    assert len(set(drawn)) == 3000
