"""How the options of a recovery method are declared: a named tuple that says all there is to say about each of them.

A field is ``name: Annotated[type, Range(least, most), "What it does."] = default``. A choice is a `Literal` of strings
and has no range. Kernels take such a tuple whole, as long as it holds only numbers: a method with choices nests the
numbers in a tuple of their own.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar, get_args, get_type_hints

Options = TypeVar("Options", bound=tuple[Any, ...])


class Range(NamedTuple):
    """The least and the greatest value of a number."""

    least: float
    most: float


class Option(NamedTuple):
    """What a field declares.

    Attributes
    ----------
    name : str
    type : type
        `int`, `float`, or a `Literal` of strings.
    default : int, float or str
    range : Range or None
        None of a choice.
    description : str
    """

    name: str
    type: Any
    default: Any
    range: Range | None
    description: str


def declared_options(kind: type[tuple[Any, ...]]) -> Iterator[Option]:
    """The options that a named tuple declares, in order, with those of the tuples nested in it.

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
    """The named tuple with the given values of options, nested ones too, and defaults for the others.

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
