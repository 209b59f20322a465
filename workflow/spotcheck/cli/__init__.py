"""The command line: one subcommand a stage, each in a module of its name.

A subcommand module has `arguments(parser)` and `run(args)`. It parses, calls the library and writes; only the module
that is asked for is imported, because imports are most of a short job's time.
"""

import argparse
import difflib
import importlib
import io
import os
import signal
import sys
import threading
from collections.abc import Sequence

import spotcheck

COMMANDS = {
    "look": "first look at images that nobody has described: widths with errors, shape, clip, gain, M²",
    "check": "check a dataset folder against the contract, without decoding a pixel",
    "ingest": "record digest, shape and extremes of every frame",
    "crop": "crop every spot and reduce the frame around it",
    "transfer": "characterise the sensor by flats and darks (EMVA 1288)",
    "sensor": "settle the sensor: data sheet where it speaks, frames where they allow",
    "maps": "map offsets and gains of the sensor's pixels by its darks and flats",
    "fit": "fit a 2D Gaussian to every crop",
    "calibrate": "p1, p2 and the peak from fits and frames",
    "simulate": "the paper's model at the calibrated parameters, or an extended one, as a dataset folder",
    "metrics": "metrics of measured and simulated frames side by side",
    "bounds": "Cramér-Rao bounds over exposure and photons",
    "precision": "scatter over repeats against the bound, and the best exposure",
    "caustic": "waist, divergence and M² of a scan along z",
    "judge": "find where model and measurement disagree and what is missing, and write the verdict",
    "flats": "write verdict.json of a dataset without spots",
    "views": "what each model expects of each measured frame, for the report to show side by side",
    "figures": "every figure that the results support",
    "chain": "draw the rule graph of the workflow",
    "paper": "compare the paper's numbers with what the workflow computed",
    "equations": "tables of equations and symbols from the docstrings",
    "effects": "the page of effects, from the effects' own files",
    "report": "one self-contained page of figures, tables and what was skipped",
    "compare": "one page of several datasets: what changed beyond its errors, and trends",
    "new-dataset": "make a dataset of a folder of images: read what they say, ask for the rest",
    "adopt": "write what results say of the instrument into an instrument file, value by value",
    "correct": "write frames in electrons of the light, linear and with their variance",
    "explain": "say where a number of the results comes from: file, variable, rule and inputs",
    "limits": "how large each effect that a verdict does not name could still be, and how many frames would halve that",
    "where": "say where the results of a dataset lie",
    "open": "open the page of a dataset or of results in the browser",
}

# What a person wants of them; main help lists them so.
GROUPS = {
    "a first look": ("look", "open"),
    "your own data": ("new-dataset", "check", "adopt", "correct"),
    "questions about results": ("where", "explain", "limits", "compare"),
    "stages of the workflow, in their order": (
        *(
            "ingest",
            "crop",
            "transfer",
            "sensor",
            "maps",
            "fit",
            "calibrate",
            "simulate",
            "metrics",
            "bounds",
            "precision",
        ),
        *("caustic", "judge", "flats", "views", "figures", "report"),
    ),
    "the paper, and pages of the documentation": ("paper", "equations", "chain", "effects"),
}


def main(argv: list[str] | None = None) -> None:
    """Entry point. What the user can mend ends in one sentence and status 2."""
    from spotcheck.errors import InputError
    from spotcheck.io import progress

    # A terminal may know neither ° nor µ: then the sign's number is printed, not a traceback.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if threading.current_thread() is threading.main_thread():
        # An end that was asked for takes with it what is half written.
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        with progress.shown():
            run(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
    except BrokenPipeError:
        # Who reads has seen enough (`| head`), and what is left to print has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    except InputError as error:
        sys.exit(_say(str(error)))
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except OSError as error:
        if error.filename is None:
            raise
        sys.exit(
            _say(f"{error.filename}: cannot be read or written ({error.strerror}); mend that, or name another place")
        )


def run(words: Sequence[str]) -> None:
    """Run the subcommand that the words of a command line name. Raises `InputError` for what the user can mend."""
    args = parse(words)
    args.run(args)


def parse(words: Sequence[str]) -> argparse.Namespace:
    """What the words of a command line say: the values of its arguments, and `run`, which takes them. Raises
    `InputError` for a subcommand that is none."""
    from spotcheck.errors import InputError

    parser = argparse.ArgumentParser(
        prog="spotcheck",
        usage="%(prog)s COMMAND …",
        description="How a camera sees a laser spot, and what a model of it is missing.",
        epilog=f"{_grouped()}\n\nNew here? spotcheck look IMAGE… needs nothing but images.\n"
        "spotcheck COMMAND --help shows an example.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"spotcheck {spotcheck.__version__}")
    subparsers = parser.add_subparsers(dest="command", prog="spotcheck", required=True, help=argparse.SUPPRESS)
    asked = next((word for word in words if word in COMMANDS), None)
    for name, text in COMMANDS.items():
        own = subparsers.add_parser(
            name,
            description=f"{text[0].upper()}{text[1:]}.",
            # Examples keep their lines.
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == asked:
            module = importlib.import_module(f"spotcheck.cli.{name.replace('-', '_')}")
            module.arguments(own)
            own.set_defaults(run=module.run)
    if not words:
        parser.print_help()
        parser.exit(2)
    if asked is None and not words[0].startswith("-"):
        near = difflib.get_close_matches(words[0], COMMANDS, 1)
        meant = f"is it {near[0]}? " if near else ""
        raise InputError(f"{words[0]}: is no subcommand; {meant}`spotcheck --help` lists them")
    return parser.parse_args(words)


def _grouped() -> str:
    """Every subcommand with its sentence, by what a person wants."""
    return "\n\n".join(
        "\n".join([f"{title}:", *(f"  {name:14}{COMMANDS[name]}" for name in names)]) for title, names in GROUPS.items()
    )


def _say(sentence: str) -> int:
    print(f"spotcheck: {sentence}", file=sys.stderr)
    return 2
