"""Archives of mattes with flipped bytes and cut ends: refused with nothing left, or harmless."""

import io

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from storage.errors import ArchiveError
from storage.layout.matte_archive import MANIFEST, Archive
from storage.objects.store import Objects
from tests.workflows.mattes.imports.conftest import LIMITS, signed, unpacked
from workflows.composite import composite
from workflows.mattes.imports.importing import take_in

BACKDROP = np.linspace(0, 1, 5 * 40 * 3, dtype=np.float32).reshape(5, 40, 3)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_archive_is_refused_or_the_same(
    objects: Objects, archive: bytes, data: st.DataObject
) -> None:
    damaged = bytearray(archive)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged))) :]
    try:
        take_in(io.BytesIO(bytes(damaged)), objects, "n", LIMITS)
    except ArchiveError:
        assert objects.paths_below("mattes/n") == set()
    else:  # what was damaged is nothing of the matte: a date, say
        assert b"".join(Archive(objects, "n")) == archive
        objects.delete("mattes/n")


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_with_a_valid_checksum_is_refused_or_harmless(
    objects: Objects, archive: bytes, data: st.DataObject
) -> None:
    files = unpacked(archive)
    name = data.draw(st.sampled_from(sorted(files)))
    damaged = bytearray(files[name])
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        take_in(io.BytesIO(signed(files | {name: bytes(damaged)})), objects, "n", LIMITS)
    except (ArchiveError, ValueError) as error:
        if isinstance(error, ValueError):  # of `signed`, which reads the manifest
            assert name == MANIFEST
        assert objects.paths_below("mattes/n") == set()
    else:
        np.isfinite(
            composite(take_in(io.BytesIO(b"".join(Archive(objects, "n"))), objects, "o", LIMITS), BACKDROP)
        )
        objects.delete("mattes/n")
        objects.delete("mattes/o")
