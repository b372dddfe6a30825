"""The fit of lobes to the measurements of a pixel."""
