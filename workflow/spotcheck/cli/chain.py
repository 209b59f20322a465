"""`spotcheck chain`: draws the rule graph of the workflow (which stage needs which) as SVG and PNG."""

import argparse
import sys
from pathlib import Path

from spotcheck.errors import InputError
from spotcheck.report.figures import chain, style

EXAMPLES = """snakemake --rulegraph > rules.dot
spotcheck chain rules.dot --output out/my-frames/chain/fig06"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dot", help="output of `snakemake --rulegraph`; - reads standard input")
    parser.add_argument("--output", required=True, help="path to write to, without .svg and .png")


def run(args: argparse.Namespace) -> None:
    """Read the rule graph and draw it. Raises `InputError` if its file does not exist."""
    if args.dot == "-":
        text = sys.stdin.read()
    else:
        try:
            text = Path(args.dot).read_text(encoding="utf-8")
        except FileNotFoundError:
            raise InputError(f"{args.dot}: is not there; write it with `snakemake --rulegraph > {args.dot}`") from None
    graph = chain.parse_graph(text)
    output = Path(args.output)
    with style.house_style():
        style.save_drawing(chain.draw_chain(graph), output.parent, output.name)
    print(f"{len(graph.labels)} stages drawn")
