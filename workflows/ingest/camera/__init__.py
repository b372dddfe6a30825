"""What the camera does to light: its tone curve, its exposure, its noise, its crosstalk."""
