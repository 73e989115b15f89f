"""Independent tasks on this computer's processes or on a Dask cluster."""
