"""Largest resident memory of a command.

`python -m tests.validation.benchmarks.peak COMMAND …` adds it [MB] as the last line.

Linux hands the memory of a process on to what it starts, as a lower limit of that one's own peak. So a benchmark that
has loaded much starts this small process, and this one the command.
"""

import os
import subprocess
import sys


def run(command: list[str]) -> tuple[str, float]:
    """What a command prints, and its largest resident memory [MB]. Raises CalledProcessError when it fails."""
    small = [sys.executable, "-m", "tests.validation.benchmarks.peak", *command]
    said = subprocess.run(small, check=True, stdout=subprocess.PIPE, text=True).stdout
    *lines, peak = said.splitlines()
    return "\n".join(lines), float(peak)


def main() -> None:
    """Run the command in the arguments."""
    job = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ)
    _, status, usage = os.wait4(job, 0)
    print(usage.ru_maxrss / 1024)
    sys.exit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()
