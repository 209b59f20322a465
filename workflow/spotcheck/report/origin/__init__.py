"""Where a number comes from: the file, variable, rule and inputs of every number of the results."""

from spotcheck.report.origin.ask import hover, hover_of_frame, keys, of, tables
from spotcheck.report.origin.number import Input, Number, Source

__all__ = ["Input", "Number", "Source", "hover", "hover_of_frame", "keys", "of", "tables"]
