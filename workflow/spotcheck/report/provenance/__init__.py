"""Provenance of the results: look up a number by name and report its file, variable, rule and inputs.

A rule is a step of the workflow (Snakefile), which calls a subcommand of `spotcheck` to write result files.
Input: a results folder and a name such as `p1` or `fits.sigma_mean[frame=a000_r0_t100us]`.
Output: a `Number`, or the texts that `spotcheck explain` and the report show.
"""

from spotcheck.report.provenance.lookup import find_number, frame_hover_text, hover_text, list_numbers, list_tables
from spotcheck.report.provenance.records import Input, Number, Source

__all__ = [
    "Input", "Number", "Source", "find_number", "frame_hover_text", "hover_text", "list_numbers", "list_tables",
]  # fmt: skip
