"""A real Slurm of two nodes on this machine: does the workflow finish on it, with the values of a local run?

`unshare --mount python -m tests.load.slurm [--sets 20]`, as root: `make test-slurm` installs Slurm and does so. The
default dataset and so many small ones run by workflow/profiles/slurm; then a node is lost midway.
"""

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.conftest import ROOT, small_rig_dataset
from tests.load.rows import Row, write
from tests.load.values import differing, values_of

NODES = ("n1", "n2")
# What a run on the cluster may take at most [s].
PATIENCE = 5400.0
NEEDED = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "sinfo")
# Where clusters look for it, and where jobs do that Snakemake's plugin submits: it takes SLURM_CONF away.
ETC = Path("/etc/slurm")

CONFIG = """\
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
SlurmctldPort={control}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=batch_sched_delay=0,sched_interval=1
ReturnToService=2
MinJobAge=86400
SlurmdTimeout=10
KillWait=2
"""
NODE = "NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs=2 RealMemory={memory} State=UNKNOWN\n"
PARTITION = "PartitionName=main Nodes={nodes} Default=YES MaxTime=INFINITE State=UP\n"


def main() -> None:
    """Run all on the cluster, compare with a local run, lose a node."""
    parser = argparse.ArgumentParser(prog="python -m tests.load.slurm", description=__doc__)
    parser.add_argument("--sets", type=int, default=20, help="small datasets beside the default one (default 20)")
    args = parser.parse_args()
    if reason := why_not():
        print(f"skipped: {reason}")
        return
    with tempfile.TemporaryDirectory(prefix="slurm-") as base:
        sets = [small_rig_dataset(Path(base, f"set{k:02d}"), repeats=2) for k in range(args.sets)]
        names = ["virtual-rig", *map(str, sets)]
        local, far, lossy = (Path(base, name) for name in ("local", "far", "lossy"))
        for name in ("virtual-rig", *sets[:2]):
            started = time.monotonic()
            ran(["--cores", "2", "--nolock"], [str(name)], local)
            print(f"here: {name} in {time.monotonic() - started:.0f} s", flush=True)
        with cluster(Path(base, "cluster")) as nodes:
            started = time.monotonic()
            ran(on_cluster(), names, far)
            took = time.monotonic() - started
            rows = [compared("default dataset on two nodes", local / "virtual-rig", far / "virtual-rig")]
            pairs = [(values_of(where / name.name) for where in (local, far)) for name in sets[:2]]
            same = [pair for pair in pairs if not differing(*pair)]
            done = sum((far / own.name / "report.html").exists() for own in sets)
            said = f"{done} finished, all in {took / 60:.0f} min; of 2 that ran here too {len(same)} have equal values"
            rows.append(Row(f"{args.sets} datasets beside it, in one call", args.sets, said))
            rows.append(lost_node(nodes, sets[0], local / sets[0].name, lossy))
    write("slurm", rows)


def why_not() -> str:
    """Why no cluster can be started here; "" where it can."""
    if os.geteuid():
        return "Slurm's daemons need root"
    missing = [name for name in NEEDED if not shutil.which(name)]
    return f"{', '.join(missing)} is not installed" if missing else ""


def on_cluster() -> list[str]:
    """Options of a run on the cluster: the profile, and what a cluster without accounting wants besides."""
    # `squeue` is asked, for `sacct` of a cluster without accounting never answers.
    return ["--workflow-profile", "workflow/profiles/slurm", "--nolock", "--slurm-status-command", "squeue",
            "--slurm-no-account", "--slurm-init-seconds-before-status-checks", "2",
            "--seconds-between-status-checks", "2"]  # fmt: skip


def ran(options: Sequence[str], names: Sequence[str], results: Path) -> None:
    """The documented call on datasets. RuntimeError with its last lines where it fails."""
    process = begun(options, names, results)
    said, _ = process.communicate(timeout=PATIENCE)
    if process.returncode:
        raise RuntimeError(f"snakemake {' '.join(options[:2])} failed:\n" + "\n".join(said.splitlines()[-30:]))


def begun(options: Sequence[str], names: Sequence[str], results: Path) -> subprocess.Popen[str]:
    """The same, not waited for."""
    config = [f"datasets=[{', '.join(names)}]", f"results={results}"]
    command = [sys.executable, "-m", "snakemake", *options, "--config", *config]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def compared(what: str, here: Path, there: Path) -> Row:
    """A row on whether a run there gave the values of one here."""
    off = differing(values_of(here), values_of(there))
    return Row(what, 1, f"differs in {', '.join(off[:5])}" if off else "values equal to the local run's")


