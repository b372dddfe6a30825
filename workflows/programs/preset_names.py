"""Names and descriptions of the presets, apart from their patterns, which take longer to import."""

PRESETS = {
    "default": "140 frames, black and white: the best mattes, whatever the glass.",
    "quick": "61 frames: clear glass, in half the time.",
    "sketch": "37 frames: a first look at the set-up.",
    "paper-250": "282 frames: the program of the paper, for comparison.",
    "paper-400": "432 frames: the longest program of the paper.",
}
