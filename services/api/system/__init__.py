"""The service itself over HTTP: health, cluster, metrics, limits, pages."""