def lost_node(nodes: dict[str, subprocess.Popen], name: Path, here: Path, results: Path) -> Row:
    """A node is killed, with all that runs on it, while its jobs run."""
    process = begun(on_cluster(), [str(name)], results)
    lost = NODES[1]
    deadline = time.monotonic() + 300
    while not running_on(lost) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.5)
    jobs = running_on(lost)
    os.killpg(nodes[lost].pid, signal.SIGKILL)
    for job in jobs:
        # Steps have sessions of their own, which die with a node.
        subprocess.run(["pkill", "-KILL", "-f", f"slurmstepd: \\[{job}"], check=False)
        subprocess.run(["pkill", "-KILL", "-f", f"job{job}/slurm_script"], check=False)
    subprocess.run(["scontrol", "update", f"nodename={lost}", "state=down", "reason=lost"], check=True)
    said, _ = process.communicate(timeout=PATIENCE)
    if process.returncode:
        return Row("a node lost midway", 1, f"the run failed: {said.strip().splitlines()[-1]}")
    row = compared("a node lost midway", here, results / name.name)
    words = f"{len(jobs)} job{'s' if len(jobs) != 1 else ''} lost with it and run again"
    return row._replace(happened=f"{words}; {row.happened}")


def running_on(node: str) -> list[str]:
    """Jobs that run on a node."""
    command = ["squeue", "--noheader", "--states=R", f"--nodelist={node}", "--format=%i"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()


@contextmanager
def cluster(folder: Path) -> Iterator[dict[str, subprocess.Popen]]:
    """Munge, a controller and two nodes; ends them all. Nodes by name."""
    folder.mkdir()
    folder.chmod(0o755)
    (folder / "state").mkdir()
    (folder / "etc").mkdir()
    host = socket.gethostname().split(".")[0]
    ports = free_ports(1 + len(NODES))
    # ASSUME: each node has half of this machine's memory, and both its cores.
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**21
    text = CONFIG.format(folder=folder, host=host, control=ports[0])
    for name, port in zip(NODES, ports[1:], strict=True):
        text += NODE.format(name=name, host=host, port=port, memory=memory)
    (folder / "etc" / "slurm.conf").write_text(text + PARTITION.format(nodes=",".join(NODES)))
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    # In this process's own mount namespace alone: see `unshare`.
    ETC.mkdir(exist_ok=True)
    subprocess.run(["mount", "--bind", folder / "etc", ETC], check=True)
    started: dict[str, subprocess.Popen] = {}
    try:
        started["munged"] = daemon(
            folder, "munged", "munged", "--foreground", "--force", f"--key-file={key}",
            *(f"--{what}-file={folder}/munged.{what}" for what in ("pid", "log", "seed")),
            f"--socket={folder}/munge.socket",
        )  # fmt: skip
        until(lambda: (folder / "munge.socket").exists(), 20)
        started["slurmctld"] = daemon(folder, "slurmctld", "slurmctld", "-D", "-c")
        nodes = {name: daemon(folder, name, "slurmd", "-D", "-c", "-N", name) for name in NODES}
        started |= nodes
        until(lambda: idle() == len(NODES), 60)
        yield nodes
    finally:
        subprocess.run(["scancel", "--user=root"], check=False, capture_output=True)
        for process in reversed(started.values()):
            with_group(process, signal.SIGTERM)
        time.sleep(3)
        for process in started.values():
            with_group(process, signal.SIGKILL)
        subprocess.run(["umount", ETC], check=False)


def daemon(folder: Path, name: str, *command: str | Path) -> subprocess.Popen:
    """A daemon in a session of its own."""
    with (folder / f"{name}.out").open("w") as stream:
        return subprocess.Popen(list(map(str, command)), stdout=stream, stderr=stream, start_new_session=True)


def with_group(process: subprocess.Popen, number: int) -> None:
    """Send a signal to a daemon and all that it started in its session."""
    try:
        os.killpg(process.pid, number)
    except ProcessLookupError:
        return


def idle() -> int:
    """How many nodes wait for jobs."""
    command = ["sinfo", "--noheader", "--Node", "--states=idle", "--format=%N"]
    return len(subprocess.run(command, capture_output=True, text=True, check=False).stdout.split())


def until(true: Callable[[], bool], seconds: float) -> None:
    """Wait until something is so. TimeoutError where it does not become so in time."""
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            raise TimeoutError(f"Slurm did not start in {seconds:g} s")
        time.sleep(0.5)


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on."""
    open_ = [socket.socket() for _ in range(count)]
    for own in open_:
        own.bind(("127.0.0.1", 0))
    ports = [own.getsockname()[1] for own in open_]
    for own in open_:
        own.close()
    return ports


if __name__ == "__main__":
    main()
