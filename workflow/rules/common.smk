# The datasets of this run, checked before any rule is planned, and the functions that rules share.
import json
import os
import re
import sys
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace

from spotcheck.io import configuration, store, atomic_files

from spotcheck.dataset import file_cache
from spotcheck.dataset import folder as contract
from spotcheck.cli import COMMANDS, effect_options
from spotcheck.crops.ingest import check_dataset
from spotcheck.errors import InputError
from spotcheck.model import effects
from spotcheck.model.baseline import build_baseline
from spotcheck.model.simulation import STACK
from spotcheck.io.provenance import code_digest, file_digest, list_notebook_imports

# Rules call `spotcheck`, `rig` and `papermill` of the environment that runs this file, whether it is active or not.
os.environ.update(PATH=os.pathsep.join([str(Path(sys.executable).parent), *os.get_exec_path()]))

SHELF = Path(workflow.basedir) / "data"


def opened(name):
    """A dataset by its path or its name in data/, checked as far as that goes without a pixel."""
    found = contract.load(contract.find_dataset(name, SHELF))
    # A folder with rig.yaml holds a plan for the virtual rig, which makes the frames.
    if not has_rig(found):
        check_dataset(found)
    # A profile of the light that cannot be read is said now.
    build_baseline(found.instrument, found.exposures)
    return found


def by_name(datasets):
    """Datasets by the names under which their results are filed. Raises `InputError` where two share one."""
    named = {}
    for found in datasets:
        if found.name in named and named[found.name].folder != found.folder:
            raise InputError(
                f"config: datasets {named[found.name].folder} and {found.folder} have one name,"
                " and results are filed by name; rename one or run them apart"
            )
        named[found.name] = found
    return named


def has_rig(found):
    """Whether the virtual rig makes the frames of a dataset."""
    return (found.folder / "rig.yaml").exists()


def has_flats(found):
    """Whether a dataset has flats or darks, by which the sensor is characterised."""
    return any(frame.kind in ("flat", "dark") for frame in found.frames)


try:
    config |= configuration.resolve_config(config, workflow.config_settings.config_args or ())
    DATASETS = by_name(map(opened, config["datasets"] or [config["dataset"]]))
    # A user's effects run with a user's rights, so only the configuration names them, never a dataset.
    effects.choose(effect_options.read_choice(config))
    for name, found in DATASETS.items():
        store.check_claim(Path(config["results"], name), found.folder)
except InputError as error:
    sys.exit(f"spotcheck: {error}")

# What rules of the verdict are told of the vocabulary, and by what they know that a file of it was edited.
VOCABULARY = effect_options.list_options(effects.chosen())
OWN_EFFECTS = [file_digest(path)[:12] for path in effects.chosen().files]

# Results of a dataset; rules say {dataset} and look the rest up by that name.
OUT = f"{config['results']}/{{dataset}}"
SPOTS = [name for name, found in DATASETS.items() if found.spots]
NO_SPOTS = [name for name in DATASETS if name not in SPOTS]
NOTEBOOKS = sorted(path.stem for path in (Path(workflow.basedir) / "notebooks").glob("*.ipynb"))
RULES = sorted(file_digest(path)[:12] for path in Path(workflow.basedir, "workflow", "rules").glob("*.smk"))


def one_of(names):
    """A wildcard's constraint: one of these names, or nothing where there are none."""
    return "|".join(map(re.escape, names)) or "(?!)"


wildcard_constraints:
    dataset=one_of(DATASETS),


def dataset_folder(wildcards):
    """Folder of the dataset."""
    return str(DATASETS[wildcards.dataset].folder)


def manifest(wildcards):
    """Its list of frames."""
    return f"{dataset_folder(wildcards)}/manifest.csv"


def instrument(wildcards):
    """Its data sheet, if there is one, and the files that it names: a shared one, the light's profile, a mask."""
    return [str(own) for own in DATASETS[wildcards.dataset].instrument_files if own.exists()]


def frames(wildcards):
    """Its raw frames. Their content counts (`content`), not their times, unless the rig makes them."""
    found = DATASETS[wildcards.dataset]
    return frames_of(found) if has_rig(found) else [ancient(file) for file in frames_of(found)]


def frames_of(found):
    """Files of the raw frames of a dataset."""
    return sorted({str(found.folder / frame.path) for frame in found.frames})


@cache
def content_of(name):
    """Digest of all that a dataset holds but frames that the rig makes; a run remembers what it looked at."""
    found, noted = DATASETS[name], file_cache.get_cache_path(Path(OUT.format(dataset=name)))
    wildcards = SimpleNamespace(dataset=name)
    given = [manifest(wildcards), *instrument(wildcards), *([] if has_rig(found) else frames_of(found))]
    looks = file_cache.record_files(given, file_cache.read_cache(noted))
    if not PLANS:
        file_cache.write_cache(looks, noted)
    told = [(os.path.relpath(path, found.folder), own.sha256) for path, own in looks.items()]
    return sha256(json.dumps(told).encode()).hexdigest()[:12]


