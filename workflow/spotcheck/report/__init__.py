"""Figures, pages, comparison of datasets, and the provenance of each number.

In: the results of one or more datasets. Out: figures, report.html, comparison.html, views.nc. Nothing here computes
what another stage could store.
"""
