"""Arguments of the stages of the workflow: the dataset folder, files of results to read, and the file to write."""

import argparse


def add_arguments(parser: argparse.ArgumentParser, *inputs: str, output: str) -> None:
    """Add the dataset folder, a required option for each file to read, and --output to a parser.

    `inputs` are names of files without ".nc", such as "crops", which are also those of the options. `output` is the
    name of the file to write.
    """
    parser.add_argument("dataset", help="dataset folder")
    for name in inputs:
        parser.add_argument(f"--{name}", required=True, help=f"{name}.nc")
    parser.add_argument("--output", required=True, help=f"{output} to write")
