"""Benchmarks: estimator and simulator against other packages, accuracy, convergence and growth.

`python -m tests.validation.benchmarks.run` runs all parts or those that are named.
"""

import os

# One core for everybody; libraries read this when they are loaded, so it stands before any of them.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"
