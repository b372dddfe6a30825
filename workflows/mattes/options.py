"""The options of recovery: the one place that says what there is, in which range, and which method it belongs to."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from storage.errors import OptionError


class RecoveryOptions(BaseModel):
    """What a recovery job may be asked for, whatever its method; each method adds its constants."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    method: str
    tile: int | None = Field(
        None,
        ge=16,
        le=1024,
        description="Edge of the squares that the frame is cut into, one task each, in pixels, rounded up to whole "
        "blocks of the matte. Left out: one block. The matte does not depend on it.",
    )

    @property
    def constants(self) -> dict[str, Any]:
        """The method's own options: keyword arguments of its `recover`."""
        return self.model_dump(exclude={*RecoveryOptions.model_fields, "quality"})


def _least_contrast() -> Any:
    return Field(
        3.0,
        ge=0,
        le=100,
        description="A channel whose rho is below this many standard deviations of a mid-grey value says nothing "
        "of T: its row is left empty.",
    )


FAST = {"most_lobes": 2, "resolution": 0.8, "steps": 4, "beam": 3, "doubt": 0.03, "passes": 1, "gradients": 8}
"""What `quality` fast stands for."""


class LobesOptions(RecoveryOptions):
    """A few oriented Gaussian lobes and the posterior mean of T about them; any program; one T where channels agree."""

    method: Literal["lobes"] = "lobes"
    quality: Literal["fine", "fast"] = Field(
        "fine",
        description="`fast` takes half of the time for two and a half decibels: it is "
        + ", ".join(f"`{name}` {value}" for name, value in FAST.items())
        + " where these are left out.",
    )
    most_lobes: int = Field(3, ge=1, le=16, description="Most lobes of a T.")
    fit_resolution: float = Field(
        0.65,
        ge=0.5,
        le=4,
        description="Standard deviations of a lobe across, in spacings of the nodes that it lies on, at least, while "
        "it is fitted. It may be up to twice as many.",
    )
    resolution: float = Field(1.1, ge=0.5, le=4, description="The same of the T that is recovered.")
    rounds: int = Field(
        1,
        ge=1,
        le=100,
        description="Most rounds of a fit, after each of which the measurements are weighed again.",
    )
    steps: int = Field(9, ge=1, le=1000, description="Most steps of Levenberg and Marquardt's in a round.")
    tolerance: float = Field(
        2.0, ge=0, le=100, description="A round ends when a step takes less than this off chi-square."
    )
    beam: int = Field(
        4, ge=1, le=64, description="Nodes of a grid that are looked into when another lobe is searched for."
    )
    doubt: float = Field(
        0.01,
        ge=0,
        le=1,
        description="Lobes are fitted once more, from what the measurements say about them, where they leave out "
        "more than this: the variance of a black-and-white pattern (-1 to 1) beside them; 1 is a single ray, "
        "unseen.",
    )
    passes: int = Field(
        2, ge=1, le=20, description="How often T is replaced by its posterior mean, each time about the last."
    )
    gradients: int = Field(9, ge=1, le=1000, description="Most conjugate gradients in each of them.")
    disagreement: float = Field(
        1.5,
        ge=0,
        le=1e6,
        description="One T serves all channels until their chi-square a degree of freedom exceeds this; then each has "
        "its own. For grey patterns; under coloured ones likelihood decides.",
    )
    least_weight: float = Field(1e-4, ge=0, le=0.1, description="Entries of T below this are dropped.")
    least_contrast: float = _least_contrast()

    @model_validator(mode="before")
    @classmethod
    def _hurry(cls, given: Any) -> Any:
        return FAST | given if isinstance(given, dict) and given.get("quality") == "fast" else given


