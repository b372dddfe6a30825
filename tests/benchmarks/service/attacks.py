"""How long others wait while one owner asks forty times at once for what costs most, before a version and now.

    python -m tests.benchmarks.service.attacks --before PATH [--seconds 10]

PATH is a checkout of an earlier version with a virtual environment ``.venv`` of its own, such as

    git worktree add PATH COMMIT && cd PATH && python3 -m venv .venv && .venv/bin/pip install -c requirements.lock -e .

Each attack is made on the earlier version and on this one in turn, each time on a service that has just been started.
Meanwhile another owner asks for ``/healthz`` and for a composite, one after the other, and gives each up after ten
seconds. Printed are the median and the 99th percentile of both, and how many were answered. Run it from the root of the
repository.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import psutil
from numpy.typing import NDArray

from tests.end_to_end.conftest import Service, serving
from tests.faults.test_attacks import ATTACKS, MATTES, ZIP, Attacked, bearer, large_program, under_attack
from tests.parts.captures import captured, nested_program, zip_bytes
from tests.parts.inputs.hostile_mattes import hostile_archive
from tests.parts.waiting import until
from workflows.images.integer_formats import encode_png

PATIENCE = 10.0
"""Seconds after which the other owner gives a request up."""
FRAME = 4000
"""Edge of a square frame: 16 megapixels."""
LARGE_PROGRAMS = 60
"""Captures with a large program."""
MADE = {
    name: call
    for name, call in ATTACKS.items()
    if call.startswith("GET ") and any(f"{{{one}}}" in call for one in MATTES)
} | {
    "frames of 16 megapixels": ATTACKS["frames of 81 megapixels"],
    f"lists of {LARGE_PROGRAMS} large programs": ATTACKS["lists of large programs"],
}
"""The calls of attacks that need nothing but uploads, which an earlier version takes too, by what they ask for."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=10)
    args = parser.parse_args()
    before = args.before.resolve()
    versions = {
        "before": ("env", "-C", str(before), str(before / ".venv/bin/python")),
        "now": (sys.executable,),
    }
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        archives = {
            name: hostile_archive(folder / name, **costs)  # type: ignore[arg-type]
            for name, costs in MATTES.items()
        }
        archives["own"] = hostile_archive(folder / "own", cells=20, columns=64, rows=48, edge=16)
        captures = {
            "frames": large_frames(),
            **{f"program {n}": large_capture() for n in range(LARGE_PROGRAMS)},
        }
        (folder / "backdrop.png").write_bytes(encode_png(np.zeros((48, 64, 3), np.uint8)))
        prepared = {
            version: prepare(folder, version, command, archives, captures)
            for version, command in versions.items()
        }
        print("| forty callers of | | `/healthz` | a composite | answered |\n|---|---|---|---|---|")
        for attack in MADE:
            for version, command in versions.items():
                with started(folder / version, command) as service:
                    keys, ids = prepared[version]
                    attacked = Attacked(service, keys, ids, ids["own"], folder / "backdrop.png")
                    print(f"| {attack} | {version} | {measure(attacked, attack, args.seconds)} |", flush=True)


def large_frames() -> bytes:
    """A capture of few frames, the first of noise: a PNG of it is as large as it is."""
    rng = np.random.default_rng(0)

    def see(number: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        shape = FRAME, FRAME, 1
        return rng.random(shape, np.float32) if number == 0 else np.full(shape, number / 4, np.float32)

    return captured(nested_program((64, 48), bands=((2, 2, 1),), levels=2), see)


def large_capture() -> bytes:
    """A capture with a large program, which its film does not fit: it stays as it is listed."""
    manifest = {
        "format": "envmatte-capture/1",
        "program": large_program().model_dump(mode="json"),
        "video": {"file": "film.mp4", "patterns_per_second": 2},
        "response": "linear",
    }
    return zip_bytes({"capture.json": json.dumps(manifest).encode(), "film.mp4": b"no film"})


def prepare(
    folder: Path,
    version: str,
    command: Sequence[str],
    archives: dict[str, bytes],
    captures: dict[str, bytes],
) -> tuple[dict[str, str], dict[str, str]]:
    """Make keys, import mattes and ingest captures; returns the keys by owner, and the ids by what they cost."""
    keys = {owner: make_key(command, folder / version, owner) for owner in ("alice", "mallory")}
    with started(folder / version, command) as service:

        def send(route: str, name: str, archive: bytes) -> str:
            headers = ZIP | bearer(keys["alice" if name == "own" else "mallory"])
            sent = httpx2.post(f"{service.url}/v1/{route}", content=archive, headers=headers, timeout=300)
            return str(sent.raise_for_status().json()["id"])

        def is_ingesting(capture: str) -> bool:
            headers = bearer(keys["mallory"])
            found = httpx2.get(f"{service.url}/v1/captures/{capture}", headers=headers, timeout=300)
            return bool(found.raise_for_status().json()["state"] == "ingesting")

        ids = {name: send("mattes", name, archive) for name, archive in archives.items()}
        sent = {name: send("captures", name, archive) for name, archive in captures.items()}
        for capture in sent.values():
            until(lambda capture=capture: not is_ingesting(capture), 600)  # type: ignore[misc]
        ids["frames"] = sent["frames"]
    return keys | {"mallory reads": keys["mallory"]}, ids


def make_key(command: Sequence[str], data: Path, owner: str) -> str:
    make = [*command, "-m", "services", "keys", "make", owner, "--owner", owner, "--data", str(data)]
    return subprocess.run(make, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


@contextmanager
def started(data: Path, command: Sequence[str]) -> Iterator[Service]:
    """A service that is killed at the end: an earlier version may not end when it is asked to."""
    with serving(data, "--workers", "1", within=command) as service:
        try:
            yield service
        finally:
            for process in psutil.Process(service.process.pid).children(recursive=True):
                process.kill()
            service.kill()


def measure(attacked: Attacked, attack: str, seconds: float) -> str:
    """The cells of a row: the seconds of both calls, and how many were answered."""
    took: dict[str, list[float]] = {"healthz": [], "composite": []}
    composite(attacked, 600)  # compiles and reads what it needs
    with under_attack(attacked, MADE[attack]):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for name, seconds_of in took.items():
                began = time.monotonic()
                try:
                    composite(attacked) if name == "composite" else healthz(attacked)
                except httpx2.TimeoutException:
                    seconds_of.append(np.inf)
                else:
                    seconds_of.append(time.monotonic() - began)
    cells = [f"{percentile(one, 50)}, {percentile(one, 99)}" for one in took.values()]
    every = [one for of_call in took.values() for one in of_call]
    return " | ".join([*cells, f"{sum(np.isfinite(every))} of {len(every)}"])


def percentile(seconds: Sequence[float], share: float) -> str:
    found = float(np.percentile(seconds, share, method="higher"))
    return f"{found:.2f} s" if np.isfinite(found) else "none"


def healthz(attacked: Attacked) -> None:
    httpx2.get(f"{attacked.service.url}/healthz", timeout=PATIENCE).raise_for_status()


def composite(attacked: Attacked, patience: float = PATIENCE) -> None:
    """Ask for a composite as the owner who does not attack."""
    httpx2.post(
        f"{attacked.service.url}/v1/mattes/{attacked.own}/composite",
        content=attacked.backdrop.read_bytes(),
        headers=bearer(attacked.keys["alice"]),
        timeout=patience,
    ).raise_for_status()


if __name__ == "__main__":
    os.environ.setdefault("ENVMATTE_MATTE_MEMORY", str(128 << 20))
    main()
