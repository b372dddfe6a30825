"""The service does what its OpenAPI document says, whatever is sent: no 5xx, no answer off its schema."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.end_to_end.conftest import Service, serving

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]

CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
    "allow_header_conformance",
    "ignored_auth",
)
"""Not whether all that fits a schema is taken: what tus wants, and what a program may be, no schema can say."""
HOOKS = """
import schemathesis

@schemathesis.serializer("application/zip", "application/octet-stream", "application/offset+octet-stream", "image/*")
def as_it_is(ctx, value):
    return value if isinstance(value, bytes) else str(value).encode()
"""
CONFIG = """
[[operations]]
include-path-regex = "/v1/{kind}/\\\\{{id\\\\}}"
exclude-method = "DELETE"
parameters = {{ id = "{id}" }}
"""


@pytest.mark.parametrize("known", [pytest.param(True, id="with a key"), pytest.param(False, id="without")])
def test_the_service_is_as_its_document_says(
    bundle: Path, tmp_path: Path, known: bool, pytestconfig: pytest.Config
) -> None:
    program = shutil.which("schemathesis", path=str(Path(sys.executable).parent))
    assert program, "schemathesis is one of the tests' requirements"
    times = int(pytestconfig.getoption("--times"))
    with serving(tmp_path / "data", "--workers", "1", ENVMATTE_KEYS="secret") as service:
        (tmp_path / "schemathesis.toml").write_text(things_of(service, bundle) if known else "")
        (tmp_path / "hooks.py").write_text(HOOKS)
        key = ["-H", "Authorization: Bearer secret"] if known else []
        done = subprocess.run(
            [
                *(program, "run", f"{service.url}/openapi.json", *key, "--checks", ",".join(CHECKS)),
                *("--phases", "coverage,fuzzing,stateful", "--max-examples", str(3 * times), "--seed", "1"),
                *(
                    "--exclude-path-regex",
                    "/events$",
                    "--generation-database",
                    "none",
                    "--request-timeout",
                    "120",
                    "--no-color",
                ),
            ],
            cwd=tmp_path,
            env=os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )
        made = re.search(r"([\d,]+) generated", done.stdout)
        print(f"schemathesis: {made[0] if made else done.stdout}")
        assert done.returncode == 0, done.stdout
        assert service.http.get("/healthz").status_code == 200
        log = (tmp_path / "data.log").read_text()
        assert "Traceback" not in log


def things_of(service: Service, bundle: Path) -> str:
    """A capture, its jobs and its matte, for calls that are about one."""
    made = service.client.upload(bundle)
    service.client.wait(made["job"])
    job = service.client.wait(service.client.recover(made["id"])["id"])
    ids = {"captures": made["id"], "jobs": job["id"], "mattes": job["matte"]}
    return "".join(CONFIG.format(kind=kind, id=id) for kind, id in ids.items())
