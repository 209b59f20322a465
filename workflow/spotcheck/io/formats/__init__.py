"""Readers of image files, one module per format.

In: the path of a file. Out: the headers of its pages, and the pixels [row, column] of one page.
"""
