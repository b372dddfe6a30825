"""The options of NN-DGSR: names, types, ranges, defaults and descriptions."""

from typing import Annotated, Literal, NamedTuple

from workflows.recovery.options import Range


class Constants(NamedTuple):
    """The numeric options of NN-DGSR, which are passed to kernels."""

    sparsity: Annotated[
        float,
        Range(0.01, 1),
        "Most cells of T at the finest level, as a share of the measurements; a fifth in the paper.",
    ] = 0.2
    growth: Annotated[
        float,
        Range(1, 100),
        "Factor by which the number of cells grows, from one, until more cells do not improve the fit.",
    ] = 1.25
    sum_tolerance: Annotated[
        float,
        Range(0, 1),
        "The number of cells keeps growing while the L1 norm of T differs from 1 by more than this.",
    ] = 0.02
    least_group: Annotated[
        float,
        Range(0, 1),
        "A cell is refined if its weight plus half of its eight neighbours' is more than this.",
    ] = 0.02
    rounds: Annotated[int, Range(1, 1000), "Most rounds of choosing and pruning cells at one sparsity."] = 10
    stall: Annotated[
        float,
        Range(0, 1),
        "Rounds, and fits of the Gaussians, end when one lowers the squared residual by less than this share.",
    ] = 0.01
    sweeps: Annotated[
        int, Range(1, 10_000), "Most sweeps of coordinate descent in a least-squares solve."
    ] = 30
    tolerance: Annotated[
        float, Range(0, 1), "Sweeps end when one changes no entry of T by more than this."
    ] = 1e-4
    clusters: Annotated[
        int, Range(1, 8), "Most clusters of a T that a Gaussian is fitted to; the paper finds 3 at most."
    ] = 3
    reach: Annotated[
        float, Range(1, 6), "Cells more than this many standard deviations from every Gaussian are removed."
    ] = 3.0
    fits: Annotated[
        int, Range(1, 100), "Most times that Gaussians are fitted to T and T is filtered by them."
    ] = 8
    steps: Annotated[int, Range(1, 1000), "Most conjugate gradient steps when T is filtered."] = 30
    precision: Annotated[
        float, Range(0, 1), "Conjugate gradients end when this share of the right-hand side is left."
    ] = 0.03
    least_contrast: Annotated[
        float,
        Range(0, 100),
        "A channel whose rho is below this many standard deviations of a mid-grey value has an empty row in T.",
    ] = 3.0


class DgsrOptions(NamedTuple):
    """The paper's NN-DGSR (Sect. 4.2 and 5.1): non-negative dynamic group sparsity, filtered by oriented Gaussians."""

    prior: Annotated[
        Literal["gaussian", "none"],
        "`gaussian` fits oriented Gaussians to the clusters of T and filters T by them (Sect. 4.2.2); `none` does not.",
    ] = "gaussian"
    levels: Annotated[
        Literal["hierarchical", "direct"],
        "`hierarchical` goes from coarse to fine grids, and only the children of a level's cells are unknowns on the "
        "next (Sect. 4.2.3); `direct` solves for all cells of the finest level at once and is much slower.",
    ] = "hierarchical"
    channels: Annotated[
        Literal["apart", "joint"],
        "`apart` recovers one T per channel, as in the paper; `joint` recovers one T for all three, their measurements "
        "weighted by inverse variance, for glass without dispersion.",
    ] = "apart"
    constants: Constants = Constants()


DEFAULT = DgsrOptions()
