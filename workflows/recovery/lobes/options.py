"""The options of the lobes method: names, types, ranges, defaults and descriptions."""

from typing import Annotated, NamedTuple

from workflows.recovery.options import Range


class LobesOptions(NamedTuple):
    """A few oriented Gaussian lobes and the posterior mean of T about them; any program; one T where channels agree."""

    most_lobes: Annotated[int, Range(1, 16), "Most lobes of a T."] = 4
    fit_resolution: Annotated[
        float,
        Range(0.5, 4),
        "Least standard deviation of a lobe along its minor axis while it is fitted, in spacings of the grid that it "
        "is sampled on. A lobe at least twice as wide goes to the next coarser grid.",
    ] = 0.65
    resolution: Annotated[
        float, Range(0.5, 4), "The same as `fit_resolution`, for the T that is recovered."
    ] = 1.1
    rounds: Annotated[
        int, Range(1, 100), "Most rounds of a fit. The measurements are weighted again after each round."
    ] = 1
    steps: Annotated[int, Range(1, 1000), "Most Levenberg-Marquardt steps in a round."] = 9
    tolerance: Annotated[
        float, Range(0, 100), "A round ends when a step lowers chi-square by less than this."
    ] = 2.0
    beam: Annotated[
        int, Range(1, 64), "Nodes of each grid whose children are examined in the search for another lobe."
    ] = 4
    doubt: Annotated[
        float,
        Range(0, 1),
        "Lobes are fitted a second time, starting from their posterior mean, where they leave more than this variance "
        "of a black-and-white pattern (-1 to 1) unexplained. 1: a single ray is missed.",
    ] = 0.01
    passes: Annotated[
        int,
        Range(1, 20),
        "How many times T is replaced by its posterior mean.",
    ] = 4
    gradients: Annotated[int, Range(1, 1000), "Most conjugate gradient steps in a pass."] = 5
    disagreement: Annotated[
        float,
        Range(0, 1e6),
        "One T serves all channels unless their chi-square per degree of freedom exceeds this. For grey patterns; "
        "under coloured ones the likelihood decides.",
    ] = 1.5
    least_weight: Annotated[float, Range(0, 0.1), "Entries of T below this are dropped."] = 1e-4
    least_contrast: Annotated[
        float,
        Range(0, 100),
        "A channel whose rho is below this many standard deviations of a mid-grey value has an empty row in T.",
    ] = 3.0


FINE = LobesOptions()
"""The default quality."""
FAST = LobesOptions(most_lobes=2, resolution=0.8, steps=4, beam=3, doubt=0.03)
"""The quality `fast`: fewer lobes, and a shorter search for them."""
