"""Tiles: every block in exactly one, and the same matte to the byte however frames and work were cut."""

import io
import json
import random
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from storage.errors import Corrupt
from storage.layout import mattes
from storage.layout.captures import Stack
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from tests.parts.captures import nested_program
from tests.workflows.ingest.video.camera import Camera, capture, film, lights
from workflows.composite import composite
from workflows.images.integer_formats import decode, encode_png
from workflows.jobs import Task, run, run_all
from workflows.mattes.steps import STEPS
from workflows.mattes.tiles import cut, cut_inside, mask_of
from workflows.programs.border import border_light
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene, write_capture
from workflows.untrusted.limits import Limits

Zip = Callable[..., bytes]
Ingest = Callable[..., object]
Digests = Callable[[str], dict[str, str]]


@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (16, 16), (17, 33), (40, 100), (128, 16), (600, 1100), (2000, 30)]
)
@pytest.mark.parametrize("tile", [16, 17, 32, 50, 100, 1024])
def test_every_block_is_in_one_tile(objects: Objects, height: int, width: int, tile: int) -> None:
    matte = mattes.create(objects, "m", height=height, width=width, columns=1, rows=1)
    tiles = cut(matte, tile)
    covered = np.zeros((matte.block_rows, matte.block_columns), int)
    for rows, columns in tiles:
        assert len(rows) > 0
        assert len(columns) > 0
        assert max(len(rows), len(columns)) * matte.block < tile + matte.block
        covered[rows.start : rows.stop, columns.start : columns.stop] += 1
    assert covered.min() == covered.max() == 1
    edge = -(-tile // matte.block) * matte.block
    assert len(tiles) == -(-height // edge) * -(-width // edge)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 33), (40, 100), (600, 1100)])
@pytest.mark.parametrize("tile", [16, 17, 50, 1024])
@pytest.mark.parametrize(
    "region", [(0, 0, 1, 1), (16, 16, 1, 1), (15, 5, 30, 12), (90, 0, 5000, 5000), (32, 16, 1, 1)]
)
def test_tiles_inside_a_region_show_some_of_it(
    objects: Objects, height: int, width: int, tile: int, region: tuple[int, int, int, int]
) -> None:
    matte = mattes.create(objects, "m", height=height, width=width, columns=1, rows=1)
    x, y, wide, high = region
    frame = np.zeros((height, width), bool)
    frame[y : y + high, x : x + wide] = True
    shown = {
        number
        for number, (rows, columns) in enumerate(cut(matte, tile))
        if any(frame[matte.span(row, column)].any() for row in rows for column in columns)
    }
    assert cut_inside(width, height, matte.block, tile, region) == shown


@pytest.fixture(scope="module")
def scene() -> Scene:
    return glass_ball(44, 36, monitor=(64, 48), rays=4)


@pytest.fixture(scope="module")
def archives(scene: Scene) -> dict[bool, bytes]:
    """The ball's capture, without a mask and with one."""
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    made = {}
    for mask in (False, True):
        target = io.BytesIO()
        write_capture(scene, program, target, mask=mask, noise=0.5)
        made[mask] = target.getvalue()
    return made


@pytest.fixture
def recover(objects: Objects, ingest: Ingest) -> Callable[..., tuple[mattes.Matte, int]]:
    def whole(
        data: bytes,
        tile: int | None = None,
        *,
        memory: int = 1 << 26,
        order: Callable[[range], object] = iter,
        method: str = "lobes",
    ) -> tuple[mattes.Matte, int]:
        ingest("c", data, memory=memory)
        mask_of.cache_clear()  # "c" may have had another
        objects.delete(mattes.path("m"))
        options = {"method": method, "tile": tile}
        task = Task("j", "c", "m", options, Limits(1 << 30, memory))
        plan = run(STEPS, objects, task, PREPARE)[1]
        tiles = list(order(range(plan["tiles"])))  # type: ignore[call-overload]
        pixels = sum(run(STEPS, objects, task, index)[1] for index in tiles)
        # of the monitor's pixels, or of the program's finest grid
        assert run(STEPS, objects, task, FINISH)[1]["columns"] == {"lobes": 64, "nn-dgsr": 8}[method]
        return mattes.Matte(objects, "m"), pixels

    return whole


@pytest.mark.parametrize("method", ["lobes", pytest.param("nn-dgsr", marks=pytest.mark.slow)])
def test_the_matte_is_the_same_to_the_byte(
    recover: Callable[..., tuple[mattes.Matte, int]],
    digests: Digests,
    archives: dict[bool, bytes],
    method: str,
) -> None:
    matte, pixels = recover(archives[True], method=method)
    assert matte.block == 16
    plain = digests("mattes/m")
    frame = 44 * 36 * 3
    for variant in (
        {"tile": 16},
        {"tile": 17},
        {"tile": 1024},
        {"tile": 32, "order": reversed},
        {"memory": 8 * frame},  # slabs of four frames
        {"memory": 10 * frame, "tile": 1024},
        {"order": lambda tiles: [*tiles, 0, 3]},  # and some tiles again
    ):
        _, again = recover(archives[True], method=method, **variant)
        assert digests("mattes/m") == plain, variant
        assert again == pixels or "order" in variant


def test_pixels_outside_the_mask_are_empty(
    recover: Callable[..., tuple[mattes.Matte, int]], scene: Scene, archives: dict[bool, bytes]
) -> None:
    masked, pixels = recover(archives[True])
    blocks = {(r, c): masked.read(r, c) for r in range(3) for c in range(3)}
    mask = scene.object_mask
    assert pixels == mask.sum()
    assert 0 < pixels < mask.size
    whole, every = recover(archives[False])
    assert every == mask.size
    differences = []
    for place, block in blocks.items():
        inside = mask[whole.span(*place)]
        np.testing.assert_array_equal(block.recovered, inside)
        for values in (block.S, block.rho, block.count, block.shared):
            assert not values[~inside].any()
        assert np.isfinite(block.error[inside]).any() or not inside.any()
        unmasked = whole.read(*place)
        assert unmasked.recovered.all()
        assert unmasked.rho[~inside].min() > 0
        differences += [(block.S - unmasked.S)[inside], (block.rho - unmasked.rho)[inside]]
    # Fits start from those of neighbours and are averaged with them: what is inside depends a little on what is not.
    assert np.sqrt(np.mean(np.concatenate(differences) ** 2)) < 1e-3


@pytest.mark.parametrize("colours", ["grey", "rgb"])
def test_a_block_that_the_mask_leaves_out_is_empty(
    recover: Callable[..., tuple[mattes.Matte, int]], scene: Scene, colours: str
) -> None:
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    parts = (program.parts[0], *(part.model_copy(update={"colour": colours}) for part in program.parts[1:]))
    corner = np.zeros_like(scene.coverage)
    corner[17:30, 17:30] = 1
    target = io.BytesIO()
    alone = replace(scene, coverage=corner)
    write_capture(alone, program.model_copy(update={"parts": parts}), target, mask=True)
    matte, pixels = recover(target.getvalue())
    assert pixels == alone.object_mask.sum() > 0
    assert not matte.read(0, 0).recovered.any()
    assert matte.read(0, 0).cell.size == 0
    assert matte.read(1, 1).cell.size > 0


def test_the_photometry_is_the_scenes(
    recover: Callable[..., tuple[mattes.Matte, int]], scene: Scene, archives: dict[bool, bytes]
) -> None:
    matte, _ = recover(archives[False], tile=1024)
    S, rho = np.zeros((2, 36, 44, 3), np.float32)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            block, at = matte.read(row, column), matte.span(row, column)
            S[at], rho[at] = block.S, block.rho
    # The simulated camera adds 0.02 of its own and keeps 0.9 of the light.
    np.testing.assert_allclose(S, 0.02, atol=0.01)
    np.testing.assert_allclose(rho, 0.9 * scene.rho, atol=0.02)


def test_frames_of_one_pattern_are_averaged(
    recover: Callable[..., tuple[mattes.Matte, int]], archives: dict[bool, bytes]
) -> None:
    # Each frame is split into a darker and a lighter one; their mean is the frame.
    split = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archives[False])) as archive, zipfile.ZipFile(split, "w") as out:
        manifest = json.loads(archive.read("capture.json"))
        frames = manifest["frames"]
        manifest["frames"] = []
        for n, frame in enumerate(frames):
            pixels = decode(archive.read(frame["file"]), memory=1 << 20)
            apart = np.minimum(np.minimum(pixels - 1, 254 - pixels.astype(int)).clip(0), 1 + n % 4)
            for name, shifted in (("a", pixels - apart), ("b", pixels + apart)):
                out.writestr(f"{n}{name}.png", encode_png(shifted.astype(np.uint8)))
                manifest["frames"].append({"file": f"{n}{name}.png", "pattern": frame["pattern"]})
        random.Random(0).shuffle(manifest["frames"])
        out.writestr("capture.json", json.dumps(manifest))
    plain = recover(archives[False], tile=1024)[0].read(1, 1)
    doubled = recover(split.getvalue(), tile=1024)[0].read(1, 1)
    # split frames have another noise, and so S and rho other bounds
    np.testing.assert_allclose(doubled.S, plain.S, atol=4e-3)
    np.testing.assert_allclose(doubled.rho, plain.rho, atol=8e-3)


