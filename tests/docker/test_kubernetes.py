"""kubernetes.yaml without Kubernetes: its objects match the schemas of the API, its commands run as processes."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
import kubernetes_validate
import pytest
import yaml

from services.runtime.certificates import make
from services.settings import Settings
from tests.parts.waiting import until
from tests.services.cluster.clusters import address, started
from workflows.untrusted.decoder import room

FOLDER = Path(__file__).parents[2] / "docker"
MANIFEST = FOLDER / "kubernetes.yaml"
OLDEST = "1.25"
TEXT = MANIFEST.read_text()
OBJECTS: list[dict[str, Any]] = list(yaml.safe_load_all(TEXT))
SECRETS = {  # keys by secret, from the commands at the head of the file
    name: re.findall(r"--from-literal=(\w+)", rest)
    for name, rest in re.findall(r"create secret generic (\S+)((?:.*\\\n)*.*)", TEXT)
}
KEY = "a-key-of-the-test"


def object_of(kind: str, name: str) -> dict[str, Any]:
    (found,) = [one for one in OBJECTS if (one["kind"], one["metadata"]["name"]) == (kind, name)]
    return found


def pod(name: str) -> dict[str, Any]:
    spec: dict[str, Any] = object_of("Deployment", name)["spec"]["template"]["spec"]
    return spec


def container(name: str) -> dict[str, Any]:
    (only,) = pod(name)["containers"]
    return only


DEPLOYMENTS = [one["metadata"]["name"] for one in OBJECTS if one["kind"] == "Deployment"]


def environment(name: str) -> dict[str, str]:
    """The environment of a container; secrets are empty."""
    found: dict[str, str] = {}
    for source in container(name)["envFrom"]:
        if "configMapRef" in source:
            found |= object_of("ConfigMap", source["configMapRef"]["name"])["data"]
        else:
            found |= {variable: "" for variable in SECRETS[source["secretRef"]["name"]]}
    return found | {one["name"]: one["value"] for one in container(name).get("env", [])}


@pytest.mark.parametrize("version", [OLDEST, kubernetes_validate.latest_version()])
@pytest.mark.parametrize("object", OBJECTS, ids=lambda one: f"{one['kind']}-{one['metadata']['name']}")
def test_objects_match_the_schemas_of_kubernetes(object: dict[str, Any], version: str) -> None:
    kubernetes_validate.validate(object, version, strict=True)


def test_every_name_refers_to_an_object() -> None:
    for name in DEPLOYMENTS:
        deployment, spec = object_of("Deployment", name)["spec"], pod(name)
        assert deployment["selector"]["matchLabels"] == deployment["template"]["metadata"]["labels"]
        volumes = {volume["name"]: volume for volume in spec["volumes"]}
        assert {mount["name"] for mount in container(name)["volumeMounts"]} == set(volumes)
        assert volumes["certs"]["secret"]["secretName"] in SECRETS
    for service in (one for one in OBJECTS if one["kind"] == "Service"):
        (port,) = service["spec"]["ports"]
        (served,) = [
            name
            for name in DEPLOYMENTS
            if object_of("Deployment", name)["spec"]["selector"]["matchLabels"] == service["spec"]["selector"]
        ]
        assert port["targetPort"] in [one["name"] for one in container(served)["ports"]]
    scaled = object_of("HorizontalPodAutoscaler", "envmatte-worker")["spec"]["scaleTargetRef"]["name"]
    assert "cpu" in container(scaled)["resources"]["requests"]  # utilisation is relative to the request
    # Otherwise every `kubectl apply` would reset it.
    assert "replicas" not in object_of("Deployment", scaled)["spec"]


def test_only_the_port_of_the_api_is_open_to_others() -> None:
    api, cluster = (object_of("NetworkPolicy", name)["spec"] for name in ("envmatte", "envmatte-cluster"))
    assert (
        api["podSelector"]["matchLabels"]
        == object_of("Deployment", "envmatte")["spec"]["selector"]["matchLabels"]
    )
    assert api["ingress"] == [{"ports": [{"port": "http"}]}]
    (selected,) = cluster["podSelector"]["matchExpressions"]
    assert {"envmatte", *selected["values"]} == set(DEPLOYMENTS)
    ((allowed,),) = (rule["from"] for rule in cluster["ingress"])
    assert set(allowed["podSelector"]["matchExpressions"][0]["values"]) == set(DEPLOYMENTS)


def test_every_variable_is_a_setting() -> None:
    known = {f"ENVMATTE_{name.upper()}" for name in Settings.model_fields}
    for name in DEPLOYMENTS:
        ours = {variable for variable in environment(name) if variable.startswith("ENVMATTE_")}
        assert ours <= known
        # Otherwise Kubernetes sets variables named after Services, such as ENVMATTE_PORT=tcp://…
        assert pod(name)["enableServiceLinks"] is False


def test_addresses_and_ports_match_the_processes() -> None:
    cluster = urlsplit(environment("envmatte-worker")["ENVMATTE_CLUSTER"])
    (port,) = object_of("Service", str(cluster.hostname))["spec"]["ports"]
    assert port["port"] == cluster.port
    shown = subprocess.run(
        [sys.executable, "-m", "services", "scheduler", "--help"], capture_output=True, text=True, check=True
    ).stdout
    (scheduler,) = container("envmatte-scheduler")["ports"]
    assert f"[default: {scheduler['containerPort']}]" in re.sub(r"\s+", " ", shown)
    (served,) = container("envmatte")["ports"]
    assert served["containerPort"] == Settings.model_fields["port"].default


def test_pods_run_unprivileged_and_get_only_their_secrets() -> None:
    for name in DEPLOYMENTS:
        spec = pod(name)
        assert spec["automountServiceAccountToken"] is False
        assert spec["securityContext"]["runAsNonRoot"] is True
        assert f"USER {spec['securityContext']['runAsUser']}:" in MANIFEST.with_name("Dockerfile").read_text()
        assert container(name)["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
    assert not {"ENVMATTE_KEYS", "ENVMATTE_DATABASE"} & set(environment("envmatte-worker"))
    assert not set(SECRETS["envmatte-store"]) & set(environment("envmatte-scheduler"))


@pytest.mark.parametrize("name", ["envmatte", "envmatte-worker"])
def test_pods_with_kernels_begin_with_those_of_the_image(name: str) -> None:
    (first,) = pod(name)["initContainers"]
    cache = re.search(r"NUMBA_CACHE_DIR=(\S+)", MANIFEST.with_name("Dockerfile").read_text())
    assert cache is not None
    (target,) = first["volumeMounts"]
    assert first["command"] == ["cp", "-R", f"{cache[1]}/.", target["mountPath"]]
    assert target | {"mountPath": cache[1]} in container(name)["volumeMounts"]
    assert first["image"] == container(name)["image"]
    assert first["securityContext"] == container(name)["securityContext"]


def test_worker_reaches_its_own_memory_limit_before_that_of_its_container(tmp_path: Path) -> None:
    of_pod = container("envmatte-worker")["resources"]["limits"]["memory"].removesuffix("Gi")
    worker = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]["worker"]
    own, whole = (
        text.partition(":-")[2].removesuffix("}")
        for text in (worker["environment"]["ENVMATTE_WORKER_MEMORY"], worker["mem_limit"])
    )
    decoder = room(Settings(data=tmp_path).limits.image_bytes)
    for limit, memory in (
        (of_pod, environment("envmatte-worker")["ENVMATTE_WORKER_MEMORY"]),
        (whole.removesuffix("g"), own),
    ):
        assert 0.95 * int(memory) < (int(limit) << 30) - decoder - (200 << 20)


@pytest.mark.slow
def test_commands_start_a_cluster_and_probes_pass(tmp_path: Path) -> None:
    certs = tmp_path / "certs"
    make(certs)

    def local_environment(name: str) -> dict[str, str]:
        """The environment of a container, with addresses and folders of this machine."""
        local = {
            "ENVMATTE_CERTS": str(certs),
            "ENVMATTE_CLUSTER": cluster,
            "ENVMATTE_DATABASE": f"sqlite:///{tmp_path / 'envmatte.db'}",
            "ENVMATTE_STORE": (tmp_path / "store").as_uri(),
            "ENVMATTE_KEYS": KEY,
        }
        return {variable: local.get(variable, value) for variable, value in environment(name).items()}

    cluster = "tls://127.0.0.1:1"
    command = [*container("envmatte-scheduler")["args"], "--port", "0"]
    with started(
        tmp_path / "scheduler.log", *command, **local_environment("envmatte-scheduler")
    ) as scheduler:
        port = address(scheduler).rsplit(":", 1)[1]
        cluster = f"tls://127.0.0.1:{port}"
        probe = container("envmatte-scheduler")["livenessProbe"]["exec"]["command"]
        code = probe[2].replace("/certs", str(certs)).replace("8786", port)
        subprocess.run([sys.executable, *probe[1:2], code], check=True)
        assert "handshake" not in (tmp_path / "scheduler.log").read_text()
        serve = [*container("envmatte")["args"], "--port", "0"]
        with (
            started(tmp_path / "api.log", *serve, **local_environment("envmatte")) as api,
            started(
                tmp_path / "worker.log",
                *container("envmatte-worker")["args"],
                **local_environment("envmatte-worker"),
            ),
        ):
            assert api.stdout is not None
            url = f"http://127.0.0.1:{api.stdout.readline().rsplit(':', 1)[1].strip()}"
            for kind in ("startupProbe", "readinessProbe", "livenessProbe"):
                path = container("envmatte")[kind]["httpGet"]["path"]
                assert httpx2.get(url + path).status_code == 200

            def workers() -> list[dict[str, Any]]:
                answer = httpx2.get(f"{url}/v1/cluster", headers={"Authorization": f"Bearer {KEY}"})
                found: list[dict[str, Any]] = answer.json()["workers"]
                return found

            until(workers)
            limit = int(environment("envmatte-worker")["ENVMATTE_WORKER_MEMORY"])
            assert [one["memory_limit_bytes"] for one in workers()] == [limit]
            until(lambda: httpx2.get(f"{url}/readyz").status_code == 200)
