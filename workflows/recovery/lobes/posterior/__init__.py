"""The posterior mean of T, and the linear equations that give it."""
