"""Pictures written band by band, so that a large one takes little memory."""