def test_a_damaged_stack_is_corrupt(
    ingest: Callable[..., Stack], objects: Objects, folder: Path, archives: dict[bool, bytes]
) -> None:
    ingest("c", archives[False])
    chunk = next(path for path in (folder / "captures/c/frames/c").rglob("*") if path.is_file())
    chunk.unlink()
    task = Task("j", "c", "m", {}, Limits(1 << 30, 1 << 26))
    plan = run(STEPS, objects, task, PREPARE)[1]
    with pytest.raises(Corrupt, match="frames"):
        sum(run(STEPS, objects, task, index)[1] for index in range(plan["tiles"]))
    assert run(STEPS, objects, task, FINISH)[1] == {"missing": list(range(plan["tiles"]))}


@pytest.mark.slow
def test_frames_that_are_moved_back_are_the_same_in_any_tile(
    ingest: Callable[..., Stack], objects: Objects, digests: Digests, archives: dict[bool, bytes]
) -> None:
    stack = ingest("c", archives[True])
    random = np.random.default_rng(2)
    stack.annotate(
        shifts=random.uniform(-2.5, 2.5, (stack.frames, 2)).tolist(),
        gains=random.uniform(0.9, 1.1, stack.frames).tolist(),
    )
    stack.save()
    made = []
    for tile in (16, 32, 1024):
        task = Task("j", "c", "m", {"tile": tile}, Limits(1 << 30, 1 << 26))
        for index in range(run(STEPS, objects, task, PREPARE)[1]["tiles"]):
            run(STEPS, objects, task, index)
        made.append(digests("mattes/m"))
    assert made[0] == made[1] == made[2]


