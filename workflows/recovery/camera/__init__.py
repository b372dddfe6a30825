"""What a camera adds to the light of the monitor: S and rho, crosstalk, noise."""
