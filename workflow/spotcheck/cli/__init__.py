"""Command line: one subcommand per stage of the workflow, each in a module of its name.

In: the words of a command line. Out: files of results, and text for the terminal. A subcommand module has
`add_arguments(parser)` and `run(args)`: it parses, calls the library and writes. The help shows the examples in its
docstring. Only the module of the chosen subcommand is imported, because imports dominate the time of a short job.
"""

import argparse
import difflib
import importlib
import io
import os
import signal
import sys
import textwrap
import threading
from collections.abc import Sequence

import spotcheck

# Title of a group in the main help → subcommand → sentence that says what it does.
GROUPS = {
    "a first look": {
        "look": "measure images without a description: widths with errors, shape, clip, gain, M²",
        "open": "open the page of a dataset or of results in the browser",
    },
    "your own data": {
        "new-dataset": "make a dataset from a folder of images: read what their files state, ask for the rest",
        "check": "check a dataset folder against the contract, with a sample of its frames",
        "adopt": "write what the results say about the instrument into an instrument file, value by value",
        "correct": "write the frames in electrons, linearized and with their variance",
    },
    "questions about results": {
        "where": "list where the results of a dataset are",
        "explain": "show where a number of the results comes from: file, variable, rule and inputs",
        "limits": "list upper limits of the effects that a verdict does not name, and the frames that would halve them",
        "compare": "compare datasets on one page: changes beyond their errors, and trends",
    },
    "stages of the workflow, in their order": {
        "ingest": "record digest, shape and extremes of every frame",
        "crop": "crop every spot and reduce the frame around it",
        "transfer": "characterise the sensor by flats and darks (EMVA 1288)",
        "sensor": "choose the sensor's parameters: from the data sheet if it states them, else from the frames",
        "maps": "map offsets and gains of the sensor's pixels by its darks and flats",
        "fit": "fit a 2D Gaussian to every crop",
        "calibrate": "fit p1, p2 and the peak from fits and frames",
        "simulate": "simulate the calibrated model of the paper, or an extended model, as a dataset folder",
        "metrics": "compute metrics of measured and simulated frames side by side",
        "bounds": "compute Cramér-Rao bounds over exposure and photons",
        "precision": "compare the scatter over repeats with the bound, and find the best exposure",
        "caustic": "fit waist, divergence and M² of a scan along z",
        "judge": "find where model and measurement disagree and what is missing, and write the verdict",
        "flats": "write verdict.json of a dataset without spots",
        "extended": "simulate the model with the verdict's effects, and compare its metrics with the measured ones",
        "views": "compute what each model expects of each measured frame, for the report",
        "figures": "draw every figure that the results support",
        "report": "write one self-contained page of figures, tables and skipped parts",
    },
    "the paper, and pages of the documentation": {
        "paper": "compare the paper's numbers with those of the workflow",
        "equations": "write tables of equations and symbols from the docstrings",
        "effects": "write the page of effects from the effects' own files",
    },
}
# Heading of the command lines at the end of a module's docstring, which its help shows.
EXAMPLES_HEADING = "Examples\n--------\n"
# Subcommand → its sentence, in the order of the main help.
COMMANDS = {name: sentence for commands in GROUPS.values() for name, sentence in commands.items()}


def main(argv: list[str] | None = None) -> None:
    """Run the command line, and end the process with an exit status other than 0 if it fails.

    After an error that the user can correct, one sentence is printed and the status is 2. After a signal the status is
    128 plus the number of the signal. `argv` are the words after the name of the program; None takes those of the
    process.
    """
    from spotcheck.errors import InputError
    from spotcheck.io import progress

    # A terminal whose encoding lacks ° or µ shows an escape sequence, where `print` would fail.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if threading.current_thread() is threading.main_thread():
        # `sys.exit` raises SystemExit, so that half-written files are removed on the way out.
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        with progress.shown():
            run(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader has closed the pipe (`| head`). Python flushes stdout again at exit, which must not fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    except InputError as error:
        _exit_with(str(error))
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except OSError as error:
        if error.filename is None:
            raise
        _exit_with(
            f"{error.filename}: cannot be read or written ({error.strerror}); correct that, or name another place"
        )


def run(words: Sequence[str]) -> None:
    """Run the subcommand of a command line, given as the words after the name of the program.

    Raises `InputError` for an error that the user can correct.
    """
    args = parse(words)
    args.run(args)


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the parsed arguments of a command line; their attribute `run` is the function of the subcommand's module.

    `words` are the words after the name of the program. Without words, the help is printed, and the process exits with
    status 2, as it does for wrong arguments. Raises `InputError` for an unknown subcommand.
    """
    from spotcheck.errors import InputError

    parser = argparse.ArgumentParser(
        prog="spotcheck",
        usage="%(prog)s COMMAND …",
        description="How a camera sees a laser spot, and what a model of it is missing.",
        epilog=f"{_list_commands()}\n\nNew here? spotcheck look IMAGE… needs nothing but images.\n"
        "spotcheck COMMAND --help shows an example.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"spotcheck {spotcheck.__version__}")
    # No help for the subcommands, since the epilog lists them.
    subparsers = parser.add_subparsers(dest="command", prog="spotcheck", required=True, help=argparse.SUPPRESS)
    # Options of the program may stand before the subcommand.
    command = next((word for word in words if word in COMMANDS), None)
    for name, sentence in COMMANDS.items():
        subparser = subparsers.add_parser(
            name,
            description=f"{sentence[0].upper()}{sentence[1:]}.",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == command:
            module = importlib.import_module(f"spotcheck.cli.{name.replace('-', '_')}")
            examples = (module.__doc__ or "").partition(EXAMPLES_HEADING)[2].rstrip()
            subparser.epilog = f"Examples:\n{textwrap.indent(examples, '  ')}"
            module.add_arguments(subparser)
            subparser.set_defaults(run=module.run)
    if not words:
        parser.print_help()
        parser.exit(2)
    if command is None and not words[0].startswith("-"):
        similar = difflib.get_close_matches(words[0], COMMANDS, 1)
        hint = f"is it {similar[0]}? " if similar else ""
        raise InputError(f"{words[0]}: is no subcommand; {hint}`spotcheck --help` lists them")
    return parser.parse_args(words)


def _list_commands() -> str:
    """Return the text that lists every subcommand with its sentence, under the titles of the groups."""
    return "\n\n".join(
        "\n".join([f"{title}:", *(f"  {name:14}{sentence}" for name, sentence in commands.items())])
        for title, commands in GROUPS.items()
    )


def _exit_with(sentence: str) -> None:
    """Print a sentence to standard error, and exit with status 2."""
    print(f"spotcheck: {sentence}", file=sys.stderr)
    sys.exit(2)
