"""What all rooms need: checks of arguments, errors, files, tables, progress, a Dask cluster."""
