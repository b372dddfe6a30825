"""Clusters of a row of T: as Gaussians, and which of them merge."""
