"""How a capture turned out: what was measured, what was found, what to do."""
