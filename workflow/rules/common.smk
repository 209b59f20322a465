# The dataset of this run, checked before any rule is planned, and the two functions that rules share.
import json
import os
import sys
from pathlib import Path

from spotcheck import dataset as contract
from spotcheck import store
from spotcheck.cli import COMMANDS
from spotcheck.crops import check_dataset
from spotcheck.errors import InputError
from spotcheck.schema import breach_of
from spotcheck.simulation import STACK
from spotcheck.provenance import code_digest, file_digest, notebook_modules

# Rules call `spotcheck`, `rig` and `papermill` of the environment that runs this file, whether it is active or not.
os.environ.update(PATH=os.pathsep.join([str(Path(sys.executable).parent), *os.get_exec_path()]))

# A dataset or folder may be called 2024.
config |= {key: str(config[key]).rstrip(os.sep) for key in ("dataset", "results") if key in config}

try:
    if breach := breach_of(config, "config"):
        raise InputError(f"config: {breach}")
    DATASET = contract.load(contract.find(config["dataset"], Path(workflow.basedir) / "data"))
    # A folder with rig.yaml holds a plan for the virtual rig, which makes the frames.
    HAS_RIG = (DATASET.folder / "rig.yaml").exists()
    if not HAS_RIG:
        check_dataset(DATASET)
    OUT = f"{config['results']}/{DATASET.name}"
    store.claim(Path(OUT), DATASET.folder)
except InputError as error:
    sys.exit(f"spotcheck: {error}")

SPOTS = bool(DATASET.spots)
FLATS = any(frame.kind in ("flat", "dark") for frame in DATASET.frames)
FRAMES = sorted({str(DATASET.folder / frame.file) for frame in DATASET.frames})
MANIFEST = str(DATASET.folder / "manifest.csv")
INSTRUMENT = [str(path) for path in [DATASET.folder / "instrument.yaml"] if path.exists()]
# The paper's numbers are compared on the data set that was made for it.
IS_PAPER = DATASET.folder == Path(workflow.basedir) / "data" / "virtual-rig"
NOTEBOOKS = sorted(path.stem for path in (Path(workflow.basedir) / "notebooks").glob("*.ipynb"))
RULES = sorted(file_digest(path)[:12] for path in Path(workflow.basedir, "workflow", "rules").glob("*.smk"))

# The files that pictures, tables, notebooks and the report are made from.
RESULTS = [f"{OUT}/frames.nc"] + ([f"{OUT}/transfer.nc"] if FLATS else [])
if SPOTS:
    stages = (
        "crops",
        "sensor",
        "fits",
        "calibration",
        "simulated",
        "metrics",
        "bounds",
        "precision",
        "discrepancy",
    )
    RESULTS += [f"{OUT}/{name}.nc" for name in stages]
    RESULTS += [f"{OUT}/caustic.nc"] if "z_m" in DATASET.instrument.conditions else []
else:
    RESULTS += [f"{OUT}/verdict.json"]


def dataset_folder(wildcards):
    """Folder of the dataset."""
    return str(DATASET.folder)


def results_folder(wildcards):
    """Folder of its results."""
    return OUT


def simulated_folder(wildcards):
    """Folder of the simulated dataset."""
    return f"{OUT}/simulated"


def code(*commands):
    """Digest of all that the subcommands import: an edit re-runs just the stages that it touches."""
    return code_digest(*(f"spotcheck.cli.{name.replace('-', '_')}" for name in commands))


def notebook_code(notebook):
    """Digest of the library modules that a notebook imports."""
    return code_digest(*notebook_modules(Path(workflow.basedir, "notebooks", f"{notebook}.ipynb")))


def notebooks():
    """The executed notebooks."""
    return [f"{OUT}/notebooks/{name}.ipynb" for name in NOTEBOOKS]
