"""What graphics hardware gets, drawn here as the module says it is to be."""

import gzip
import json
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout import mattes
from storage.layout.mattes import Matte, empty_block
from storage.objects.store import Objects
from tests.workflows.composite.live.nodes.drawing import CROSSTALK, few_nodes
from workflows.composite import composite
from workflows.composite.live import encode
from workflows.composite.live.encode import LOOKUPS, encode_live
from workflows.recovery.pyramid import Pyramid

HEIGHT, WIDTH, COLUMNS, ROWS = 20, 35, 75, 37


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """A matte of as many nodes a row as there are lookups, at most."""
    return few_nodes(objects, LOOKUPS)


def drawn(data: bytes, backdrop: NDArray[np.float32]) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """The glass before light on the cells, (height, width, 4), and the header."""
    plain = gzip.decompress(data)
    start = 4 + int.from_bytes(plain[:4], "little")
    header = json.loads(plain[4:start])
    planes = np.frombuffer(plain, np.uint8, offset=start).reshape(-1, header["height"], header["width"])
    assert len(planes) == 8 * header["lookups"] + 7
    light = Pyramid.over(COLUMNS, ROWS).light(backdrop)
    starts = Pyramid.over(COLUMNS, ROWS).starts

    def bilinear(level: int, x: float, y: float) -> NDArray[np.float32]:
        columns, rows = header["levels"][level]
        grid = light[starts[level] : starts[level + 1]].reshape(rows, columns, 3)
        x, y = x / 2**level - 0.5, y / 2**level - 0.5
        seen = np.zeros(3, np.float32)
        for i in (int(np.floor(y)), int(np.floor(y)) + 1):
            for j in (int(np.floor(x)), int(np.floor(x)) + 1):
                share = (1 - abs(y - i)) * (1 - abs(x - j))
                seen += share * grid[np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1)]
        return seen

    arrived = np.zeros((header["height"], header["width"], 3))
    for k in range(header["lookups"]):
        one = planes[8 * k : 8 * k + 8].astype(np.int64)
        x = np.cumsum(256 * one[0] + one[1], axis=1) % 65536 / 65536 * header["texture"][0]
        y = np.cumsum(256 * one[2] + one[3], axis=1) % 65536 / 65536 * header["texture"][1]
        for at in zip(*np.nonzero(one[5:8].any(axis=0)), strict=True):
            level, further = divmod(one[4][at] / 16, 1)
            below = bilinear(int(level), x[at], y[at])
            above = bilinear(int(level) + 1, x[at], y[at]) if further else below
            arrived[at] += one[5:8, *at] / 255 * (below + further * (above - below))
    S, rho = (
        header[name] * np.moveaxis(planes[first : first + 3] / 255.0, 0, 2) ** 2
        for name, first in (("S", -7), ("rho", -4))
    )
    seen = S + (rho * arrived) @ np.transpose(header["crosstalk"])
    alpha = planes[-1, ..., np.newaxis] / 255
    return np.concatenate([seen * alpha, alpha], axis=2), header


def test_it_is_the_composite_where_lookups_suffice(matte: Matte) -> None:
    backdrop = np.random.default_rng(1).random((ROWS, COLUMNS, 3), np.float32)
    got, header = drawn(encode_live(matte, 1), backdrop)
    assert (header["width"], header["height"], header["step"]) == (WIDTH, HEIGHT, 1)
    assert header["levels"] == [[75, 37], [38, 19], [19, 10]]
    assert header["texture"] == [76, 40]
    expected = composite(matte, backdrop)
    np.testing.assert_array_equal(got[..., 3], expected[..., 3])
    # what 8 bits of S, rho and the shares leave
    assert np.sqrt(np.mean((got - expected) ** 2)) < 0.005


def test_header_fits_a_backdrop_to_the_frame(matte: Matte, objects: Objects) -> None:
    assert (
        not {"view", "sight", "exposure"}
        & drawn(encode_live(matte, 1), np.zeros((ROWS, COLUMNS, 3)))[1].keys()
    )
    layout = {"height": HEIGHT, "width": WIDTH, "columns": COLUMNS, "rows": ROWS, "crosstalk": CROSSTALK}
    sight = [[2.0, 0, -0.5], [0, 2.0, -0.5], [0, 0, 1]]
    whole = mattes.create(objects, "whole", **layout, beside={"sight": sight, "rho": [0.5, 0.6, 0.7]})
    _, header = drawn(encode_live(matte, 1, whole=whole), np.zeros((ROWS, COLUMNS, 3), np.float32))
    assert header["view"] == {"right": 0, "down": 0, "scale": 2}
    assert header["sight"] == sight
    white = np.array(header["exposure"]) @ CROSSTALK @ [0.5, 0.6, 0.7]
    np.testing.assert_allclose(white, 1)


def test_the_bytes_are_the_same_by_any_threads(matte: Matte) -> None:
    assert encode_live(matte, 3) == encode_live(matte, 1)


def test_large_matte_is_sampled(objects: Objects, monkeypatch: pytest.MonkeyPatch) -> None:
    height, width = 61, 90
    monkeypatch.setattr(encode, "MOST_PIXELS", 1400)
    large = mattes.create(
        objects, "large", height=height, width=width, columns=COLUMNS, rows=ROWS, crosstalk=CROSSTALK
    )

    for row, column in product(range(large.block_rows), range(large.block_columns)):
        y, x = large.span(row, column)
        S = np.repeat(np.add.outer(np.arange(y.start, y.stop), np.arange(x.start, x.stop))[..., None], 3, 2)
        black = empty_block(*S.shape[:2])
        large.write(row, column, replace(black, S=S.astype(np.float32), recovered=~black.recovered))
    got, header = drawn(encode_live(large, 1), np.zeros((ROWS, COLUMNS, 3), np.float32))
    assert (header["width"], header["height"], header["step"]) == (45, 30, 2)
    assert got[..., 3].all()
    expected = np.add.outer(np.arange(1, height, 2), np.arange(1, width, 2))
    np.testing.assert_allclose(got[..., 0], expected, atol=0.01 * expected.max())
