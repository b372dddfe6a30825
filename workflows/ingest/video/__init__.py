"""Videos of programs: which frames show which pattern."""
