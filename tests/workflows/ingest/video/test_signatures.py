"""Signatures of a video's frames take no more memory than allowed."""

import pytest

from storage.errors import CaptureError
from tests.workflows.ingest.video.camera import Film
from tests.workflows.ingest.video.films import IngestFilm


def test_more_frames_than_fit_into_memory_are_refused(ingest_film: IngestFilm, filmed: Film) -> None:
    with pytest.raises(CaptureError, match="the most that can be matched"):
        ingest_film(filmed.data, memory=1 << 20)
