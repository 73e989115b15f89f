"""
6. Many samples on a cluster
============================

One task a sample, each in a folder of its own; a task that is stopped goes on where it was; JSON documents are collected into one table.
:doc:`/cluster` has the script for Slurm. Here its tasks run one after the other on this machine, without a home folder, as batch systems
may start them.
"""

# %%
# Tasks
# -----
# A list of samples, one a line, and a script that takes the line of its number. ``exec`` lets the signals of the batch system reach naibu.
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt

place = Path(tempfile.mkdtemp())
samples = ["ct_cube_bar", "ct_half_ellipsoid", "ct_cube_plate"]
(place / "samples.txt").write_text("\n".join(samples) + "\n")
(place / "task.sh").write_text(f"""#!/bin/bash
#SBATCH --array=0-2 --cpus-per-task=2 --mem=4G --time=01:00:00 --signal=B:TERM@120
sample=$(sed -n "$((SLURM_ARRAY_TASK_ID + 1))p" samples.txt)
exec {sys.executable} -m naibu identify "$sample" --element-size-mm 14 -o "results/$sample" --json --log "$sample.log" > "$sample.json"
""")
print((place / "samples.txt").read_text())


def task(number: int) -> subprocess.Popen[bytes]:
    """Start a task as the batch system would."""
    environment = {name: value for name, value in os.environ.items() if name != "HOME"}
    environment |= {"SLURM_ARRAY_TASK_ID": str(number), "OMP_NUM_THREADS": "2"}
    return subprocess.Popen(["bash", "task.sh"], cwd=place, env=environment, stderr=subprocess.DEVNULL)


# %%
# A task that is stopped
# ----------------------
# Slurm sends SIGTERM two minutes before the time is over (``--signal=B:TERM@120``). naibu ends with the exit code 143, and leaves the
# checkpoint that it has written after every iteration: the same command goes on from there. With SIGINT it would also write the best model
# so far.
first = task(0)
log = place / "ct_cube_bar.log"
while first.poll() is None and not (log.exists() and "calibration" in log.read_text()):
    time.sleep(0.05)
first.send_signal(signal.SIGTERM)
print("exit code of the stopped task:", first.wait(300))
print("written:", ", ".join(sorted(file.name for file in (place / "results" / "ct_cube_bar").iterdir())))

# %%
# All of them
# -----------
# The stopped task is submitted again with the others.
codes = [task(number).wait(600) for number in range(len(samples))]
print("exit codes:", codes)
print("written now:", ", ".join(sorted(file.name for file in (place / "results" / "ct_cube_bar").iterdir())))

# %%
# One table
# ---------
# Every document holds the verdict, the tables, and the exit code.
documents = {name: json.loads((place / f"{name}.json").read_text()) for name in samples}
for name, document in documents.items():
    print(f"{name}: exit code {document['exit_code']}, {document['results']['verdict']}")

figure, axes = plt.subplots(figsize=(6.5, 3.4), layout="constrained")
for k, document in enumerate(documents.values()):
    (table,) = (table for table in document["tables"] if table["title"] == "Parameters")
    for row in (row for row in table["rows"] if row["parameter"].endswith("acrylic: friction")):
        axes.errorbar(
            row["estimate"], k, xerr=[[row["estimate"] - row["95 % from"]], [row["to"] - row["estimate"]]], fmt="o", capsize=4, color="C0"
        )
axes.set(xlabel="friction between gel and acrylic, with 95 % interval", ylabel="sample", xscale="log", title="Three samples, one table")
axes.set_yticks(range(len(samples)), samples)
axes.set_xticks(ticks := [0.03, 0.1, 0.3], [f"{friction:g}" for friction in ticks])
axes.xaxis.set_minor_formatter("")
plt.show()
