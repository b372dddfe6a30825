"""A matte of random values, its archive, and archives that lie."""

import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest

from storage.layout import mattes
from storage.layout.matte_archive import MANIFEST, Archive
from storage.layout.mattes import Block, Matte
from storage.objects.checksums import SUM, crc32c, unseal
from storage.objects.store import Objects
from workflows.recovery.pyramid import Pyramid
from workflows.untrusted.limits import Limits

HEIGHT, WIDTH, COLUMNS, ROWS = 20, 35, 40, 5
LIMITS = Limits(unpacked=1 << 20, memory=1 << 20)
Files = dict[str, bytes]


def random_block(height: int, width: int, seed: int) -> Block:
    """A block as a recovery writes it: rows that ascend and add up to 1, some of them shared, some left out."""
    rng = np.random.default_rng(seed)
    recovered = rng.random((height, width)) < 0.8
    shared = recovered & (rng.random((height, width)) < 0.5)
    count = rng.integers(0, 4, (height, width, 3)).astype(np.uint32) * recovered[..., None]
    count[shared, 1:] = 0
    nodes = Pyramid.over(COLUMNS, ROWS).nodes
    cell, weight = [], []
    for n in count.ravel():
        cell.append(np.sort(rng.choice(nodes, n, replace=False)))
        shares = rng.random(n) + 0.1
        weight.append(shares / shares.sum())
    error = rng.random((height, width), np.float32)
    error[0, 0] = np.inf
    return Block(
        *rng.random((2, height, width, 3), np.float32),
        error,
        recovered,
        shared,
        count,
        np.concatenate(cell).astype(np.uint32),
        np.concatenate(weight).astype(np.float32),
    )


def make_matte(objects: Objects) -> Matte:
    """A whole matte, with the id m; one block of it has no rows at all."""
    made = mattes.create(
        objects,
        "m",
        height=HEIGHT,
        width=WIDTH,
        columns=COLUMNS,
        rows=ROWS,
        monitor=[80, 10],
        crosstalk=[[0.9, 0.1, 0], [0.05, 0.8, 0.15], [0.02, 0.18, 0.8]],
        options={"method": "lobes", "rounds": 1, "resolution": 1.0, "quality": None},
        beside={"sight": [[1.4, 0.0, -0.2], [0.01, 1.3, -0.15], [0.001, 0.0, 1.0]], "rho": [0.8, 0.7, 0.75]},
    )
    for row in range(made.block_rows):
        for column in range(made.block_columns):
            y, x = made.span(row, column)
            block = random_block(y.stop - y.start, x.stop - x.start, 10 * row + column)
            if (row, column) == (0, 1):
                nothing = np.zeros_like
                block = Block(
                    block.S,
                    block.rho,
                    block.error,
                    *map(nothing, (block.recovered, block.shared, block.count)),
                    block.cell[:0],
                    block.weight[:0],
                )
            made.write(row, column, block)
    return made


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """A store with that matte, and the archive of it."""
    folder = tmp_path_factory.mktemp("template")
    objects = Objects(folder.as_uri())
    make_matte(objects)
    return folder, b"".join(Archive(objects, "m"))


@pytest.fixture
def matte(objects: Objects, folder: Path, template: tuple[Path, bytes]) -> Matte:
    """The same, in a store of its own."""
    shutil.copytree(template[0], folder, dirs_exist_ok=True)
    return Matte(objects, "m")


@pytest.fixture
def archive(matte: Matte, template: tuple[Path, bytes]) -> bytes:
    """The matte's archive."""
    return template[1]


def unpacked(archive: bytes) -> Files:
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        return {name: file.read(name) for name in file.namelist()}


def packed(files: Files, method: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of files as they are."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", method) as file:
        for name, data in files.items():
            file.writestr(zipfile.ZipInfo(name), data, method)  # of a fixed date
    return target.getvalue()


def signed(files: Files) -> bytes:
    """An archive of files, whose manifest has been made to fit them."""
    manifest = json.loads(files[MANIFEST])
    manifest["members"] = {
        name: {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in files.items()
        if name != MANIFEST
    }
    return packed(files | {MANIFEST: json.dumps(manifest).encode()})


def unpack_chunk(data: bytes) -> bytes:
    return imagecodecs.zstd_decode(data[:-SUM])


def pack_chunk(values: bytes) -> bytes:
    """A chunk as zarr writes it."""
    return checked(imagecodecs.zstd_encode(values))


def checked(data: bytes) -> bytes:
    """Bytes with their checksum."""
    return data + crc32c(data).to_bytes(SUM, "little")


def documented(name: str, change: Callable[[dict[str, Any]], None]) -> Callable[[Files], None]:
    """Changes a JSON document among the files; a zarr.json has no checksum then."""

    def apply(files: Files) -> None:
        document = json.loads(files[name]) if name == MANIFEST else unseal(name, files[name])[0]
        change(document)
        files[name] = json.dumps(document, indent=2).encode()

    return apply


def digests(folder: Path) -> dict[str, bytes]:
    """Every file of the store below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