def content(wildcards):
    """The same, as a parameter: results of another content are stale."""
    # A plan looks at no frame where nothing is there that could be stale.
    return content_of(wildcards.dataset) if not PLANS or content_note(wildcards) else ""


def content_note(wildcards):
    """A file that is as old as what the dataset holds, whatever its files' times: it tells what is stale where Snakemake's
    records of parameters have gone, or never were, as where results were moved."""
    note = file_cache.get_cache_path(Path(results_folder(wildcards))).with_name("content")
    if not PLANS and (not note.exists() or note.read_text() != content_of(wildcards.dataset)):
        atomic_files.write_text(note, content_of(wildcards.dataset))
    return [str(note)] if note.exists() else []


def results_folder(wildcards):
    """Folder of its results."""
    return OUT.format(dataset=wildcards.dataset)


def transfer_file(wildcards):
    """The sensor's characterisation, where the dataset has flats or darks."""
    return f"{results_folder(wildcards)}/transfer.nc" if has_flats(DATASETS[wildcards.dataset]) else []


def maps_file(wildcards):
    """Maps of the sensor's pixels, where the dataset has darks."""
    found = DATASETS[wildcards.dataset]
    return f"{results_folder(wildcards)}/maps.nc" if any(frame.kind == "dark" for frame in found.frames) else []


def results(wildcards):
    """The files that pictures, tables, notebooks and the report are made from."""
    found = DATASETS[wildcards.dataset]
    names = ["frames.nc"] + (["transfer.nc"] if has_flats(found) else [])
    if found.spots:
        names += ["crops.nc", "sensor.nc", "fits.nc", "calibration.nc", "simulated.nc", "metrics.nc", "bounds.nc"]
        names += ["precision.nc", "discrepancy.nc", "light.nc", "extended_metrics.nc", "model_comparison.csv"]
        names += ["caustic.nc"] if "z_m" in found.instrument.conditions else []
    else:
        names += ["verdict.json"]
    return [f"{results_folder(wildcards)}/{name}" for name in names]


def compared():
    """Names of the datasets to compare. Ends the run where there is one alone."""
    if len(DATASETS) < 2:
        sys.exit(
            f"spotcheck: config: {next(iter(DATASETS))} is one dataset alone; name two or more to compare,"
            ' as in --config "datasets=[before, after]"'
        )
    return list(DATASETS)


def compared_files(name):
    """What the comparison takes of a dataset: its results, its verdict, and the report that it links to."""
    wildcards, folder = SimpleNamespace(dataset=name), OUT.format(dataset=name)
    return sorted({*results(wildcards), f"{folder}/verdict.json", f"{folder}/report.html"})


def notebook_pages(wildcards):
    """Pages of the executed notebooks, which the report links, where there are spots."""
    names = NOTEBOOKS if DATASETS[wildcards.dataset].spots else []
    return [f"{results_folder(wildcards)}/notebooks/{name}.html" for name in names]


def views(wildcards):
    """What the report shows of each frame, where there are spots."""
    return f"{results_folder(wildcards)}/views.nc" if DATASETS[wildcards.dataset].spots else []


def simulated_folder(wildcards):
    """Folder of the simulated dataset."""
    return f"{results_folder(wildcards)}/simulated"


def simulated_results(wildcards):
    """What the simulated frames became, where there are spots to simulate."""
    names = ["crops.nc", "fits.nc"] if DATASETS[wildcards.dataset].spots else []
    return [f"{simulated_folder(wildcards)}/{name}" for name in names]


def paper_tables(wildcards):
    """The paper's numbers, which are compared on the dataset that was made for it."""
    is_paper = DATASETS[wildcards.dataset].folder == SHELF / "virtual-rig"
    return [f"{results_folder(wildcards)}/paper_numbers.{kind}" for kind in ("csv", "html")] if is_paper else []


def memory(megabytes):
    """What a job may take [MB], some twice of what `make load-rules` measures; one that is run again may take more."""
    return lambda wildcards, attempt: attempt * megabytes


def minutes(few):
    """How long it may take [min]: so many, and a second for each frame, which is five times the slowest stage's."""

    def of(wildcards, attempt):
        # Rules of several datasets, and of the rig, have no such wildcard.
        found = DATASETS.get(getattr(wildcards, "dataset", ""))
        frames = len(found.frames) if found else 0
        return attempt * (few + frames // 60)

    return of


def code(*commands):
    """Digest of all that the subcommands import: an edit re-runs just the stages that it touches."""
    return code_digest(*(f"spotcheck.cli.{name.replace('-', '_')}" for name in commands))


def notebook_code(notebook):
    """Digest of the library modules that a notebook imports."""
    return code_digest(*list_notebook_imports(Path(workflow.basedir, "notebooks", f"{notebook}.ipynb")))
