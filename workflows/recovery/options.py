"""Declaration of a recovery method's options, as a named tuple with a type, range, default and description for each.

A field is ``name: Annotated[type, Range(least, most), "What it does."] = default``. A choice is a `Literal` of strings
and has no range. Kernels take such a tuple as an argument if it holds only numbers, so a method with choices nests the
numbers in another named tuple.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar, get_args, get_type_hints

Options = TypeVar("Options", bound=tuple[Any, ...])


class Range(NamedTuple):
    """The least and the greatest allowed value of a number."""

    least: float
    most: float


class Option(NamedTuple):
    """The declaration of an option.

    Attributes
    ----------
    name : str
    type : type
        `int`, `float`, or a `Literal` of strings.
    default : int, float or str
    range : Range or None
        None for a choice.
    description : str
    """

    name: str
    type: Any
    default: Any
    range: Range | None
    description: str


def declared_options(kind: type[tuple[Any, ...]]) -> Iterator[Option]:
    """Iterate over the options that a named tuple declares, including those of nested tuples.

    Examples
    --------
    >>> from typing import Annotated
    >>> class Example(NamedTuple):
    ...     steps: Annotated[int, Range(1, 100), "Most steps."] = 9
    >>> next(declared_options(Example))
    Option(name='steps', type=<class 'int'>, default=9, range=Range(least=1, most=100), description='Most steps.')
    """
    for name, declared, default in _fields(kind):
        if isinstance(default, tuple):
            yield from declared_options(type(default))
        else:
            annotated, *limits, description = get_args(declared)
            yield Option(name, annotated, default, limits[0] if limits else None, description)


def make_options(kind: type[Options], values: Mapping[str, Any]) -> Options:
    """Make a named tuple, nested ones included, with the given values of options and defaults for the others.

    Examples
    --------
    >>> from workflows.recovery.dgsr.options import DgsrOptions
    >>> options = make_options(DgsrOptions, {"prior": "none", "clusters": 2})
    >>> options.prior, options.constants.clusters
    ('none', 2)
    """
    return kind(
        *(
            make_options(type(default), values) if isinstance(default, tuple) else values.get(name, default)
            for name, _, default in _fields(kind)
        )
    )


def _fields(kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """Name, annotation and default of each field."""
    for name, declared in get_type_hints(kind, include_extras=True).items():
        yield name, declared, kind._field_defaults[name]
