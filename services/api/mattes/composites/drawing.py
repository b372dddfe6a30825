"""A composite of a picture: its light and alpha, drawn in bands, and what that takes of memory."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from services.api.context import Context
from services.api.http.server_timing import ServerTiming
from services.api.mattes.composites.params import CompositeParams
from services.api.mattes.progress import Progress
from storage.errors import Conflict, OptionError
from storage.records import mattes
from workflows.composite import composite, light_on
from workflows.composite.backdrops.around import expose, put_around
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.depth import Rays, from_one, from_two
from workflows.composite.engine import Window, compose
from workflows.composite.interval import contrast_on, half_widths
from workflows.composite.preview import enlarge, put_behind, window_of_preview
from workflows.composite.scale import double, shrink
from workflows.composite.strips import Strip
from workflows.recovery.interval import Interval
from workflows.threads import CORES

Picture = NDArray[np.float32]
"""(height, width, 4): light and alpha."""
PICTURE_BYTES = 16
"""Of a pixel while it is composited: light and alpha."""
SHRUNK_BYTES = 32
"""Of a pixel while a picture is made smaller, and of the answer."""
DOUBLED_BYTES = 96
"""Of a pixel while a picture is made twice as wide and high: twice as wide, and then the whole."""
ENLARGED_BYTES = 50
"""Of a pixel while a preview is enlarged: the light and alpha of its neighbours, and their mean."""
LIGHT_BYTES = 16
"""Of a cell of the monitor: the light of three channels, with the coarser grids."""
AROUND_BYTES = 48
"""Of a pixel of the matte while the backdrop is put around the glass: its light, what it adds, and blurred alpha."""
RAYS_BYTES = 160
"""Of a pixel of the matte while rays to a backdrop at another depth are found."""
INTERVAL_BYTES = 128
"""Of a pixel while its interval is worked out, and of a cell while its contrast is."""


class Drawing:
    """A composite that a request asks for, of a matte or of what is recovered of it.

    Parameters
    ----------
    context : Context
    progress : Progress
    params : CompositeParams
    is_whole : bool
        Whether it is needed in one part.

    Attributes
    ----------
    window : Window
        The part of the frame that it shows.
    bands : list of Window
        The parts of the window that are composited one after the other, so that few pixels take memory at once. It is
        one part if pixels depend on others.
    """

    def __init__(self, context: Context, progress: Progress, params: CompositeParams, is_whole: bool) -> None:
        self._context, self._progress, self._params = context, progress, params
        self._matte = context.cache.matte(progress.id)
        self._where = params.placement_behind(self._matte)
        self.window = Window.of(self._matte, params.x, params.y, params.width, params.height)
        is_whole = (
            is_whole
            or progress.preview is not None
            or params.depth is not None
            or params.around == "backdrop"
            or params.size is not None
            or params.enlarge > 1
        )
        self.bands = [self.window] if is_whole else self.window.bands(self._matte.block)

    def most_bytes(self, of_answer: int) -> int:
        """Bytes that it takes at most, apart from the strips of the matte and from backdrops.

        The bound of these is ENVMATTE_BACKDROP_BYTES times the composites at once: if they counted at their most here,
        composites of one owner would wait for one another.

        Parameters
        ----------
        of_answer : int
            Bytes of a pixel of the answer.
        """
        params, matte = self._params, self._matte
        of_band = self.window.width * max(band.height for band in self.bands)
        of_band *= INTERVAL_BYTES if params.interval else PICTURE_BYTES
        of_cell = INTERVAL_BYTES if params.interval else LIGHT_BYTES
        of_pixel = SHRUNK_BYTES if params.size is not None else params.enlarge**2 * of_answer
        if params.enlarge > 1:
            of_pixel += DOUBLED_BYTES
        of_rays = RAYS_BYTES * matte.width * matte.height if params.depth is not None else 0
        of_frame = AROUND_BYTES * matte.width * matte.height if params.around == "backdrop" else 0
        if self._progress.preview is not None:
            of_pixel += ENLARGED_BYTES
        of_window = of_pixel * self.window.width * self.window.height
        return of_cell * matte.columns * matte.rows + of_band + of_window + of_rays + of_frame

    def before(self, backdrop: Backdrop, times: ServerTiming) -> Iterator[Picture]:
        """Light and alpha before a backdrop, by `bands` from top to bottom.

        Raises
        ------
        Conflict
            If the matte lacks what was asked for, or has not got it yet.
        OptionError
            If two mattes don't belong together.
        """
        params, matte = self._params, self._matte
        draw = self._drawn(backdrop, times)
        steps: dict[str, Callable[[Picture, Window], Picture]] = {}
        if self._progress.preview is not None:
            steps["preview"] = partial(self._put_preview, self._progress.preview, backdrop)
        if params.fits_frame:
            steps["expose"] = lambda picture, _: expose(matte, picture)
        if params.around == "backdrop":
            steps["around"] = partial(put_around, matte, backdrop, self._where)
        if params.size is not None:
            size = params.size
            steps["shrink"] = lambda picture, _: shrink(picture, size)
        if params.enlarge == 2:
            steps["double"] = lambda picture, _: double(picture)
        del backdrop  # which may take as much memory as the answer, and which only some steps need
        for band in self.bands:
            picture = times.take("composite", partial(draw, band))
            for name, step in steps.items():
                picture = times.take(name, partial(step, picture, band))
            yield picture

    def _drawn(self, backdrop: Backdrop, times: ServerTiming) -> Callable[[Window], Picture]:
        """What draws a window before a backdrop, or how far the light of its pixels may be from that."""
        matte, where, progress = self._matte, self._where, self._progress

        def read(row: int, number: int) -> Strip:
            return self._context.cache.strip(progress.id, row, number, progress.blocks)

        rays = times.take("rays", self._rays) if self._params.depth is not None else None
        light = times.take("light", partial(light_on, matte, backdrop, where, CORES))
        if not self._params.interval:
            return lambda band: compose(matte, light, band, read, CORES, rays)
        interval = self._interval()
        contrast = times.take("contrast", partial(contrast_on, matte, light, backdrop, where, CORES))
        return lambda band: half_widths(matte, interval, light, contrast, band, read, CORES)

    def _put_preview(self, spacing: int, backdrop: Backdrop, picture: Picture, window: Window) -> Picture:
        """Show the preview in a picture of a window where blocks of the matte are not done."""
        cache, blocks = self._context.cache, self._progress.blocks
        assert blocks is not None  # else there is no preview
        name = self._progress.whole_frame
        preview = cache.matte(name)
        size = preview.width, preview.height
        part = window_of_preview(window, spacing, *size)
        read = partial(cache.strip, name)
        small = composite(preview, backdrop, placement=self._where, window=part, read=read)
        put_behind(picture, enlarge(small, part, window, spacing, *size), window, blocks, self._matte.block)
        return picture

    def _interval(self) -> Interval:
        """The interval of composites of the matte."""
        id, attributes = self._progress.id, self._matte.attributes
        if self._progress.blocks is not None:
            raise Conflict(f"matte {id} is still being recovered; its intervals are there when it is done")
        if "interval" not in attributes:
            raise Conflict(
                f"how far composites of matte {id} are from the truth is not known: it was recovered with other "
                "options than a quality, from a capture of an earlier version, from too few pixels with contrast, or "
                "from patterns on fixed grids, which do not tell where in a block the light comes from"
            )
        return Interval(**attributes["interval"])

    def _rays(self) -> Rays:
        """The rays to a backdrop at another depth."""
        id, params, cache = self._progress.id, self._params, self._context.cache
        if self._progress.blocks is not None:
            raise Conflict(
                f"matte {id} is still being recovered; a backdrop at another depth needs all of it"
            )
        assert params.depth is not None  # `CompositeParams` checks it, and the two below
        assert params.distance is not None
        places = cache.places(id, CORES)
        if params.camera is not None:
            wide, high = self._matte.attributes["monitor"]
            return from_one(places, high / wide, params.distance, params.camera, params.depth)
        assert params.other is not None
        assert params.other_distance is not None
        with self._context.stored(mattes.get_ready, params.other):
            others = cache.places(params.other, CORES)
        if others.shape != places.shape:
            raise OptionError(
                f"matte {params.other} has {others.shape[1]} x {others.shape[0]} pixels, {id} {places.shape[1]} x "
                f"{places.shape[0]}: both must be from the same camera in the same place",
                field="other",
            )
        return from_two(places, others, (params.distance, params.other_distance), params.depth)
