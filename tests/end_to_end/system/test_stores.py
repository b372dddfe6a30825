"""A cluster on a bucket makes the same bytes as a single machine on a folder."""

from pathlib import Path

import pytest

from services.runtime import certificates
from storage.objects.store import Objects
from tests.end_to_end.conftest import Service, digests, serving
from tests.parts.rig import stored
from tests.services.cluster.clusters import address, started


@pytest.mark.exhaustive
@pytest.mark.slow
def test_matte_is_the_same_in_a_bucket_and_in_a_folder(
    service: Service, matte: str, capture_archive: Path, s3: str, tmp_path: Path
) -> None:
    folder = tmp_path / "certs"
    certificates.make(folder)
    log = tmp_path / "log"
    with started(log, "scheduler", "--port", "0", "--certs", str(folder)) as scheduler:
        at = address(scheduler)
        named = ("--cluster", at, "--certs", str(folder))
        with (
            started(log, "worker", *named, "--workers", "2"),
            serving(tmp_path / "data", *named, "--store", s3) as remote,
        ):
            uploaded = remote.client.upload(capture_archive)
            remote.client.wait(uploaded["job"])
            made = remote.client.wait(remote.client.recover(uploaded["id"])["id"])["matte"]
            objects = Objects(s3)
            in_bucket = stored(objects, f"mattes/{made}")
            assert in_bucket == digests(service.data / "store" / "mattes" / matte)
            assert objects.names("uploads") == []
            assert not (tmp_path / "data" / "store").exists()
            assert remote.http.delete(f"/v1/mattes/{made}").status_code == 204
            assert made not in objects.names("mattes")
