"""The dask cluster: scheduler, workers, and what hands tasks to them."""
