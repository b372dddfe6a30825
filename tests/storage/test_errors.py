"""The error tree: errors are pickled between processes with their fields."""

import pickle

import pytest

from storage import errors


@pytest.mark.parametrize(
    "kind",
    [
        errors.CaptureError,
        errors.ImageError,
        errors.OptionError,
        errors.NotFound,
        errors.Conflict,
        errors.Unavailable,
        errors.StoreUnavailable,
        errors.Corrupt,
    ],
)
def test_error_survives_pickling(kind: type[errors.EnvmatteError]) -> None:
    error = kind("a frame is cut off; send it again", entry="frames/1.png", limit=7)
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is kind
    assert back.detail == str(back) == "a frame is cut off; send it again"
    assert back.fields == {"entry": "frames/1.png", "limit": 7}


def test_invalid_input_is_separate_from_other_errors() -> None:
    for kind in (errors.CaptureError, errors.ImageError, errors.OptionError):
        assert issubclass(kind, errors.InvalidInput)
    for other in (errors.NotFound, errors.Conflict, errors.Corrupt):
        assert issubclass(other, errors.EnvmatteError)
        assert not issubclass(other, errors.InvalidInput)