class DgsrOptions(RecoveryOptions):
    """The paper's NN-DGSR (Sect. 4.2 and 5.1): non-negative dynamic group sparsity, filtered by oriented Gaussians."""

    method: Literal["nn-dgsr"] = "nn-dgsr"
    prior: Literal["gaussian", "none"] = Field(
        "gaussian",
        description="`gaussian` fits oriented Gaussians to the clusters of T and filters T by them (Sect. 4.2.2); "
        "`none` leaves T as the search found it.",
    )
    levels: Literal["hierarchical", "direct"] = Field(
        "hierarchical",
        description="`hierarchical` goes from grid to finer grid, with only the children of a level's cells as "
        "unknowns of the next (Sect. 4.2.3); `direct` solves the finest level at once, with all of its cells: much "
        "slower.",
    )
    channels: Literal["apart", "joint"] = Field(
        "apart",
        description="`apart` recovers a T for each channel, as in the paper; `joint` one for the three, their "
        "measurements weighed by inverse variance: for glass without dispersion.",
    )
    sparsity: float = Field(
        0.2,
        ge=0.01,
        le=1,
        description="Most cells that the search lights at the finest level, as a share of the measurements; the "
        "paper takes a fifth.",
    )
    growth: float = Field(
        1.25,
        ge=1,
        le=100,
        description="Factor by which the sparsity grows, from one cell, until more cells explain no more.",
    )
    sum_tolerance: float = Field(
        0.02,
        ge=0,
        le=1,
        description="The sparsity grows on while the L1 norm of T is further than this from one.",
    )
    least_group: float = Field(
        0.02,
        ge=0,
        le=1,
        description="A cell is refined if its weight plus half of its eight neighbours' is more than this.",
    )
    rounds: int = Field(
        10, ge=1, le=1000, description="Most rounds of lighting and pruning cells at one sparsity."
    )
    stall: float = Field(
        0.01,
        ge=0,
        le=1,
        description="Rounds, and fits of the Gaussians, end when one takes less than this share off the squared "
        "residual.",
    )
    sweeps: int = Field(
        30, ge=1, le=10_000, description="Most sweeps of coordinate descent in a least squares."
    )
    tolerance: float = Field(
        1e-4, ge=0, le=1, description="Sweeps end when one changes no entry of T by more than this."
    )
    clusters: int = Field(
        3,
        ge=1,
        le=8,
        description="Most clusters of a T that a Gaussian is fitted to; the paper finds no more than 3.",
    )
    reach: float = Field(
        3.0,
        ge=1,
        le=6,
        description="What is further than this many standard deviations from all Gaussians is taken out.",
    )
    fits: int = Field(
        8, ge=1, le=100, description="Most times that Gaussians are fitted to T and T is filtered by them."
    )
    steps: int = Field(30, ge=1, le=1000, description="Most conjugate gradients in filtering T.")
    precision: float = Field(
        0.03,
        ge=0,
        le=1,
        description="Conjugate gradients end when this share of the right-hand side is left.",
    )
    least_contrast: float = _least_contrast()


METHODS: tuple[type[RecoveryOptions], ...] = (LobesOptions, DgsrOptions)
"""The methods there are, the default first."""


def parse_options(given: dict[str, Any]) -> RecoveryOptions:
    """Options as they are sent.

    Returns
    -------
    RecoveryOptions
        Of the class of its method.

    Raises
    ------
    OptionError
        Naming the first option that does not exist, belongs to another method or is out of range.
    """
    wanted = given.get("method", _name(METHODS[0]))
    method = next((method for method in METHODS if _name(method) == wanted), None)
    if method is None:
        known = ", ".join(_name(method) for method in METHODS)
        raise OptionError(f"option 'method': must be one of {known}", field="method")
    try:
        return method.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        name = str(first["loc"][0])
        raise OptionError(_refusal(method, name), field=name) from error


def describe_options() -> list[dict[str, Any]]:
    """Every option, those of all methods first: name, method it belongs to, type, default, range, what it does."""
    kinds = " ".join(f"`{_name(method)}`: {method.__doc__}" for method in METHODS)
    choice = {
        "name": "method",
        "method": None,
        "type": "string",
        "default": _name(METHODS[0]),
        "values": [_name(method) for method in METHODS],
        "minimum": None,
        "maximum": None,
        "description": f"How T is recovered. {kinds}",
    }
    common = [name for name in RecoveryOptions.model_fields if name != "method"]
    return [
        choice,
        *(_describe(METHODS[0], name) | {"method": None} for name in common),
        *(_describe(method, name) for method in METHODS for name in _own(method)),
    ]


def _name(method: type[RecoveryOptions]) -> str:
    return str(method.model_fields["method"].default)


def _own(method: type[RecoveryOptions]) -> list[str]:
    """The options that are the method's and not every method's."""
    return [name for name in method.model_fields if name not in RecoveryOptions.model_fields]


def _describe(method: type[RecoveryOptions], name: str) -> dict[str, Any]:
    schema = method.model_json_schema()["properties"][name]
    # The value may be left out of some: the schema is then one of two, and the other is null.
    kind = next(kind for kind in schema.get("anyOf", [schema]) if kind["type"] != "null")
    return {
        "name": name,
        "method": _name(method),
        "type": kind["type"],
        "default": schema["default"],
        "values": kind.get("enum"),
        "minimum": kind.get("minimum"),
        "maximum": kind.get("maximum"),
        "description": schema["description"],
    }


def _refusal(method: type[RecoveryOptions], name: str) -> str:
    """What to say of an option that the method's class refused."""
    if name in method.model_fields:
        option = _describe(method, name)
        if option["values"]:
            return f"option {name!r}: must be one of {', '.join(option['values'])}"
        whole = "a whole number " if option["type"] == "integer" else ""
        return f"option {name!r}: must be {whole}between {option['minimum']:g} and {option['maximum']:g}"
    owners = [_name(other) for other in METHODS if name in other.model_fields]
    if owners:
        return f"option {name!r} belongs to the method {' and '.join(owners)}, not to {_name(method)}"
    known = ", ".join(method.model_fields)
    return f"there is no option {name!r}; the options of {_name(method)} are {known}"
