"""The posterior mean of T, the linear equations that give it, and the evidence for it."""
