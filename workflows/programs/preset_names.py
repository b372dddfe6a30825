"""The presets in words. Their patterns are in `workflows.programs.presets`, whose import takes longer."""

PRESETS = {
    "default": "132 frames, black and white: the best mattes, whatever the glass.",
    "quick": "56 frames in colour: for clear glass, and for who can't wait.",
    "sketch": "32 frames in colour: a first look at the set-up.",
    "paper-250": "282 frames: the program of the paper, to compare with it.",
    "paper-400": "432 frames: the same at its longest.",
}
