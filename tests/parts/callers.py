"""Callers that ask a service for the same paths again and again, in a process of their own until its stdin is closed.

``python -m tests.parts.callers NETLOC KEY COUNT BODY PATH...`` prints how many answers had which status, as JSON. A
path of a composite is asked for with the contents of the file BODY. They are nice, because real callers take no cores
of the service's.
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


def call(netloc: str, key: str, body: bytes, paths: list[str], first: int, answers: Counter[str]) -> None:
    """Ask for one path after another, each on a new connection, without end."""
    number = first
    while True:
        connection = http.client.HTTPConnection(netloc, timeout=PATIENCE)
        try:
            path = paths[number % len(paths)]
            headers = {"Authorization": f"Bearer {key}"}
            if path.endswith("/composite"):
                connection.request("POST", path, body, headers)
            else:
                connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            while answer.read(PIECE):
                pass
            answers[str(answer.status)] += 1
        except (OSError, http.client.HTTPException) as error:
            answers[type(error).__name__] += 1
        finally:
            connection.close()
        number += 1


def main(netloc: str, key: str, count: str, body: str, *paths: str) -> None:
    os.nice(NICE)
    answers: Counter[str] = Counter()
    for first in range(int(count)):
        args = netloc, key, Path(body).read_bytes(), list(paths), first, answers
        threading.Thread(target=call, args=args, daemon=True).start()
    print("calling", flush=True)
    sys.stdin.read()
    print(json.dumps(answers), flush=True)
    os._exit(0)  # whatever the callers are doing


if __name__ == "__main__":
    main(*sys.argv[1:])
