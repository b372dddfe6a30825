"""Recovery of S, rho and T from measurements: arrays in, arrays out."""
