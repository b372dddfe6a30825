"""Callers that make the same calls again and again, in a process of their own until its stdin is closed.

``python -m tests.parts.callers NETLOC KEY COUNT BODY CALL...`` prints how many answers had which status, as JSON. A
call is a method, a path and the fields of a JSON body, such as ``PATCH /v1/mattes/1 name=glass``; without fields a POST
sends the contents of the file BODY. They are nice, because real callers take no cores of the service's.
"""

import http.client
import json
import os
import sys
import threading
from collections import Counter
from pathlib import Path

PATIENCE = 30.0
"""Seconds that a caller waits for an answer."""
PIECE = 1 << 18
NICE = 19


def repeat(netloc: str, key: str, body: bytes, calls: list[str], first: int, answers: Counter[str]) -> None:
    """Make one call after another, each on a new connection, without end."""
    number = first
    while True:
        connection = http.client.HTTPConnection(netloc, timeout=PATIENCE)
        try:
            method, path, *fields = calls[number % len(calls)].split()
            headers = {"Authorization": f"Bearer {key}"}
            content = body if method == "POST" else None
            if fields:
                content = json.dumps(dict(field.split("=") for field in fields)).encode()
            connection.request(method, path, content, headers)
            answer = connection.getresponse()
            while answer.read(PIECE):
                pass
            answers[str(answer.status)] += 1
        except (OSError, http.client.HTTPException) as error:
            answers[type(error).__name__] += 1
        finally:
            connection.close()
        number += 1


def main(netloc: str, key: str, count: str, body: str, *calls: str) -> None:
    os.nice(NICE)
    answers: Counter[str] = Counter()
    for first in range(int(count)):
        args = netloc, key, Path(body).read_bytes(), list(calls), first, answers
        threading.Thread(target=repeat, args=args, daemon=True).start()
    print("calling", flush=True)
    sys.stdin.read()
    print(json.dumps(answers), flush=True)
    os._exit(0)  # whatever the callers are doing


if __name__ == "__main__":
    main(*sys.argv[1:])
