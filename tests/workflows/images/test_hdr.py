"""Codes for HDR displays, by the levels that ITU-R BT.2408 and BT.2100 state."""

import numpy as np
import pytest

from workflows.images.hdr import BT_2020, HLG, PQ, full_scale, to_srgb
from workflows.images.tone_curves import to_light

PRIMARIES = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
"""Those of BT.2020, of light in sRGB's (ITU-R BT.2087, sect. 2)."""


@pytest.mark.parametrize(
    ("transfer", "code", "light"),
    [
        (HLG, 0.0, 0.0),
        (HLG, 0.75, 1.0),  # white
        (HLG, 0.378, 0.18),  # a grey card
        (HLG, 0.5, 1 / 12 / 0.26496),
        (PQ, 0.0, 0.0),
        (PQ, 0.5807, 1.0),
        (PQ, 0.5081, 100 / 203),
        (PQ, 0.15, 1 / 203),
    ],
)
def test_levels_are_those_of_the_standards(transfer: int, code: float, light: float) -> None:
    codes = np.full((2, 3, 3), round(code * 65535), np.uint16)
    for primaries in (1, BT_2020):  # grey is grey
        seen = to_light(to_srgb(codes, transfer, primaries)[1, 2].astype(np.float32) / 65535, "srgb")
        np.testing.assert_allclose(seen, light, rtol=0.01, atol=1e-5)


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_what_is_brighter_than_white_is_clipped_and_the_rest_rises(transfer: int) -> None:
    codes = np.arange(65536, dtype=np.uint16).repeat(3).reshape(256, 256, 3)
    seen = to_srgb(codes, transfer, BT_2020).reshape(-1, 3)
    assert (np.diff(seen[:, 1].astype(int)) >= 0).all()
    assert seen[[0, -1]].tolist() == [[0] * 3, [65535] * 3]


def test_colours_have_the_primaries_of_srgb() -> None:
    light = np.random.default_rng(0).random((40, 30, 3)) * 0.9 + 0.05
    wide = 0.26496 * light @ PRIMARIES.T
    code = np.where(
        wide <= 1 / 12,
        np.sqrt(3 * wide),
        0.17883277 * np.log(np.maximum(12 * wide, 1) - 0.28466892) + 0.55991073,
    )
    seen = to_srgb(np.rint(code * 65535).astype(np.uint16), HLG, BT_2020)
    np.testing.assert_allclose(to_light(seen / np.float32(65535), "srgb"), light, atol=2e-3)


def test_full_scale_leaves_out_lamps_and_what_compression_overshoots() -> None:
    brightest, darkest = np.full((4000, 1), 2, np.float32), np.zeros((4000, 1), np.float32)
    brightest[:3] = 2.6
    brightest[3:9], darkest[3:9] = 3.5, 3.4
    assert full_scale(HLG, brightest, darkest) == pytest.approx(2.2)
    assert full_scale(HLG, brightest / 4, darkest) == 1
    assert full_scale(HLG, 2 * brightest, darkest) == pytest.approx(1 / 0.26496, rel=1e-3)
