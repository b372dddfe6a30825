"""S, rho and stray light: which constant patterns tell them, and what a border adds."""

import numpy as np

from workflows.ingest.light.observation import constants_of, stray_light
from workflows.programs.border import border_light
from workflows.programs.presets import preset
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import fit_photometry


def test_stray_light_of_constant_frames_is_what_s_and_rho_are_fitted_to() -> None:
    program = preset("quick", 640, 480)
    patterns = list(range(program.count))
    plain = stray_light({"patterns": patterns}, program)
    np.testing.assert_array_equal(plain, 1)
    assert plain.shape == (1, program.measured.size + 2)
    strays = stray_light({"patterns": patterns, "border": True}, program)
    lit = border_light(patterns)
    np.testing.assert_array_equal(strays[0], 1)
    np.testing.assert_array_equal(strays[1:, :-2], lit[:, program.measured])
    numbers, sent = constants_of({"patterns": patterns, "border": True}, program)
    seen = np.repeat(0.1 + 0.3 * lit[:, numbers, np.newaxis], 3, axis=2) + 0.2 * sent
    S, rho, *_ = fit_photometry(PatternLight.of(seen), sent, NoiseModel(1e-6, 1e-4))
    for channel in range(3):
        np.testing.assert_allclose(S[:, channel], 0.1 + 0.3 * strays[1:, -2], atol=1e-5)
        np.testing.assert_allclose((S + rho)[:, channel], 0.3 + 0.3 * strays[1:, -1], atol=1e-5)


def test_coloured_constants_tell_s_and_rho_where_no_border_changes_beside_them() -> None:
    program = preset("quick", 640, 480)
    patterns = list(range(program.count))
    numbers, sent = program.constants
    grey = np.ptp(sent, axis=1) == 0
    assert 2 < np.count_nonzero(grey) < grey.size
    np.testing.assert_array_equal(constants_of({"patterns": patterns}, program)[0], numbers)
    beside = {"border": True}
    np.testing.assert_array_equal(constants_of({"patterns": patterns} | beside, program)[0], numbers[grey])
    # A film that lacks all of the black frames can do with what is there.
    coloured = [n for n in patterns if n not in numbers[(sent == 0).all(axis=1)]]
    np.testing.assert_array_equal(
        constants_of({"patterns": coloured} | beside, program)[0], numbers[sent.any(axis=1)]
    )
