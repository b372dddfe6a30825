"""The service conforms to its OpenAPI document whatever is sent: no 5xx, no response outside its schema.

Prints what it tried and the results: ``pytest -n 0 -s --times 3 tests/end_to_end/system/test_openapi.py``.
"""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from storage.database.engine import open_engine, writing
from storage.records import api_keys
from tests.end_to_end.conftest import Service, png, serving

pytestmark = pytest.mark.timeout(1800)

SECRET = "secret"
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
    "allow_header_conformance",
    "use_after_free",
    "ensure_resource_availability",
)
"""Without positive_data_acceptance: no schema can express the rules of tus and of programs."""
LOCKED = (*CHECKS, "ignored_auth")
"""With keys also that requests without a key or with a wrong one are refused."""

# No schema describes an archive or a picture, so every second call that creates something gets a valid body.
# Most guessed ids become existing ones, and existing things are never deleted.
HOOKS = """
import json
import re
from collections import Counter
from pathlib import Path

import schemathesis

HERE = Path(__file__).parent
GIVEN = json.loads((HERE / "given.json").read_text())
TUS = {"Tus-Resumable": "1.0.0", "Upload-Length": "5", "Upload-Offset": "0"}
ZIP, JSON = "application/zip", "application/json"
MAKING = {
    "POST /v1/captures": lambda n: (ZIP, (HERE / "capture.zip").read_bytes()),
    "POST /v1/jobs": lambda n: (JSON, {"capture": GIVEN["captures"]}),
    "POST /v1/mattes": lambda n: (ZIP, (HERE / "matte.zip").read_bytes()),
    "POST /v1/mattes/{id}/composite": lambda n: ("image/*", (HERE / "backdrop.png").read_bytes()),
    "POST /v1/programs": lambda n: (JSON, {"preset": "quick", "monitor": {"width": 65 + n, "height": 48}}),
}
calls = Counter()


@schemathesis.serializer(ZIP, "application/octet-stream", "application/offset+octet-stream", "image/*", "video/*")
def as_it_is(ctx, value):
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.hook
def before_call(ctx, case, kwargs):
    label, path, method = case.operation.label, case.path_parameters or {}, case.method.upper()
    n = calls[label]
    calls[label] += 1
    existing = GIVEN.get(case.operation.path.split("/")[2]) if "id" in path else None
    if existing and n % 5 != 4 and not re.fullmatch("[0-9a-f]{20}", str(path["id"])):
        path["id"] = existing
    if method == "DELETE" and path.get("id") in GIVEN.values():
        path["id"] = "gone"
    if n % 2 == 0 and label.startswith(method):
        if "/v1/uploads" in label:
            case.headers.update(TUS)
        if label in MAKING:
            case.query.clear()
            case.media_type, case.body = MAKING[label](n)
    if GIVEN["foreign"] and n % 5 == 3:
        case.headers["Origin"] = "https://elsewhere.example"


@schemathesis.hook
def after_call(ctx, case, response):
    with (HERE / "answers").open("a") as file:
        print(case.method.upper(), case.operation.path, response.status_code, file=file)
"""
MAKING = {
    "POST /v1/captures": 201,
    "POST /v1/jobs": 202,
    "POST /v1/mattes": 201,
    "POST /v1/mattes/{id}/composite": 200,
    "POST /v1/programs": 201,
    "POST /v1/uploads": 201,
}
"""Calls that create something, and their status. An empty service would reveal little."""


def things_of(service: Service, capture_archive: Path, folder: Path) -> dict[str, str]:
    """Create one of each; returns their ids, and writes bodies for calls that create more."""
    made = service.client.upload(capture_archive)
    service.client.wait(made["job"])
    job = service.client.wait(service.client.recover(made["id"])["id"])
    body = {"preset": "quick", "monitor": {"width": 64, "height": 48}}
    bearer = {"Authorization": f"Bearer {SECRET}"}
    program = service.http.post("/v1/programs", json=body, headers=bearer).json()
    shutil.copy(capture_archive, folder / "capture.zip")
    service.client.export(job["matte"], folder / "matte.zip")
    (folder / "backdrop.png").write_bytes(png(np.full((9, 12, 3), 0.5), "srgb", np.uint8))
    return {"captures": made["id"], "jobs": job["id"], "mattes": job["matte"], "programs": program["id"]}


