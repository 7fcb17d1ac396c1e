"""Pseudo-random sequences and index strides that sender and receiver share."""

from functools import cache
from math import gcd

import numpy as np
from numpy.typing import NDArray

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


def splitmix64(seeds: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """First output of SplitMix64 for each of `seeds`, any shape."""
    z = np.asarray(seeds, np.uint64) + _GAMMA
    z = (z ^ (z >> np.uint64(30))) * _MIX_1
    z = (z ^ (z >> np.uint64(27))) * _MIX_2
    return np.asarray(z ^ (z >> np.uint64(31)))


def whiten(data: bytes, object_id: int, block: int) -> bytes:
    """XOR `data` with the whitening sequence of a block of an object; its own inverse."""
    states = np.uint64((object_id << 32) | block) + np.arange(-(-len(data) // 8), dtype=np.uint64) * _GAMMA
    words = splitmix64(states)
    mask = words.astype(">u8").view(np.uint8)[: len(data)]
    return (np.frombuffer(data, np.uint8) ^ mask).tobytes()


@cache
def stride(modulus: int) -> int:
    """g(Y): the smallest integer of at least max(1, floor(0.618 Y)) that is coprime to Y."""
    value = max(1, 618 * modulus // 1000)
    while gcd(value, modulus) != 1:
        value += 1
    return value


def largest_coprime(limit: int, to: int) -> int:
    """The largest integer of at most `limit`, at least 1, that is coprime to `to`."""
    value = max(1, limit)
    while gcd(value, to) != 1:
        value -= 1
    return value
