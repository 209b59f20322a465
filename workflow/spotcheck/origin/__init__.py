"""Where a number comes from: the file, variable, rule and inputs of every number of the results."""

from spotcheck.origin.ask import hover, keys, of, tables
from spotcheck.origin.number import Input, Number, Source

__all__ = ["Input", "Number", "Source", "hover", "keys", "of", "tables"]
