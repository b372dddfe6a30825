"""What stands behind the glass and around it: its light, and where it is."""
