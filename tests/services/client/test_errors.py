"""The errors of the client: their classes, and what they hold."""

import pytest

from services import client as package
from services.client import Client, NotAllowed, NotFound, ServiceError
from tests.services.client.servers import refusal, scripted_server


@pytest.mark.parametrize(
    ("status", "kind"), [(401, NotAllowed), (403, NotAllowed), (404, NotFound), (422, ServiceError)]
)
def test_error_has_the_class_of_its_status_and_the_problem(status: int, kind: type[ServiceError]) -> None:
    with (
        scripted_server(lambda n: refusal(status)) as (url, calls),
        Client(url) as client,
        pytest.raises(ServiceError, match="why, and what to do") as caught,
    ):
        client.recover("c")
    assert type(caught.value) is kind
    assert (caught.value.status, caught.value.problem["field"], len(calls)) == (status, "f", 1)


def test_docstring_draws_the_tree_of_errors() -> None:
    kinds = [getattr(package, name) for name in package.__all__]
    names = [kind.__name__ for kind in kinds if issubclass(kind, ServiceError)]
    assert package.__doc__ is not None
    drawn = [line.split()[1] for line in package.__doc__.splitlines() if line.strip().startswith(("├", "└"))]
    assert sorted([*drawn, "ServiceError"]) == sorted(names)
    assert all(getattr(package, name).__bases__ == (ServiceError,) for name in drawn)
