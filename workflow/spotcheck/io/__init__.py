"""Reading and writing of files: images, YAML, netCDF results and text.

In: paths. Out: pixels [row, column], validated YAML content, xarray datasets with units and provenance. All files are
written atomically.
"""
