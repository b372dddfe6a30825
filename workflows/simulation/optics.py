"""What light does at the surfaces of glass, and random numbers that stay the same."""

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Ends = list[tuple[NDArray[np.intp], Doubles, Doubles, Doubles]]
"""Bundles of rays that leave an object: their numbers (m,), points (3, m), directions (3, m) and weights (m,)."""


def fresnel(cosine: Doubles, index: float) -> tuple[Doubles, Doubles]:
    """Compute reflection and refraction of unpolarised light at a surface.

    Parameters
    ----------
    cosine : (...) float64
        Cosine of the angle between the incident ray and the normal, above 0.
    index : float
        Ratio of the refractive indices behind and in front of the surface.

    Returns
    -------
    reflectance : (...) float64
        Share of the power reflected; 1 under total reflection. The rest is refracted.
    refracted : (...) float64
        Cosine of the refracted ray's angle to the normal; 0 under total reflection.

    References
    ----------
    M. Born and E. Wolf, Principles of Optics, 7th ed., 1999, Sect. 1.5: Snell's law (1.5.1), Fresnel's
    formulae (1.5.2), natural light as the mean of both polarisations (1.5.3), total reflection (1.5.4).
    """
    refracted = np.sqrt(np.maximum(1 - (1 - cosine**2) / index**2, 0))
    perpendicular = (cosine - index * refracted) / (cosine + index * refracted)
    parallel = (index * cosine - refracted) / (index * cosine + refracted)
    return (perpendicular**2 + parallel**2) / 2, refracted


def uniform(random: np.random.PCG64, count: int) -> Doubles:
    """Doubles from 0 to 1, from the top 53 bits of raw words: unlike Generator's, the same in all versions of numpy."""
    return np.asarray((random.random_raw(count) >> np.uint64(11)) * 2.0**-53, np.float64)
