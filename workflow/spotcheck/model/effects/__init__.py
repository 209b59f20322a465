"""The vocabulary of effects: every file in this folder is one."""

import importlib
import pkgutil
from functools import cache

from spotcheck.model.effect import Effect


@cache
def vocabulary() -> dict[str, Effect]:
    """All effects by name, in the order of their numbers."""
    names = [found.name for found in pkgutil.iter_modules(__path__)]
    effects = [importlib.import_module(f"{__name__}.{name}").EFFECT for name in names]
    return {effect.name: effect for effect in sorted(effects, key=lambda effect: effect.number)}
