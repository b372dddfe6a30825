"""Pattern programs: what the monitor shows."""
