"""Rival explanations of the paper's frames: forward models, the paper's evaluation chain, and their comparison.

In: printed summaries of the measured frames. Out: for each world its best parameters, the predictive log score of
held-out summaries, and predictions that would decide between worlds.
"""
