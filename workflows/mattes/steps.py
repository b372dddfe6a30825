"""The steps of a recovery: create the matte, recover its tiles, read its figures."""

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import product
from typing import Any

from storage.errors import Conflict
from storage.layout import mattes
from storage.layout.captures import Stack
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows.ingest.report.expected_psnr import exposure_error
from workflows.ingest.trial.qualities import QUALITIES
from workflows.jobs import Steps, Task
from workflows.mattes import preview, tiles
from workflows.mattes.cut_out import CutOut, find_object
from workflows.mattes.options import RecoveryOptions, parse_options
from workflows.programs.program import Program


def prepare(objects: Objects, task: Task) -> dict[str, Any]:
    """Create the empty matte of a capture, and recover its preview if it has one.

    Returns
    -------
    dict
        ``tiles``: how many there are. ``figures``: of the matte, with ``preview``, of how many of its rows and columns
        the preview has one, or None. ``is_cut_out``: whether only the object is recovered. ``notes``: lines for the
        job's log.
    """
    stack = Stack(objects, task.capture)
    program, _ = tiles.program_of(objects, task.capture)
    options = parse_options(task.options)
    columns, rows = tiles.grid_of(objects, task.capture, options)
    create = partial(
        mattes.create,
        objects,
        task.matte,
        height=stack.height,
        width=stack.width,
        columns=columns,
        rows=rows,
        monitor=[program.monitor.width, program.monitor.height],
        crosstalk=stack.attributes["crosstalk"],
        # Without the size of tiles, which changes nothing in the matte; of whole frames as earlier versions wrote them.
        options=options.model_dump(mode="json", exclude={"tile"} if options.cut_out else {"tile", "cut_out"}),
        **_interval(stack, program, options),
    )
    matte = create()
    is_cut_out, notes = options.cut_out and bool(stack.mask().all()), []
    spacing = preview.spacing_of(stack, least=1) if is_cut_out else preview.spacing_of(stack)
    if spacing is not None:
        preview.recover_preview(objects, task.capture, matte, task.matte, spacing)
    if is_cut_out:
        try:
            found = _cut_out(objects, task.matte, spacing)
            preview.show_only(Matte(objects, mattes.preview_of(task.matte)), found.object)
            matte = create(beside={"sight": found.sight.straight.tolist(), "rho": found.bare.tolist()})
        except Conflict as error:
            is_cut_out = False
            notes.append(f"the object could not be cut out, so the whole frame is recovered: {error}")
    return {
        "tiles": len(tiles.cut(matte, options.tile or matte.block)),
        "figures": matte.figures | {"preview": spacing},
        "is_cut_out": is_cut_out,
        "notes": notes,
    }


@lru_cache(maxsize=1)
def _cut_out(objects: Objects, matte: str, spacing: int | None) -> CutOut:
    """Where the object of a matte stands, kept from tile to tile."""
    whole = Matte(objects, matte)
    assert spacing is not None  # a matte whose object is cut out has a preview
    return find_object(Matte(objects, mattes.preview_of(matte)), spacing, whole.height, whole.width)


def _interval(stack: Stack, program: Program, options: RecoveryOptions) -> dict[str, Any]:
    """The attribute ``interval`` of a matte, if the ingest has tried these options.

    To what patterns that are held out show, it adds what grey ones can't, the detail of colours that frames have lost,
    and what none can, the exposure at which the scene is to be shown, if the camera's was not locked.
    """
    quality = next((name for name, tried in QUALITIES.items() if tried == options.of_method), None)
    found = stack.attributes.get("intervals", {}).get(quality)
    if not found:
        return {}
    lost = 0.0 if program.in_colour else stack.attributes["survey"].get("lost_colour", 0.0)
    share = found["share"] + exposure_error(stack.attributes.get("auto_exposure"))
    return {"interval": found | {"read": found["read"] + lost, "share": share}}


def work(objects: Objects, task: Task, tile: int) -> int:
    """Recover one tile; returns the number of pixels recovered."""
    plan, options = task.plan, parse_options(task.options)
    cut_out = _cut_out(objects, task.matte, plan["figures"]["preview"]) if plan.get("is_cut_out") else None
    return tiles.recover_tile(objects, task.capture, task.matte, options, tile, cut_out)


def missing(objects: Objects, task: Task) -> list[int]:
    """The tiles with a block that is not in the store."""
    matte = Matte(objects, task.matte)
    blocks = matte.missing()
    edge = parse_options(task.options).tile or matte.block
    return [
        tile
        for tile, (rows, columns) in enumerate(tiles.cut(matte, edge))
        if not blocks.isdisjoint(product(rows, columns))
    ]


def finish(objects: Objects, task: Task) -> dict[str, Any]:
    """Remove the preview, and what interrupted workers left beside the matte; returns its figures."""
    objects.delete(mattes.path(mattes.preview_of(task.matte)))
    objects.sweep(mattes.path(task.matte))
    return Matte(objects, task.matte).figures


def inside(plan: dict[str, Any], options: dict[str, Any], region: Sequence[int]) -> set[int]:
    """The tiles that show some of a region."""
    width, height, block = (plan["figures"][name] for name in ("width", "height", "block"))
    return tiles.cut_inside(width, height, block, options.get("tile") or block, region)


STEPS = Steps("recover", "recovering", prepare, work, missing, finish, scattered=True, inside=inside)
