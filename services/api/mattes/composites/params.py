"""Parameters of a composite, as a request gives them."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from storage.errors import OptionError
from storage.layout.mattes import Matte
from workflows.composite.backdrops.around import over_frame
from workflows.composite.backdrops.placement import Placement

Distance = Annotated[float, Field(ge=1e-6, le=1e6)]
"""In any unit. Far beyond these limits rays overflow."""


class CompositeParams(BaseModel):
    """What of a composite to compute, and how."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    transfer: Literal["srgb", "linear"] = Field(
        "srgb", description="How the backdrop, and an answer of 8 or 16 bits, encode light."
    )
    x: int = Field(0, ge=0, description="First column of a crop, in pixels of the matte.")
    y: int = Field(0, ge=0, description="First row of the crop.")
    width: int | None = Field(None, ge=1, description="Width of the crop; by default up to the edge.")
    height: int | None = Field(None, ge=1, description="Height of the crop; by default up to the edge.")
    size: int | None = Field(
        None, ge=1, description="Longer side of the answer in pixels, to scale it down. Never scales up."
    )
    enlarge: int = Field(
        1,
        ge=1,
        le=2,
        description="How many times as wide and high the answer is. It is smoother, and shows no more detail.",
    )
    quality: int = Field(90, ge=1, le=100, description="Quality of a JPEG.")
    right: float = Field(
        0, ge=-100, le=100, description="Moves the backdrop to the right, in widths of the monitor."
    )
    down: float = Field(0, ge=-100, le=100, description="Moves the backdrop down, in heights of the monitor.")
    scale: float = Field(1, ge=0.01, le=100, description="Enlarges the backdrop by this factor.")
    angle: float = Field(0, ge=-360, le=360, description="Turns the backdrop, in degrees clockwise.")

    around: Literal["nothing", "backdrop"] = Field(
        "nothing",
        description="What is shown where pixels were left out: nothing, so that a PNG is transparent and a JPEG "
        "or a video black there, or the backdrop, as the camera would see it beside the object. If a mask left them "
        "out, it is as if the frame saw the monitor and no more.",
    )
    fit: Literal["monitor", "frame"] | None = Field(
        None,
        description="`monitor`: the backdrop covers the monitor, as the patterns did, and the composite is what the "
        "camera would take. `frame`: the backdrop is a picture that the object is put into. It covers all that the "
        "frame sees, and clear glass shows it in its own colours. By default `frame` if the backdrop is shown "
        "around the glass, else `monitor`. Only mattes of an object that recovery cut out tell them apart.",
    )
    interval: bool = Field(
        False,
        description="Answer, in place of the composite, half the width of the interval that holds the true light with "
        "a probability of 90 %, by pixel and channel.",
    )
    depth: Distance | None = Field(
        None, description="Distance of the backdrop from the object, if it is not where the monitor was."
    )
    distance: Distance | None = Field(
        None, description="Distance of the monitor from the object in the capture, in the same unit."
    )
    camera: Distance | None = Field(None, description="Distance of the camera from the object.")
    other: str | None = Field(
        None,
        description="In place of `camera`: a matte of the same object, with the monitor at another distance.",
    )
    other_distance: Distance | None = Field(
        None, description="Distance of the monitor in that other capture."
    )
    webhook: str | None = Field(
        None, description="For a clip: URL, https, that is notified when the job has ended."
    )

    @model_validator(mode="after")
    def _depth_is_complete(self) -> "CompositeParams":
        given = [
            name
            for name in ("distance", "camera", "other", "other_distance")
            if getattr(self, name) is not None
        ]
        complete = given in (["distance", "camera"], ["distance", "other", "other_distance"])
        if (self.depth is not None) != bool(given) or (given and not complete):
            raise ValueError(
                "a backdrop at another depth takes depth, distance and camera, or depth, distance, other and "
                "other_distance"
            )
        if self.around == "backdrop" and self.depth is not None:
            raise ValueError("a backdrop at another depth is not shown around the glass: omit around")
        if self.interval and (self.depth is not None or self.fits_frame):
            raise ValueError(
                "intervals are those of the glass before a backdrop where the monitor was: omit depth, around and fit"
            )
        if self.size is not None and self.enlarge > 1:
            raise ValueError("size makes a picture smaller, enlarge larger: omit one of them")
        if self.other_distance is not None and self.other_distance == self.distance:
            raise ValueError("the two distances must differ")
        return self

    @property
    def placement(self) -> Placement | None:
        """Where the backdrop is; None if it is where the monitor was."""
        placement = Placement(self.right, self.down, self.scale, self.angle)
        return None if placement == Placement() else placement

    @property
    def fits_frame(self) -> bool:
        """Whether the backdrop is fitted to the frame."""
        return self.fit == "frame" or (self.fit is None and self.around == "backdrop")

    def placement_behind(self, matte: Matte) -> Placement | None:
        """Where the backdrop stands behind a matte; None if it is stretched over the monitor."""
        return over_frame(matte, self.placement) if self.fits_frame else self.placement

    def clip_options(self) -> dict[str, Any]:
        """The options of a clip's job.

        Raises
        ------
        OptionError
            If a parameter is given that only stills have.
        """
        placement = {"right": self.right, "down": self.down, "scale": self.scale, "angle": self.angle}
        for name in self.model_fields_set - placement.keys() - {"transfer", "around", "fit", "webhook"}:
            raise OptionError(
                f"{name} is for stills: a clip takes transfer, around, fit, {', '.join(placement)}",
                field=name,
            )
        fit = "frame" if self.fits_frame else "monitor"
        return {"transfer": self.transfer, "around": self.around, "fit": fit, "placement": placement}
