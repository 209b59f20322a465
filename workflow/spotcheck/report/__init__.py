"""What people look at: figures, pages, comparison of datasets, and where each number comes from.

In: the results of one or more datasets. Out: figures, report.html, comparison.html, views.nc. Nothing here computes
what another stage could store.
"""
