"""The default method: oriented Gaussian lobes, then the posterior mean of T."""
