"""Figures: one function a picture, one small module a family, one registry that names them all.

A drawing function takes the results of a dataset and returns a figure with its caption, or raises `Unavailable` with
the reason that a reader is told. Nothing here computes what another stage could store.
"""
