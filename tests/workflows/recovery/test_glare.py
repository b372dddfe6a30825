"""Glare: patterns that are filtered by it, rows that have it, and shares that are found again."""

from dataclasses import replace

import numpy as np
import pytest

from workflows.recovery.glare import (
    WIDTHS,
    add_glare,
    filter_patterns,
    fit_shares,
    spread_patterns,
    whole_monitor,
)
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import Transport

COLUMNS, ROWS, M = 160, 120, 24
SHARES = [0.03, 0.05, 0.02, 0.04]
SHARES_OF_ONE = [[0.1, 0, 0, 0], [0, 0.1, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 0.1]]


@pytest.fixture(scope="module")
def patterns() -> Patterns:
    """Random blocks of four sizes."""
    rng = np.random.default_rng(0)
    light = [
        np.kron(rng.integers(0, 2, (ROWS // size, COLUMNS // size)), np.ones((size, size)))
        for size in (40, 20, 8, 4)
        for _ in range(M // 4)
    ]
    pyramid = Pyramid.over(COLUMNS, ROWS)
    code = np.rint(255 * pyramid.light(np.stack(light, axis=2).astype(np.float32))).astype(np.uint8)
    return Patterns(pyramid, 1, code)


def test_a_white_monitor_stays_white(patterns: Patterns) -> None:
    white = replace(patterns, code=np.full_like(patterns.code, 255))
    np.testing.assert_array_equal(filter_patterns(white, spread_patterns(white), SHARES).code, 255)
    black = replace(patterns, code=np.zeros_like(patterns.code))
    np.testing.assert_array_equal(filter_patterns(black, spread_patterns(black), SHARES).code, 0)


def transport_of(count: list[int], cell: list[int], weight: list[float]) -> Transport:
    counts = np.zeros((len(count), 3), np.int64)
    counts[:, 0] = count
    shared = np.ones(len(count), bool)
    return Transport.from_rows(COLUMNS, ROWS, counts, np.array(cell), np.array(weight), shared)


@pytest.mark.parametrize("shares", [*SHARES_OF_ONE, SHARES])
def test_light_through_glare_is_that_of_a_row_with_glare(patterns: Patterns, shares: list[float]) -> None:
    """A T that sees the filtered patterns sees the same as T with glare, of the patterns as they are."""
    plain = transport_of([2, 1], [40 * COLUMNS + 70, 41 * COLUMNS + 70, 90 * COLUMNS + 30], [0.4, 0.6, 1.0])
    glaring = add_glare(plain, shares)
    filtered = filter_patterns(patterns, spread_patterns(patterns), shares)
    for at in range(M):
        seen, through = (np.repeat(p.code[:, at, None] / np.float32(255), 3, 1) for p in (patterns, filtered))
        with_glare, expected = glaring.apply(seen), plain.apply(through)
        np.testing.assert_allclose(with_glare, expected, atol=0.02)
        np.testing.assert_allclose(with_glare.mean(), expected.mean(), atol=0.012)


def test_rows_without_entries_stay_empty() -> None:
    glaring = add_glare(transport_of([0, 1, 0], [5], [1.0]), SHARES)
    assert glaring.count[[0, 2]].tolist() == [[0, 0, 0], [0, 0, 0]]
    assert glaring.count[1, 0] > 50
    assert glaring.weight.sum() == pytest.approx(1, abs=1e-5)


def test_many_rows_grow_the_buffers() -> None:
    many = transport_of([1] * 300, list(range(300)), [1.0] * 300)
    glaring = add_glare(many, SHARES)
    count = glaring.count[:, 0].astype(np.int64)
    first = np.cumsum(count) - count
    assert (glaring.count[:, 0] > 50).all()
    np.testing.assert_allclose(np.add.reduceat(glaring.weight, first), 1, atol=1e-5)


def test_shares_are_found_again(patterns: Patterns) -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform((20, 20), (COLUMNS - 20, ROWS - 20), (400, 2)).T
    cell = y.astype(int) * COLUMNS + x.astype(int)
    plain = (patterns.code[cell] / 127.5 - 1).astype(np.float32)
    parts = np.stack([part.at(x, y) for part in spread_patterns(patterns)], axis=2) - plain[..., np.newaxis]
    residual = parts @ np.array(SHARES, np.float32) + 0.01 * rng.standard_normal(plain.shape).astype(
        np.float32
    )
    residual[::50] += 0.5  # outliers
    weight = np.full(plain.size, 1e4, np.float32)
    found = fit_shares(parts.reshape(-1, len(WIDTHS) + 1), residual.ravel(), weight)
    np.testing.assert_allclose(found, SHARES, atol=0.004)
    none = fit_shares(parts.reshape(-1, len(WIDTHS) + 1), np.zeros(plain.size, np.float32), weight)
    assert none.tolist() == [0, 0, 0, 0]


def test_the_whole_monitor_is_about_its_mean() -> None:
    pyramid = Pyramid.over(1280, 960)
    picture = np.random.default_rng(2).random((960, 1280, 1), np.float32)
    picture += np.linspace(-1, 1, 1280)[:, np.newaxis].astype(np.float32)
    seen = pyramid.light(picture)[whole_monitor(pyramid)].mean()
    assert seen == pytest.approx(picture.mean(), abs=0.06)
