"""The HTTP API: `services.api.app` builds it, one room for each group of resources."""
