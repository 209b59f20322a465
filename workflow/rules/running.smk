# One run at a time in each folder of results, and no step by hand after a run that was killed: what it left behind goes
# before a job is planned. Snakemake's own lock tells no dead run from a live one, and the folder that it is of may serve
# other runs.
from base64 import urlsafe_b64decode
from shutil import rmtree

from spotcheck.io import run_control

# Dry runs, and what a job of a run asks of Snakemake, write nothing and wait for nobody.
PLANS = workflow.output_settings.dryrun or not workflow.is_main_process or run_control.TOKEN_VARIABLE in os.environ
RUN = run_control.make_token()
RESULTS = {name: Path(config["results"], name).absolute() for name in DATASETS}
# Snakemake's notes on the files of runs.
STATE = Path(".snakemake").absolute()
# What this run holds: results folders, by dataset, with the streams of their notes.
HELD = {}


def hold(name):
    """Hold the results of a dataset, once."""
    if name not in HELD and (stream := run_control.lock_results(RESULTS[name], RUN)):
        HELD[name] = stream


def is_of(path, names):
    """Whether a file is a result of one of these datasets, their comparison, or a frame that the rig makes for it."""
    folders = [RESULTS[name] for name in names] + [DATASETS[name].folder for name in names if has_rig(DATASETS[name])]
    file = Path(path).absolute()
    compared = file.with_suffix("") == Path(config["results"], "comparison").absolute()
    return compared or any(file.is_relative_to(folder) for folder in folders)


def locks_on(names):
    """Snakemake's locks on files of these datasets."""
    return [lock for lock in STATE.glob("locks/*.lock") if any(is_of(path, names) for path in locked_by(lock))]


def locked_by(lock):
    """Files that a lock is on; none where its run ends just now."""
    try:
        return lock.read_text().splitlines()
    except FileNotFoundError:
        return []


def forget_dead_runs():
    """Drop Snakemake's locks on what this run holds, and what was being made when a run died. A whole file that replaced
    an earlier result stays: Snakemake's records tell whether it must be made again."""
    for lock in locks_on(HELD):
        lock.unlink(missing_ok=True)
    for mark in (path for path in STATE.glob("incomplete/**/*") if path.is_file()):
        # Snakemake files a mark under the name of the output, and cuts a long one into folders that start with @.
        own = mark.relative_to(STATE / "incomplete")
        made = Path(urlsafe_b64decode("".join(part.removeprefix("@") for part in own.parts)).decode())
        if is_of(made, HELD):
            if made.is_dir():
                rmtree(made)
            elif not (STATE / "metadata" / own).is_file():
                made.unlink(missing_ok=True)
            mark.unlink()
    for name in HELD:
        run_control.remove_scratch_files(RESULTS[name])
        if has_rig(DATASETS[name]):
            run_control.remove_scratch_files(DATASETS[name].folder / "frames")


if not PLANS:
    try:
        # A run notes that it is there after Snakemake has locked its files: one that died in between left a lock alone.
        for name in DATASETS:
            if run_control.get_lock_path(RESULTS[name]).exists() or locks_on([name]):
                hold(name)
        forget_dead_runs()
    except InputError as error:
        sys.exit(f"spotcheck: {error}")


# Planning writes nothing; a run notes in each results folder whose it is, and that it is there.
onstart:
    if not PLANS:
        try:
            for name, found in DATASETS.items():
                store.claim(Path(config["results"], name), found.folder)
                hold(name)
        except InputError as error:
            sys.exit(f"spotcheck: {error}")
        os.environ[run_control.TOKEN_VARIABLE] = RUN
        run_control.end_jobs_on_signal(RUN)


onsuccess:
    for name in DATASETS:
        if (page := Path(config["results"], name, "report.html")).exists():
            print(f"{name}: look at {page}")
