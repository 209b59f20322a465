"""Compare the numbers and statements that the paper prints with those of the default dataset.

In: published.yaml and a results folder. Out: one check per entry of published.yaml. The `id` of an entry names the
function of this package that computes our value from the results.
"""
