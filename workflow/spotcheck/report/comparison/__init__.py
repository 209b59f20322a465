"""Comparison of datasets: read their numbers, test differences and trends for significance, and write the table.

Input: results folders of two or more datasets; the first is the reference.
Output: a `Comparison`, stored as comparison.nc and shown on comparison.html.
"""
