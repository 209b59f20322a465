# One run at a time in each folder of results, and no step by hand after a run that was killed: what it left behind goes
# before a job is planned. Snakemake's own lock tells no dead run from a live one, and the folder that it is of may serve
# other runs.
from base64 import urlsafe_b64decode
from shutil import rmtree

from spotcheck import running

# Dry runs, and what a job of a run asks of Snakemake, write nothing and wait for nobody.
PLANS = workflow.output_settings.dryrun or not workflow.is_main_process or running.TOKEN in os.environ
RUN = running.new_token()
RESULTS = {name: Path(config["results"], name).absolute() for name in DATASETS}
# Streams of the notes that this run holds.
HELD = {}


def hold(name):
    """Hold the results of a dataset, once."""
    if name not in HELD:
        HELD[name] = running.hold(RESULTS[name], RUN)


def is_ours(path):
    """Whether a file lies in a folder that this run holds, or is a frame that it makes."""
    folders = [*RESULTS.values(), *(found.folder for found in DATASETS.values() if has_rig(found))]
    return any(Path(path).absolute().is_relative_to(folder) for folder in folders)


def forget_dead_runs():
    """Drop Snakemake's locks on the files of this run, and what was being made when a run died: whole files that replace
    an earlier result stay, as Snakemake sees by its records whether they must be made again."""
    state = Path(".snakemake").absolute()
    for lock in state.glob("locks/*.lock"):
        if any(map(is_ours, lock.read_text().splitlines())):
            lock.unlink(missing_ok=True)
    for mark in (path for path in state.glob("incomplete/**/*") if path.is_file()):
        # Snakemake files a mark under the name of the output, and cuts a long one into folders that start with @.
        own = mark.relative_to(state / "incomplete")
        made = Path(urlsafe_b64decode("".join(part.removeprefix("@") for part in own.parts)).decode())
        if is_ours(made):
            if made.is_dir():
                rmtree(made)
            elif not (state / "metadata" / own).is_file():
                made.unlink(missing_ok=True)
            mark.unlink()


if not PLANS:
    try:
        for name in DATASETS:
            if running.note_of(RESULTS[name]).exists():
                hold(name)
        if len(HELD) == len(DATASETS):
            forget_dead_runs()
    except InputError as error:
        sys.exit(f"spotcheck: {error}")


# Planning writes nothing; a run notes in each results folder whose it is, and that it is there.
onstart:
    try:
        for name, found in DATASETS.items():
            store.claim(Path(config["results"], name), found.folder)
            hold(name)
    except InputError as error:
        sys.exit(f"spotcheck: {error}")
    os.environ[running.TOKEN] = RUN
    running.end_with_jobs(RUN)
