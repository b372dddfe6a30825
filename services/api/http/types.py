"""Types that several routes share: parameters of lists, pairs and colours."""

from typing import Annotated

from fastapi import Query
from pydantic import Field

from workflows.untrusted.validation import Name

PageSize = Annotated[int, Query(ge=1, le=1000, description="The most items to list.")]
After = Annotated[str | None, Query(description="The id of the last item of the previous page.")]
Named = Annotated[Name | None, Query(description="What is in the name, in upper or lower case.")]
# Lists and not tuples: few generators of clients know the schema of a tuple.
Pair = Annotated[list[int], Field(min_length=2, max_length=2)]
Colour = Annotated[list[float], Field(min_length=3, max_length=3)]
