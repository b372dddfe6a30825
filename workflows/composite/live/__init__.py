"""What a browser draws the glass from."""
