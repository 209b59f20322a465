"""Metadata of image files: tags, embedded texts, sidecar files, and names of files and folders.

In: the path of an image file. Out: `MetadataEntry` records with a manifest column or instrument key, value and source.
"""
