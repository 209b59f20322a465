"""Expose a whole plan: every site's frames to files, in any number of processes with equal results."""

from __future__ import annotations

import functools
import json
import multiprocessing
import os
from pathlib import Path
from typing import Any

from rig import exposure, imagefile, plan, truth
from rig.errors import RigError
from rig.plan import Site
from rig.settings import Settings


def expose_dataset(folder: Path, settings: Settings, truth_path: Path, workers: int = 1) -> dict[str, Any]:
    """Write every frame that `folder/manifest.csv` plans, then the truth file; returns the truth."""
    if workers < 1:
        raise RigError(f"--workers: must be at least 1, not {workers}")
    sites = plan.sites(plan.read_plan(folder))
    job = functools.partial(_expose_site, folder, settings)
    if workers == 1 or len(sites) == 1:
        told = [job(site) for site in sites]
    else:
        # Spawned, not forked: a fork copies the locks of threads that it does not copy.
        with multiprocessing.get_context("spawn").Pool(min(workers, len(sites))) as pool:
            told = pool.map(job, sites, chunksize=1)
    whole = truth.whole_truth(settings, told)
    text = json.dumps(whole, indent=1, allow_nan=False) + "\n"
    imagefile.write_whole(truth_path, text.encode())
    return whole


def _expose_site(folder: Path, settings: Settings, site: Site) -> dict[str, Any]:
    lit = exposure.light(settings, site)
    for shot in site.shots:
        path = folder / shot.file
        try:
            imagefile.write_frame(path, exposure.whole_frame(settings, lit, shot), settings.sensor.bit_depth)
        except OSError as error:
            raise RigError(f"{path}: cannot be written ({os.strerror(error.errno or 0)})") from error
    return truth.site_truth(settings, lit)
