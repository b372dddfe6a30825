"""From a bundle, the archive that a user uploads, to a frame stack."""
