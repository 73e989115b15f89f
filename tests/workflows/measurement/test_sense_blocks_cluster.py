"""A pair measured block by block on a Dask cluster of two workers, one of which is killed: the same as in one process."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from naibu.core.progress import ProgressReport
from naibu.io.image_formats.zarr_store import open_array
from naibu.io.images import write_volume
from naibu.validation.specimens.textured_sphere import squeezed_ball
from naibu.workflows.measurement.sense_blocks import CHECKPOINT, MemoryPlan, sense_blocks

distributed = pytest.importorskip("distributed")
pytest.importorskip("zarr")
PLAN = MemoryPlan(1000.0, 500.0, 1, 32)


def test_a_worker_of_the_cluster_that_is_killed_costs_nothing_but_its_block(tmp_path: Path) -> None:
    before, after, _, _ = squeezed_ball(seed=1)
    pair = write_volume(tmp_path / "before.zarr", before), write_volume(tmp_path / "after.zarr", after)
    killed: list[int] = []
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:

        def kill_one(report: ProgressReport) -> None:
            if report.stage == "pass 2" and report.done and report.done < (report.total or 0) and not killed:
                killed.append(cluster.workers[0].process.pid)
                os.kill(killed[0], signal.SIGKILL)

        run = sense_blocks(*pair, out=tmp_path / "cluster", plan=PLAN, cluster=cluster.scheduler_address, progress=kill_one)
    assert killed and run.measured.facts["blocks"] > 3
    assert not (tmp_path / "cluster" / CHECKPOINT).exists()
    sense_blocks(*pair, out=tmp_path / "here", plan=PLAN)
    for name in ("displacement", "standard_deviation", "mask"):
        there, here = (np.asarray(open_array(tmp_path / place / f"{name}.zarr")[:]) for place in ("cluster", "here"))
        # sums of other threads differ in the last digit of single precision
        np.testing.assert_allclose(there, here, rtol=1e-4, atol=2e-6)
