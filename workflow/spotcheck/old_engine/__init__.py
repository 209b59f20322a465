"""The former discrepancy engine, with frozen copies of the forward model that it was written for.

`boundary` converts what it takes from `spotcheck.model` and what it hands back. The package will be deleted when the
new engine replaces it.
"""
