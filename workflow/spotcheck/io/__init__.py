"""Files of every kind: images, YAML, netCDF results and whatever else is read or written.

In: paths. Out: pixels [row, column], checked YAML content, xarray datasets with units and provenance. A file
appears whole or not at all.
"""
