"""The verdict on a folder in one call: the stages of the workflow one after another, without its engine."""

import io
import json
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from spotcheck import cli
from spotcheck.cli import vocabulary
from spotcheck.dataset.folder import Dataset, load
from spotcheck.io import store
from spotcheck.model.effects import Choice, choose, chosen

# Subcommands that take a vocabulary.
OF_THE_VERDICT = ("flats", "judge")


def judge_dataset(
    folder: str | Path,
    results: str | Path | None = None,
    *,
    effects: Sequence[str | Path] = (),
    only: Sequence[str] = (),
    without: Sequence[str] = (),
) -> dict[str, Any]:
    """Say what the simulation of a dataset is missing.

    Compares frames and model pixel by pixel, looks for the physical effects that explain what is left, and tests them
    on held-out frames. A dataset of flats and darks alone is judged by its levels of light.
    workflow/docs/verdict.md tells how; these are the stages that `snakemake verdict` runs, and the verdict is the same.

    Parameters
    ----------
    folder : dataset folder, with manifest.csv, instrument.yaml and frames.
    results : folder of results. All files go to a folder in it that is named like the dataset, among them verdict.json,
        model.yaml (which `simulate_dataset` takes) and discrepancy.nc. By default everything is temporary.
    effects : Python files that each add an effect to the vocabulary (docs/effects.md, "Adding an effect").
    only, without : the only effects to know, or effects to leave out, by name.

    Returns
    -------
    dict
        The content of verdict.json. `status` is "consistent", "named", "named_more_remains", "ambiguous", "unknown",
        "not_converged" or "not_assessed", `effects` has names and values of what was added to the model, `gap` how far
        that closed the gap on held-out frames, `advice` what to measure next, and `sentence` the whole in words.

    Raises
    ------
    InputError
        A folder that breaks the dataset contract, frames that cannot be read, a folder of results that is another's, an
        effect or a vocabulary that is not sound.

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
    dataset, before = load(folder), chosen()
    known = vocabulary.options(Choice(tuple(map(str, effects)), tuple(only), tuple(without)))
    with TemporaryDirectory(prefix="spotcheck-") as scratch:
        base = Path(scratch if results is None else results)
        out = base / dataset.name
        store.claim(out, dataset.folder)
        try:
            for command, options in _stages(dataset, out):
                words = [word for key, value in options.items() for word in (f"--{key}", str(value))]
                words += known if command in OF_THE_VERDICT else []
                # What a subcommand says is for a terminal.
                with redirect_stdout(io.StringIO()):
                    cli.run([command, str(dataset.folder), *words])
        finally:
            choose(before)
        return json.loads((out / "verdict.json").read_text(encoding="utf-8"))


def _stages(dataset: Dataset, out: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Subcommands with their options, in the order of the workflow's rules."""
    frames, crops, transfer, sensor = (out / f"{name}.nc" for name in ("frames", "crops", "transfer", "sensor"))
    verdict = out / "verdict.json"
    yield "ingest", {"output": frames}
    measured = {}
    if len(dataset.spots) < len(dataset.frames):
        yield "transfer", {"frames": frames, "output": transfer}
        measured = {"transfer": transfer}
    if not dataset.spots:
        yield "flats", {"frames": frames, "output": verdict}
        return
    yield "crop", {"frames": frames, "output": crops}
    yield "sensor", {"crops": crops, "frames": frames, **measured, "output": sensor}
    fits = out / "fits.nc"
    maps = {}
    if any(frame.kind == "dark" for frame in dataset.frames):
        maps = {"maps": out / "maps.nc"}
        yield "maps", {"frames": frames, "output": maps["maps"]}
    yield "fit", {"crops": crops, "sensor": sensor, **maps, "output": fits}
    beside = {"pictures": out / "discrepancy.nc", "model": out / "model.yaml", "light": out / "light.nc"}
    yield "judge", {"crops": crops, "fits": fits, "sensor": sensor, **beside, "output": verdict}
