"""Guards for files from strangers."""
