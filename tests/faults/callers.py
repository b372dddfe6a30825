"""Callers that ask a service for the same paths again and again, in a process of their own until its stdin is closed.

``python -m tests.faults.callers NETLOC KEY COUNT PATH...`` prints how many answers had which status, as JSON.
"""

import http.client
import json
import os
import sys
import threading
from collections import Counter

PATIENCE = 30.0
"""Seconds that a caller waits for an answer."""
PIECE = 1 << 18


def call(netloc: str, key: str, paths: list[str], first: int, answers: Counter[str]) -> None:
    """Ask for one path after another, each on a new connection, without end."""
    number = first
    while True:
        connection = http.client.HTTPConnection(netloc, timeout=PATIENCE)
        try:
            path = paths[number % len(paths)]
            connection.request("GET", path, headers={"Authorization": f"Bearer {key}"})
            answer = connection.getresponse()
            while answer.read(PIECE):
                pass
            answers[str(answer.status)] += 1
        except (OSError, http.client.HTTPException) as error:
            answers[type(error).__name__] += 1
        finally:
            connection.close()
        number += 1


def main(netloc: str, key: str, count: str, *paths: str) -> None:
    answers: Counter[str] = Counter()
    for first in range(int(count)):
        threading.Thread(target=call, args=(netloc, key, list(paths), first, answers), daemon=True).start()
    print("calling", flush=True)
    sys.stdin.read()
    print(json.dumps(answers), flush=True)
    os._exit(0)  # whatever the callers are doing


if __name__ == "__main__":
    main(*sys.argv[1:])
