"""Captures in the store: slabs in any order, masks, images, measurements, and missing chunks."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from storage.errors import Corrupt
from storage.layout import captures
from storage.layout.blocks import block_edge
from storage.layout.captures import Stack, Strips, create_stack, write_slab
from storage.objects.store import Objects

SHAPE = (14, 37, 50, 3)


def create(
    objects: Objects,
    capture: str = "c",
    shape: tuple[int, int, int, int] = SHAPE,
    slab: int = 4,
    **more: object,
) -> int:
    given = {"mask": None, "images": (), "attributes": {"patterns": [1, 0]}} | more
    memory = 2 * slab * int(np.prod(shape[1:])) * 2
    return create_stack(objects, capture, shape, np.dtype("uint16"), memory=memory, **given)  # type: ignore[arg-type]


@pytest.fixture
def values() -> NDArray[np.uint16]:
    made = np.random.default_rng(1).integers(0, 65536, SHAPE, np.uint16)
    made[4:8] = 0  # a slab of zeros is stored too
    return made


def fill(objects: Objects, values: NDArray[np.uint16], order: tuple[int, ...] = (0, 1, 2, 3)) -> Stack:
    assert create(objects) == 4
    for slab in order:
        write_slab(objects, "c", slab * 4, values[slab * 4 : slab * 4 + 4])
    return Stack(objects, "c")


def test_written_frames_are_read_back(objects: Objects, values: NDArray[np.uint16]) -> None:
    stack = fill(objects, values)
    assert stack.missing() == []
    assert (stack.frames, stack.height, stack.width, stack.channels) == SHAPE
    assert stack.dtype == np.uint16
    assert stack.attributes == {"patterns": [1, 0]}
    np.testing.assert_array_equal(stack.read(), values)
    part = stack.read(slice(5, 33), slice(15, 18), slice(3, 9))
    np.testing.assert_array_equal(part, values[3:9, 5:33, 15:18])
    picked = stack.read_frames([9, 0, 4, 4], slice(5, 33), slice(15, 18))
    np.testing.assert_array_equal(picked, values[[9, 0, 4, 4], 5:33, 15:18])
    in_a_row = stack.read_frames([3, 4, 5], slice(5, 33), slice(15, 18))
    np.testing.assert_array_equal(in_a_row, values[3:6, 5:33, 15:18])
    assert stack.mask(slice(5, 33), slice(15, 18)).all()
    of_part, mask = stack.read_masked(slice(5, 33), slice(15, 18))
    np.testing.assert_array_equal(of_part, values[:, 5:33, 15:18])
    assert mask.shape == (28, 3)
    assert mask.all()
    assert stack.images() == []


@pytest.mark.parametrize("order", [(2, 0, 3, 1), (1, 2, 0, 3, 1, 1)])
def test_order_of_slabs_does_not_change_bytes(
    objects: Objects,
    values: NDArray[np.uint16],
    digests: Callable[[str], dict[str, str]],
    order: tuple[int, ...],
) -> None:
    fill(objects, values)
    plain = digests("captures/c")
    fill(objects, values, order)
    assert digests("captures/c") == plain
    assert sum("/c/" in name for name in plain) == sum(
        zarr.open_array(objects.zarr, path=f"captures/c/{name}").nchunks for name in ("frames", "thumbnails")
    )


def test_masks_and_images_are_read_back(objects: Objects) -> None:
    rng = np.random.default_rng(2)
    mask = rng.random((37, 50)) < 0.5
    images = [rng.random((n, 3, 1 + 2 * (n % 2)), np.float32) for n in range(1, 12)]
    create(objects, mask=mask, images=images)
    frames = rng.integers(0, 65536, SHAPE, np.uint16)
    for slab in (0, 4, 8, 12):
        write_slab(objects, "c", slab, frames[slab : slab + 4])
    stack = Stack(objects, "c")
    np.testing.assert_array_equal(stack.read_masked()[1], mask)
    np.testing.assert_array_equal(stack.mask(slice(3, 9), slice(40, 50)), mask[3:9, 40:50])
    of_part, part = stack.read_masked(slice(3, 9), slice(40, 50))
    np.testing.assert_array_equal(of_part, frames[:, 3:9, 40:])
    np.testing.assert_array_equal(part, mask[3:9, 40:])
    assert part.dtype == bool
    for read, image in zip(stack.images(), images, strict=True):
        np.testing.assert_array_equal(read, image)


@pytest.mark.parametrize("memory", [1, 10**5, 10**7, 10**9])
@pytest.mark.parametrize("shape", [(7, 5, 3, 1), (200, 100, 130, 3), (30, 600, 1000, 3)])
def test_slab_and_chunks_are_bounded(objects: Objects, memory: int, shape: tuple[int, int, int, int]) -> None:
    slab = create_stack(
        objects, "c", shape, np.dtype("uint8"), memory=memory, attributes={}, mask=None, images=()
    )
    frame, slabs = int(np.prod(shape[1:])), -(-shape[0] // slab)
    assert 1 <= slab <= shape[0]
    assert slab == 1 or slab * frame <= memory / 2
    # The next smaller even number would not fit, and these are as short as so many can be.
    assert slabs == 1 or -(-shape[0] // max(slabs - 2, 1)) * frame > memory / 2
    assert (slab - 1) * slabs < shape[0]
    chunks = zarr.open_array(objects.zarr, path="captures/c/frames").chunks
    edge = block_edge(shape[1], shape[2])
    least = slab * min(edge, shape[1]) * min(edge, shape[2]) * shape[3]
    assert int(np.prod(chunks)) <= max(2 * captures.CHUNK, least)
    for size, n in zip(chunks[1:3], shape[1:3], strict=True):
        assert size == n or size % edge == 0


@pytest.mark.parametrize(("most", "slab"), [(140, 140), (139, 70), (47, 35), (21, 18), (20, 18), (18, 18)])
def test_two_workers_write_as_many_slabs_each(objects: Objects, most: int, slab: int) -> None:
    assert create(objects, shape=(140, 3, 4, 1), slab=most) == slab
    assert -(-140 // slab) in (1, 2, 4, 8)


def test_creating_stack_again_keeps_frames_and_measurements(
    objects: Objects, values: NDArray[np.uint16]
) -> None:
    stack = fill(objects, values)
    stack.annotate(noise=1)
    stack.save()
    assert create(objects) == 4
    again = Stack(objects, "c")
    np.testing.assert_array_equal(again.read(), values)
    assert again.attributes == {"patterns": [1, 0], "noise": 1}


def test_creating_stack_with_other_slabs_deletes_frames(objects: Objects, values: NDArray[np.uint16]) -> None:
    fill(objects, values)
    assert create(objects, slab=3) == 3
    stack = Stack(objects, "c")
    assert stack.missing() == [0, 1, 2, 3, 4]
    for first in range(0, 14, 3):
        write_slab(objects, "c", first, values[first : first + 3])
    np.testing.assert_array_equal(stack.read(), values)
    for name in ("frames", "thumbnails"):
        chunks = zarr.open_array(objects.zarr, path=f"captures/c/{name}").nchunks
        assert len(objects.paths_below(f"captures/c/{name}/c")) == chunks


def test_film_that_an_earlier_version_packed_is_read_until_its_stack_is_created_again(
    objects: Objects, values: NDArray[np.uint16], monkeypatch: pytest.MonkeyPatch
) -> None:
    shares = np.zeros((1, 3), np.int64)
    with monkeypatch.context() as earlier:
        earlier.setattr(captures, "FRAMES_LAST", ())
        create(objects, shares=shares)
    for version in ("earlier", "this"):
        if version == "this":
            create(objects, shares=shares)
        assert Stack(objects, "c").missing() == [0, 1, 2, 3]
        for first in range(0, 14, 4):
            write_slab(objects, "c", first, values[first : first + 4])
        np.testing.assert_array_equal(Stack(objects, "c").read(), values)


def test_measurements_are_saved(objects: Objects) -> None:
    create(objects)
    stack = Stack(objects, "c")
    stack.annotate(noise={"read": 1e-6})
    assert stack.attributes == {"patterns": [1, 0], "noise": {"read": 1e-6}}
    assert Stack(objects, "c").attributes == {"patterns": [1, 0]}
    stack.save()
    assert Stack(objects, "c").attributes == {"patterns": [1, 0], "noise": {"read": 1e-6}}


def test_missing_chunk_is_corrupt(objects: Objects, folder: Path, values: NDArray[np.uint16]) -> None:
    stack = fill(objects, values)
    (folder / "captures/c/frames/c/1/0/0/0").unlink()
    assert stack.missing() == [1]
    with pytest.raises(Corrupt, match="frames/c/1/0/0/0"):
        Stack(objects, "c").read(slice(0, 2), slice(0, 2))
    np.testing.assert_array_equal(stack.read(frames=slice(0, 4)), values[:4])


@pytest.mark.parametrize("name", ["mask", "images/0"])
def test_missing_chunk_of_mask_or_image_is_corrupt(objects: Objects, folder: Path, name: str) -> None:
    create(objects, mask=np.zeros(SHAPE[1:3], bool), images=[np.zeros((4, 4, 1), np.float32)])
    for slab in (0, 4, 8, 12):
        write_slab(objects, "c", slab, np.zeros((min(4, 14 - slab), *SHAPE[1:]), np.uint16))
    stack = Stack(objects, "c")
    assert not stack.read_masked()[1].any()
    assert not stack.images()[0].any()
    chunk = next(path for path in (folder / "captures/c" / name / "c").rglob("*") if path.is_file())
    chunk.unlink()
    with pytest.raises(Corrupt):
        stack.read_masked() if name == "mask" else stack.images()


def test_slab_that_was_never_written_is_corrupt(objects: Objects, values: NDArray[np.uint16]) -> None:
    stack = fill(objects, values, order=(0, 2, 3))
    assert stack.missing() == [1]
    with pytest.raises(Corrupt):
        stack.read()


def test_missing_capture_is_corrupt(objects: Objects) -> None:
    with pytest.raises(Corrupt, match="capture none"):
        Stack(objects, "none")


def test_capture_without_frames_is_corrupt(objects: Objects, folder: Path) -> None:
    create(objects)
    (folder / "captures/c/frames/zarr.json").unlink()
    with pytest.raises(Corrupt, match="capture c"):
        Stack(objects, "c")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_thumbnails_are_the_means_of_blocks(objects: Objects, dtype: type[np.unsignedinteger]) -> None:
    shape, top = (2, 50, 161, 3), np.iinfo(dtype).max
    frames = np.random.default_rng(2).integers(0, top, shape, dtype)
    create_stack(objects, "c", shape, np.dtype(dtype), memory=1 << 20, attributes={}, mask=None, images=())
    write_slab(objects, "c", 0, frames)
    thumbnails = Stack(objects, "c").thumbnails()
    assert thumbnails is not None
    assert thumbnails.shape == (2, 17, 54)  # blocks of 3 x 3 pixels, the last of 2 x 2
    unit = frames / top * 65535
    np.testing.assert_allclose(thumbnails[1, 4, 5], unit[1, 12:15, 15:18].mean(), atol=0.5)
    np.testing.assert_allclose(thumbnails[0, 16, 53], unit[0, 48:, 159:].mean(), atol=0.5)
    np.testing.assert_array_equal(Stack(objects, "c").thumbnails(np.array([1])), thumbnails[[1]])


def test_stack_begun_by_an_earlier_version_has_no_thumbnails(
    objects: Objects, folder: Path, values: NDArray[np.uint16]
) -> None:
    create(objects)
    (folder / "captures/c/thumbnails/zarr.json").unlink()
    for slab in (0, 4, 8, 12):
        write_slab(objects, "c", slab, values[slab : slab + 4])
    stack = Stack(objects, "c")
    assert stack.thumbnails() is None
    np.testing.assert_array_equal(stack.read(), values)


def test_strips_are_pixels_of_the_frames(objects: Objects, values: NDArray[np.uint16]) -> None:
    _, height, width, _ = values.shape
    strips = Strips(np.arange(1, height, 3), np.arange(0, width, 2), 4)
    slab = create(objects, "c", values.shape, strips=strips)
    for first in range(0, len(values), slab):
        write_slab(objects, "c", first, values[first : first + slab])
    stack = Stack(objects, "c")
    for part in (slice(0, 4), slice(3, 9), slice(None)):
        np.testing.assert_array_equal(
            stack.read_strips(part), stack.read_some(strips.rows, strips.columns[part])
        )


def test_stack_without_strips_has_none(objects: Objects, values: NDArray[np.uint16]) -> None:
    create(objects, "c", values.shape)
    assert Stack(objects, "c").read_strips(slice(None)) is None