def tried(
    service: Service,
    capture_archive: Path,
    folder: Path,
    key: str | None,
    checks: tuple[str, ...],
    *options: str,
) -> Counter[str]:
    """Run schemathesis against a service; counts the responses by call and status."""
    program = shutil.which("schemathesis", path=str(Path(sys.executable).parent))
    assert program, "schemathesis is one of the tests' requirements"
    ids = things_of(service, capture_archive, folder)
    is_foreign = "ignored_auth" not in checks
    (folder / "given.json").write_text(json.dumps(ids | {"foreign": is_foreign}))
    (folder / "hooks.py").write_text(HOOKS)
    header = ["-H", f"Authorization: Bearer {key}"] if key else []
    command = f"run {service.url}/openapi.json --seed 1 --generation-database none --no-color"
    command += " --request-timeout 120 --report json --report-json-path report.json"
    command += " --exclude-path-regex /events$"  # some never end
    command += " --suppress-health-check too_slow"  # on a busy machine, making up requests takes long
    done = subprocess.run(
        [program, *command.split(), *header, "--checks", ",".join(checks), *options],
        cwd=folder,
        env=os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    answers = Counter((folder / "answers").read_text().splitlines())
    report = json.loads((folder / "report.json").read_text())
    statuses = Counter(line.rsplit(" ", 1)[1] for line in answers.elements())
    print(
        f"\nschemathesis: {answers.total()} requests of {report['operations']['tested']} operations, "
        f"{report['test_cases']['unique_failures']} failures; "
        f"answers: {dict(sorted(statuses.items()))}"
    )
    assert done.returncode == 0, done.stdout
    assert not {status for status in statuses if status.startswith("5")}
    assert service.http.get("/healthz").status_code == 200
    assert "Traceback" not in (service.data.parent / f"{service.data.name}.log").read_text()
    return answers


def made_in(answers: Counter[str]) -> set[str]:
    return {call for call, status in MAKING.items() if answers[f"{call} {status}"]}


@pytest.mark.slow
def test_a_few_calls_of_each_route(capture_archive: Path, tmp_path: Path) -> None:
    """The same few calls in every run."""
    with serving(tmp_path / "data", "--workers", "1", ENVMATTE_KEYS=SECRET) as service:
        few = ("--phases", "fuzzing,stateful", "--max-examples", "3")
        answers = tried(service, capture_archive, tmp_path, SECRET, LOCKED, *few)
    assert made_in(answers) == set(MAKING)


@pytest.mark.exhaustive
@pytest.mark.parametrize("who", ["a key", "a key to look with", "no key", "a service without keys"])
def test_service_conforms_to_its_openapi_document(
    capture_archive: Path, tmp_path: Path, who: str, pytestconfig: pytest.Config
) -> None:
    examples = str(3 * int(pytestconfig.getoption("--times")))
    is_open = who == "a service without keys"
    key = {"a key": SECRET, "a key to look with": "to be made"}.get(who)
    with serving(tmp_path / "data", "--workers", "1", ENVMATTE_KEYS="" if is_open else SECRET) as service:
        if who == "a key to look with":
            engine = open_engine(f"sqlite:///{service.data}/envmatte.db")
            with writing(engine) as c:
                key = api_keys.create(c, "look", "default", "read")
            engine.dispose()
        checks = CHECKS if is_open else LOCKED
        options = ("--phases", "coverage,fuzzing,stateful", "--max-examples", examples)
        answers = tried(service, capture_archive, tmp_path, key, checks, *options)
    statuses = {line.rsplit(" ", 1)[1] for line in answers}
    assert made_in(answers) == (set(MAKING) if is_open or who == "a key" else set())
    assert ("401" in statuses) == (who != "a service without keys")
    assert ("403" in statuses) == (who in ("a key to look with", "a service without keys"))
    assert any(line.startswith("GET /v1/mattes/{id} ") and line.endswith("200") for line in answers) == (
        who != "no key"
    )
