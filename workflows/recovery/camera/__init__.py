"""What a camera does to the light of the monitor: S and rho, crosstalk, noise, perspective."""
