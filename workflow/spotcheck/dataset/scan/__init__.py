"""Conversion of a folder of images into a dataset: frames, their metadata, and the rows of a manifest.

In: a folder of images and the user's answers. Out: a `ManifestDraft`, and lines of text that summarize it.
"""
