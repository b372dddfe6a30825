"""The ingest of a capture: frames are read one at a time and written, a slab of them at once, into the stack."""

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage import uploads
from storage.captures import Stack, create_stack, write_slab
from storage.errors import CaptureError, ImageError
from storage.objects import Objects
from workflows import images
from workflows.grids import smallest_grid
from workflows.ingest import stills
from workflows.ingest.bundle import Bundle, Limits
from workflows.program import Images
from workflows.tone import Response


def prepare(objects: Objects, capture: str, limits: Limits) -> dict[str, int]:
    """Look into the bundle of a capture and make its empty stack.

    Returns
    -------
    dict
        ``tiles``: the number of slabs; ``width``, ``height``.

    Raises
    ------
    CaptureError
    """
    with uploads.read(objects, capture) as file:
        bundle = Bundle(file, limits)
        manifest = bundle.manifest
        first = stills.read(bundle, manifest.frames[0].file, limits)
        storage = stills.storage_of(bundle, first, limits)
        mask = None
        if manifest.mask is not None:
            mask = np.any(_decode(bundle, manifest.mask, limits), axis=2)
            if mask.shape != first.shape[:2]:
                raise CaptureError(
                    f"{manifest.mask} is {_size(mask)}, the frames are {_size(first)}", entry=manifest.mask
                )
        names = [n for part in manifest.program.parts if isinstance(part, Images) for n in part.files]
        patterns: list[NDArray[np.float32]] = []
        for name in names:
            patterns.append(images.to_unit(smallest_grid(_decode(bundle, name, limits))))
            if sum(pattern.nbytes for pattern in patterns) > limits.memory // 2:
                raise CaptureError(
                    f"the patterns that come as images take more than {limits.memory // 2} bytes together, from "
                    f"{name} on: use fewer, smaller or coarser ones",
                    entry=name,
                    limit=limits.memory // 2,
                )
    height, width, channels = first.shape
    slab = create_stack(
        objects,
        capture,
        (len(manifest.frames), height, width, channels),
        storage.dtype,
        memory=limits.memory,
        attributes={
            "program": manifest.program.model_dump(mode="json"),
            # Float values are linear light, whatever is left unsaid.
            "response": "linear"
            if first.dtype == np.float32
            else TypeAdapter(Response).dump_python(manifest.response, mode="json"),
            "patterns": [frame.pattern for frame in manifest.frames],
            "exposures": [frame.exposure for frame in manifest.frames],
            "storage": {"black": storage.black, "full": storage.full},
        },
        mask=mask,
        images=patterns,
    )
    return {"tiles": -(-len(manifest.frames) // slab), "slab": slab, "width": width, "height": height}


def read_slab(objects: Objects, capture: str, limits: Limits, slab: int, index: int) -> int:
    """Decode the frames of slab ``index``, of ``slab`` frames, into the stack; returns their pixels.

    Raises
    ------
    CaptureError
        Naming the frame that can't be decoded, or is of another size or kind than the first.
    """
    stack = Stack(objects, capture)
    with uploads.read(objects, capture) as file:
        bundle = Bundle(file, limits)
        of_slab = bundle.manifest.frames[index * slab : (index + 1) * slab]
        shape = (stack.height, stack.width, stack.channels)
        frames = np.empty((len(of_slab), *shape), stack.dtype)
        storage = stills.Storage(stack.dtype, **stack.attributes["storage"])
        kind = np.dtype(np.float32) if storage.black else stack.dtype
        for n, frame in enumerate(of_slab):
            pixels = stills.read(bundle, frame.file, limits)
            if pixels.shape != shape or pixels.dtype != kind:
                raise CaptureError(
                    f"{frame.file} is {_size(pixels)} with {pixels.shape[2]} channels of {pixels.dtype}, the first "
                    f"frame {stack.width} x {stack.height} with {stack.channels} of {kind}: all frames must "
                    "be of one size and kind",
                    entry=frame.file,
                )
            frames[n] = storage.encode(pixels)
    write_slab(objects, capture, index * slab, frames)
    return int(frames.shape[0] * frames.shape[1] * frames.shape[2])


def _decode(bundle: Bundle, entry: str, limits: Limits) -> images.Codes:
    try:
        return images.decode(bundle.read(entry), memory=limits.image)
    except ImageError as error:
        raise CaptureError(f"{entry}: {error.detail}", entry=entry, **error.fields) from error


def _size(pixels: NDArray[np.generic]) -> str:
    return f"{pixels.shape[1]} x {pixels.shape[0]}"
