"""Image files to arrays and back, tone curves and resampling."""
