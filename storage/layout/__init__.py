"""How captures, mattes and composites are laid out as arrays and bytes."""
