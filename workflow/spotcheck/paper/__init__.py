"""Compare the numbers and statements that the paper prints with those of the default dataset.

In: published.yaml and a results folder. Out: one check per entry, whose `id` names the function here that computes
it from the results.
"""