def test_missing_capture_or_matte_is_corrupt(
    ingest: Callable[..., Stack], objects: Objects, archives: dict[bool, bytes]
) -> None:
    ingest("c", archives[False])
    run(STEPS, objects, Task("j", "c", "m", {}, Limits(1 << 30, 1 << 26)), PREPARE)
    for of, to in (("c", "none"), ("none", "m")):
        with pytest.raises(Corrupt, match="none is not in the store"):
            run(STEPS, objects, Task("j", of, to, {}, Limits(1, 1)), 0)


def bracketed(data: bytes, exposures: tuple[float, ...]) -> bytes:
    """A capture of 16 bits as a camera of 8 sees it, several times as long."""
    rng = np.random.default_rng(1)
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(target, "w") as out:
        manifest = json.loads(archive.read("capture.json"))
        frames = []
        for frame in manifest["frames"]:
            light = decode(archive.read(frame["file"]), memory=1 << 24) / 65535
            for exposure in exposures:
                value = exposure * light + rng.normal(0, 0.004, light.shape)
                name = f"{frame['pattern']}-{exposure}.png"
                out.writestr(name, encode_png(np.rint(np.clip(value, 0, 1) * 255).astype(np.uint8)))
                frames.append({"file": name, "pattern": frame["pattern"], "exposure": exposure / 50})
        out.writestr("capture.json", json.dumps(manifest | {"frames": frames}))
    return target.getvalue()


@pytest.mark.slow
def test_exposures_are_merged_by_their_weight(objects: Objects, ingest: Ingest) -> None:
    scene = glass_ball(44, 36, monitor=(64, 48), rays=4)
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    target = io.BytesIO()
    write_capture(scene, program, target, noise=0, depth=16, offset=0.003, gain=0.05)
    backdrop = np.random.default_rng(3).random((3, 4, 3), np.float32)
    exact = scene.truth(backdrop, offset=0.003, gain=0.05)

    def error(capture: str, data: bytes) -> float:
        ingest(capture, data)
        task = Task("j", capture, f"m-{capture}", {}, Limits(1 << 30, 1 << 26))
        run_all(STEPS, objects, task)
        got = composite(mattes.Matte(objects, task.matte), backdrop)[..., :3]
        return float(np.sqrt(np.mean((got - exact) ** 2)))

    one = error("one", bracketed(target.getvalue(), (1,)))
    # the longest clips the brightest pixels
    many = error("many", bracketed(target.getvalue(), (1, 4, 20)))
    assert many < 0.4 * one


