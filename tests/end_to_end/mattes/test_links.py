"""Links by which people without a key see a matte."""

from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem


def test_link_shows_the_matte_and_nothing_else_until_it_is_deleted(service: Service, matte: str) -> None:
    path = f"/v1/mattes/{matte}/links"
    made = service.http.post(path, json={"days": 0.5})
    assert made.status_code == 201
    link = made.json()
    shown = service.http.get(
        link["path"], headers={"Host": "glass.example", "Origin": "https://other.example"}
    )
    assert shown.status_code == 200
    assert shown.headers["content-type"].startswith("text/html")
    assert shown.headers["cache-control"] == "private, no-store"
    assert shown.headers["content-security-policy"] == "sandbox allow-scripts; frame-ancestors 'none'"
    assert matte not in shown.text
    embedded = service.http.get(link["embed"])
    assert embedded.content == shown.content
    assert embedded.headers["content-security-policy"] == "sandbox allow-scripts; frame-ancestors *"
    assert embedded.headers["cross-origin-resource-policy"] == "cross-origin"
    (listed,) = service.http.get(path).json()["links"]
    assert listed == {name: link[name] for name in ("id", "created_at", "expires_at")}
    assert service.http.delete(f"{path}/{link['id']}").status_code == 204
    for gone in (link["path"], link["embed"]):
        problem = check_problem(service.http.get(gone), 404, "not-found")
        assert "expired or was deleted" in problem["detail"]
        shown = service.http.get(gone, headers={"Accept": "text/html,*/*;q=0.8"})
        assert (shown.status_code, shown.headers["cache-control"]) == (404, "private, no-store")
        assert "it has expired or was deleted" in shown.text
    for wrong in (0, -1, 4000, "long"):
        check_problem(service.http.post(path, json={"days": wrong}), 422, "bad-request")
    check_problem(service.http.post("/v1/mattes/none/links", json={}), 404, "not-found")


def test_client_and_command_make_a_link(service: Service, matte: str) -> None:
    url = service.client.share(matte, days=1)
    assert url.startswith(f"{service.url}/share/")
    assert service.http.get(url).status_code == 200
    done = envmatte(service, "share", matte, "--days", "2")
    assert service.http.get(done.stdout.strip()).status_code == 200, done.stderr
