"""Codes: parity, erasures, noise, and that chance is not taken for a codeword."""

import numpy as np
import pytest

from rxcli.link import ldpc
from rxcli.link.ldpc import LLR_STEP, Code, decode, encode, nr_code, quantised


def parity_holds(code: Code, information: np.ndarray) -> bool:
    """Every check of the lifted graph, written out bit by bit, over the whole codeword."""
    (buffer,) = encode(code, information[None])
    kb, z = code.information_columns, code.z
    word = np.concatenate([information, np.zeros(code.filler, np.uint8), buffer[code.k - 2 * z :]])
    assert word.size == code.n_columns * z
    checks = (sum(int(word[c * z + (i + v) % z]) for c, v in row) for row in code.rows for i in range(z))
    assert kb * z == code.k + code.filler
    return all(total % 2 == 0 for total in checks)


SIZES = {(graph, k) for graph in (1, 2) for k in (96, 192, 288, 480, 1632, 2000)}
#: Every lifting set.
SIZES |= {(graph, 4 * kb * base) for graph, kb in ((1, 22), (2, 10)) for base in (2, 3, 5, 7, 9, 11, 13, 15)}


@pytest.mark.parametrize(("graph", "k"), sorted(SIZES))
def test_codewords_satisfy_every_check(graph: int, k: int) -> None:
    assert parity_holds(nr_code(graph, k), np.random.default_rng(k).integers(0, 2, k, dtype=np.uint8))


@pytest.mark.parametrize(("graph", "k"), [(1, 8449), (1, 0), (2, 3841)])
def test_lengths_that_no_code_has_are_refused(graph: int, k: int) -> None:
    with pytest.raises(ValueError, match="k must be"):
        nr_code(graph, k)


def received(code: Code, n_bits: int, sigma: float, share: float, seed: int, batch: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2, (batch, code.k), dtype=np.uint8)
    sent = 2.0 * encode(code, bits)[:, :n_bits] - 1
    llr = 2 / sigma**2 * (sent + sigma * rng.standard_normal(sent.shape))
    return bits, quantised(llr * (rng.random(sent.shape) < share))


def run(code: Code, bits: np.ndarray, llr: np.ndarray, iterations: int = 25) -> np.ndarray:
    return decode(code, llr, lambda place, found: bool((found == bits[place]).all()), iterations)


@pytest.mark.parametrize(("share", "is_enough"), [(0.42, True), (0.3, False)])
def test_fragments_are_decoded_where_they_are_enough(share: float, is_enough: bool) -> None:
    code = nr_code(1, 8448)
    bits, llr = received(code, 25340, 0.4, share, 3, 4)
    assert run(code, bits, llr).tolist() == [is_enough] * 4


def test_blocks_of_a_batch_do_not_disturb_each_other() -> None:
    code = nr_code(2, 288)
    bits, llr = received(code, 900, 0.5, 0.6, 5, 6)
    llr[2] = 0
    alone = [bool(run(code, bits[i : i + 1], llr[i : i + 1])[0]) for i in range(6)]
    assert run(code, bits, llr).tolist() == alone
    assert alone.count(True) == 5


def test_sums_stay_within_sixteen_bits() -> None:
    """Bits that all look certain and contradict each other drive messages as far as they go."""
    code = nr_code(1, 8448)
    llr = np.where(np.random.default_rng(1).random((2, 25340)) < 0.5, 127, -127).astype(np.int8)
    total = np.zeros((code.n_columns * code.z, 2), np.int16)
    total[code.first_sent : code.first_sent + 25340] = llr.T
    layers = ldpc._Layers(code, len(code.rows), total)
    for _ in range(40):
        layers.update()
        assert np.abs(layers._total.astype(np.int64)).max() < 32_000
    assert LLR_STEP * 127 == 15.875


def test_a_block_whose_checks_do_not_improve_is_given_up() -> None:
    code, rng = nr_code(2, 1632), np.random.default_rng(1)
    chance = quantised(rng.choice([-1.0, 1.0], (8, 3073)))
    bits, llr = received(code, 3073, 0.8, 1.0, 4, 8)
    attempts: list[int] = []

    def accept(place: int, found: np.ndarray) -> bool:
        attempts.append(place)
        return bool((found == bits[place]).all())

    assert decode(code, llr, accept, 25).all()
    attempts.clear()
    assert not decode(code, chance, accept, 25).any()
    assert len(attempts) < 8 * 12
