"""A dataset's folder: manifest, instrument, frames; and how a folder of images becomes one.

In: a folder with manifest.csv, instrument.yaml and images, or images alone. Out: a checked `Dataset` with the grid that
its spots span, and readings [row, column] in DN of each frame.
"""
