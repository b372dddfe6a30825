"""What every refusal of the service looks like (RFC 9457)."""

import httpx2


def check_problem(answer: httpx2.Response, status: int, slug: str) -> dict:
    """Check that an answer is a problem of a type; returns the problem."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json", answer.headers
    problem = answer.json()
    assert problem["status"] == status, problem
    assert problem["type"] == f"urn:envmatte:problem:{slug}", problem
    assert problem["title"], problem
    assert len(problem["detail"]) > 15, problem
    return problem
