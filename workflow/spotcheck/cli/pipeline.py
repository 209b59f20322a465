"""Verdict on a dataset in one call: runs the stages of the workflow one after another, without Snakemake.

The verdict says whether the model of the spots agrees with the frames, and which physical effects it is missing. The
vocabulary is the list of the effects that it can name.
"""

import argparse
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from spotcheck import cli
from spotcheck.cli import effect_options
from spotcheck.dataset.folder import Dataset, load
from spotcheck.io import store
from spotcheck.model.effects import Choice, choose, chosen

# Subcommands with the options --effects, --only and --without.
COMMANDS_WITH_EFFECT_OPTIONS = ("flats", "judge")


def judge_dataset(
    folder: str | Path,
    results: str | Path | None = None,
    *,
    effects: Sequence[str | Path] = (),
    only: Sequence[str] = (),
    without: Sequence[str] = (),
) -> dict[str, Any]:
    """Judge a dataset: name the physical effects that its simulation is missing.

    The verdict compares frames and model pixel by pixel, searches for the effects that explain the residuals, and tests
    them on held-out frames. A dataset of flats and darks alone is assessed by its light levels. The page
    workflow/docs/verdict.md describes the method. `snakemake verdict` runs the same stages with the same result.

    Parameters
    ----------
    folder : str or Path
        Dataset folder, with manifest.csv, instrument.yaml and frames.
    results : str or Path, optional
        Folder of results. All files go to a folder in it that is named like the dataset, among them verdict.json,
        model.yaml (which `simulate_dataset` takes) and discrepancy.nc. By default everything is temporary.
    effects : sequence of str or Path
        Python files that each add an effect to the vocabulary (docs/effects.md, "Adding an effect").
    only, without : sequence of str
        The only effects to know, or effects to leave out, by name.

    Returns
    -------
    dict
        The content of verdict.json. `status` is "consistent", "named", "named_more_remains", "ambiguous", "unknown",
        "not_converged" or "not_assessed". `effects` has names and values of the effects that were added to the model,
        `gap` the part of the residual on held-out frames that they removed, `advice` what to measure next, and
        `sentence` a summary.

    Raises
    ------
    InputError
        A folder that breaks the dataset contract, unreadable frames, a folder of results that belongs to another
        dataset, or an invalid effect or vocabulary.

    Examples
    --------
    >>> import spotcheck
    >>> verdict = spotcheck.judge_dataset("my-flats")
    >>> verdict["status"]
    'consistent'
    >>> print(verdict["sentence"])
    The linear sensor model and the flats agree within the noise (p = 0.36).
    ...
    """
    dataset, previous_choice = load(folder), chosen()
    effect_words = effect_options.list_options(Choice(tuple(map(str, effects)), tuple(only), tuple(without)))
    with TemporaryDirectory(prefix="spotcheck-") as temporary:
        output = Path(temporary if results is None else results) / dataset.name
        # Marks the folder as results of this dataset, or raises `InputError` if it belongs to another one.
        store.claim(output, dataset.folder)
        try:
            for command, options in _list_stages(dataset, output):
                words = _format_options(options)
                words += effect_words if command in COMMANDS_WITH_EFFECT_OPTIONS else []
                # The text that subcommands print for a terminal is discarded.
                with redirect_stdout(io.StringIO()):
                    cli.run([command, str(dataset.folder), *words])
        finally:
            # The subcommands have changed the vocabulary of this process.
            choose(previous_choice)
        return json.loads((output / "verdict.json").read_text(encoding="utf-8"))


def evaluate_extended_model(args: argparse.Namespace) -> None:
    """Simulate the frames of a dataset by the extended model, and compute the metrics of the simulated frames.

    `args` are the parsed arguments of the subcommand `extended`. `dataset` is the folder of the measured dataset and
    `folder` that of the simulated one, which also gets frames.nc, crops.nc and fits.nc of the simulated frames.
    `images` and `output` are the files of mean images and of metrics to write.
    """
    folder, effect_words = str(args.folder), effect_options.list_options(effect_options.make_choice(args))
    frames, crops, fits = (f"{folder}/{name}.nc" for name in ("frames", "crops", "fits"))
    sensor_option = {"sensor": args.sensor}
    simulate_options = {
        "model": args.model,
        **sensor_option,
        "seed": args.seed,
        "folder": folder,
        "output": args.images,
    }
    # Each of the first two options has the file of the measured and that of the simulated frames.
    metrics_options = {"crops": (args.crops, crops), "fits": (args.fits, fits), **sensor_option, "output": args.output}
    for words in (
        ["simulate", args.dataset, *_format_options(simulate_options), *effect_words],
        ["ingest", folder, *_format_options({"output": frames})],
        ["crop", folder, *_format_options({"frames": frames, "output": crops})],
        # Simulated crops are fitted by the instrument file of the measured dataset, as the measured ones are.
        ["fit", args.dataset, *_format_options({"crops": crops, **sensor_option, "output": fits})],
        ["metrics", *_format_options(metrics_options)],
    ):
        cli.run(words)


def _format_options(options: Mapping[str, Any]) -> list[str]:
    """Return the words of a command line for options by name; a tuple gives several values."""
    words = []
    for name, value in options.items():
        words += [f"--{name}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def _list_stages(dataset: Dataset, output: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each subcommand with its options by name, in the order of the rules of the workflow.

    `output` is the folder of the results. Which stages run depends on the kinds of frames in the dataset.
    """
    frames, crops, transfer, sensor = (output / f"{name}.nc" for name in ("frames", "crops", "transfer", "sensor"))
    verdict = output / "verdict.json"
    yield "ingest", {"output": frames}
    transfer_option = {}
    # Frames other than spots are flats (frames of uniform light) or darks (frames without light).
    if len(dataset.spots) < len(dataset.frames):
        yield "transfer", {"frames": frames, "output": transfer}
        transfer_option = {"transfer": transfer}
    if not dataset.spots:
        yield "flats", {"frames": frames, "output": verdict}
        return
    yield "crop", {"frames": frames, "output": crops}
    yield "sensor", {"crops": crops, "frames": frames, **transfer_option, "output": sensor}
    fits = output / "fits.nc"
    maps_option = {}
    if any(frame.kind == "dark" for frame in dataset.frames):
        maps_option = {"maps": output / "maps.nc"}
        yield "maps", {"frames": frames, "output": maps_option["maps"]}
    yield "fit", {"crops": crops, "sensor": sensor, **maps_option, "output": fits}
    files = {"pictures": output / "discrepancy.nc", "model": output / "model.yaml", "light": output / "light.nc"}
    yield "judge", {"crops": crops, "fits": fits, "sensor": sensor, **files, "output": verdict}