@pytest.mark.parametrize("method", ["lobes", pytest.param("nn-dgsr", marks=pytest.mark.slow)])
def test_patterns_that_a_video_lacks_are_done_without(
    recover: Callable[..., tuple[mattes.Matte, int]],
    objects: Objects,
    scene: Scene,
    make_zip: Zip,
    method: str,
) -> None:
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    made = film(lights(scene, program), Camera(hold=0.2, tail=-0.7, options={"crf": "10"}))
    matte, _ = recover(make_zip(*capture(program, made.data, 5)), method=method)
    lacking = Stack(objects, "c").attributes["video"]["missing"]
    assert 2 <= len(lacking) <= 6
    y, x = np.mgrid[:48, :64] / 64
    backdrop = np.stack([x, 1 - x, y], axis=2).astype(np.float32)
    error = composite(matte, backdrop)[..., :3] - scene.truth(backdrop)
    assert -10 * np.log10(np.mean(error[scene.object_mask] ** 2)) > 24


BANDS = ((10, 10, 12), (20, 20, 12), (40, 40, 12), (80, 40, 24))
MONITOR = 160, 120


@pytest.fixture
def error_of(objects: Objects) -> Callable[..., float]:
    """Recovers a capture, and measures how far a composite is from a picture, root mean square over a mask."""

    def of(capture: str, method: str, backdrop: np.ndarray, picture: np.ndarray, mask: np.ndarray) -> float:
        task = Task("j", capture, f"m-{capture}", {"method": method}, Limits(1 << 30, 1 << 26))
        run_all(STEPS, objects, task)
        found = composite(mattes.Matte(objects, task.matte), backdrop)[..., :3]
        return float(np.sqrt(np.mean((found - picture)[mask] ** 2)))

    return of


@pytest.mark.parametrize("method", ["lobes", pytest.param("nn-dgsr", marks=pytest.mark.slow)])
@pytest.mark.parametrize("what", ["border", "glare"])
def test_composites_have_glare_but_no_border(
    ingest: Callable[..., Stack], error_of: Callable[..., float], make_zip: Zip, method: str, what: str
) -> None:
    ball, program = (
        glass_ball(24, 18, monitor=MONITOR, rays=9),
        nested_program(MONITOR, bands=BANDS, levels=2),
    )
    share = 0.15 if what == "glare" else 0.0

    def seen(light: np.ndarray) -> np.ndarray:
        through = (1 - share) * light + share * light.mean(axis=(0, 1))
        return 0.1 + ball.truth(through.astype(np.float32), gain=0.7)

    border, rng = border_light(range(program.count)), np.random.default_rng(3)
    amount = (0.0 if share else 0.03) * rng.standard_normal((18, 24, len(border)))
    frames = [{"file": f"{n}.png", "pattern": n} for n in range(program.count)]
    files = {}
    for n, picture in enumerate(program.pictures(0, program.count)):
        value = seen((picture > 0).astype(np.float32)) + (amount @ border[:, n])[..., np.newaxis]
        value += 0.003 * rng.standard_normal(value.shape)
        files[f"{n}.png"] = encode_png(np.rint(np.clip(value, 0, 1) * 65535).astype(np.uint16))
    manifest = {
        "format": "envmatte-capture/1",
        "program": program.model_dump(mode="json"),
        "frames": frames,
        "response": "linear",
    }
    y, x = np.mgrid[:120, :160]
    bump = np.exp(-((x - 40) ** 2 + (y - 40) ** 2) / (2 * 25**2))[..., np.newaxis]
    backdrop = (bump * [1, 0.8, 0.5]).astype(np.float32)
    off = []
    for name, known in (("with", True), ("without", False)):
        stack = ingest(name, make_zip(manifest, files))
        stack.annotate(border=known and not share, glare=[0.0, 0.0, 0.0, share] if known and share else None)
        stack.save()
        off.append(error_of(name, method, backdrop, seen(backdrop), ball.object_mask))
    assert off[0] < 0.85 * off[1]
