"""Compare the numbers that the paper prints with those of the default dataset.

In: paper_numbers.yaml and a results folder. Out: one check per number, whose `id` names the function here that computes
it from the results.
"""
