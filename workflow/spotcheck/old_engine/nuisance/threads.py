"""Work that is shared among threads, some frames each: what is heavy in it is compiled and lets others run."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

# Sums of other parts are other sums in the last digit: so many, whatever the machine.
THREADS = 2


def shared(part: Callable[[np.ndarray], Sequence[Any]], frames: int) -> list[Any]:
    """Sums of what several threads make of some frames each; `part` is given their numbers."""
    with ThreadPoolExecutor(THREADS) as pool:
        done = list(pool.map(part, np.array_split(np.arange(frames), min(THREADS, frames))))
    return [sum(own[1:], own[0]) for own in zip(*done, strict=True)]
