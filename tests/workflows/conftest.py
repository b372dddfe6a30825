"""A store in a folder, and captures ingested into it, for the tests of workflows."""

import asyncio
import hashlib
import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from storage.layout import captures, uploads
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.parts.captures import zip_bytes
from tests.parts.inputs.dngs import dng
from workflows.ingest import steps as ingest_steps
from workflows.jobs import Task
from workflows.untrusted.limits import Limits

Zip = Callable[..., bytes]
Ingest = Callable[..., Stack]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def objects(folder: Path) -> Objects:
    return Objects(folder.as_uri())


@pytest.fixture(scope="session")
def make_zip() -> Zip:
    """Makes a capture archive of a capture.json and files."""

    def make(
        manifest: dict[str, Any] | bytes | None, files: dict[str, bytes], pack: int = zipfile.ZIP_STORED
    ) -> bytes:
        text = manifest if isinstance(manifest, bytes) else json.dumps(manifest).encode()
        return zip_bytes({**({} if manifest is None else {"capture.json": text}), **files}, pack)

    return make


@pytest.fixture
def put(objects: Objects) -> Callable[[str, bytes], None]:
    """Stores a capture's archive where ingest finds it."""

    def store(capture: str, data: bytes) -> None:
        async def stream() -> None:
            async with objects.write(uploads.part_path(capture, "all")) as writer:
                await writer.write(data)

        asyncio.run(stream())
        uploads.seal(objects, capture, [uploads.Part("all", len(data))])

    return store


@pytest.fixture
def ingest(objects: Objects, put: Callable[[str, bytes], None]) -> Ingest:
    """Ingests an archive, its slabs in the order that is asked for."""

    def run(
        capture: str,
        data: bytes,
        memory: int = 1 << 26,
        order: Callable[[range], Iterator[int]] = iter,  # type: ignore[assignment]
        unpacked: int = 1 << 30,
    ) -> Stack:
        objects.delete(captures.path(capture))  # nothing of an earlier one
        put(capture, data)
        task = Task("j", capture, "", {}, Limits(unpacked=unpacked, memory=memory))
        task = replace(task, plan=ingest_steps.prepare(objects, task))
        for tile in order(range(task.plan["tiles"])):
            ingest_steps.work(objects, task, tile)
        ingest_steps.finish(objects, task)
        return Stack(objects, capture)

    return run


@pytest.fixture(scope="session")
def make_dng() -> Callable[..., bytes]:
    """Makes a DNG."""
    return dng


@pytest.fixture
def digests(folder: Path) -> Callable[[str], dict[str, str]]:
    """The files below a folder of the store, each with the hash of its bytes."""

    def of(below: str) -> dict[str, str]:
        root = folder / below
        files = [path for path in sorted(root.rglob("*")) if path.is_file()]
        assert files
        return {str(f.relative_to(root)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}

    return of
