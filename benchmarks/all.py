"""Runs the benchmarks one after the other, each in a process of its own, and tells what each took and which failed.

Run: ``python benchmarks/all.py --quick`` (two to three minutes of processor time, kernels compiled) or ``python benchmarks/all.py`` (hours;
writes the records that the documentation shows). ``--list`` only prints the commands. Their output goes to
``FOLDER/NAME.txt``, a temporary folder by default.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PLACE = Path(__file__).resolve().parent
# quick and whole commands; none where a program has no quick one
COMMANDS: dict[str, tuple[str | None, str]] = {
    "speed": ("speed.py --quick --repeats 1", "speed.py --record"),
    "fe_linear": ("fe_linear.py --cells 12 --repeats 1 --peers naibu,naibu-direct,felupe,scikit-fem", "fe_linear.py --cells 40"),
    "fe_compression": ("fe_compression.py --cells 8 --repeats 1 --peers naibu,felupe,scikit-fem", "fe_compression.py"),
    "fe_gradient": ("fe_gradient.py --cells 8 --repeats 1 --peers naibu", "fe_gradient.py --cells 40"),
    "lattice_steps": ("lattice_steps.py --sizes 8 --repeats 3", "lattice_steps.py"),
    "lattice_gpu": (None, "lattice_gpu.py --record"),
    "fe_gpu": (None, "fe_gpu.py --record"),
    "rheology_speed": (None, "rheology_speed.py"),
    "accuracy": (None, "accuracy.py --record"),
    "interval_coverage": (None, "interval_coverage.py 16 --record"),
    "marker_identification": (None, "marker_identification.py --record"),
    "prediction_coverage": (None, "interval_coverage.py 18 --predict --record"),
    "field_identification": (None, "field_identification.py coverage --repetitions 30 --record"),
    "lattice_calibration": (None, "lattice_calibration.py 5 --cells 3 --threads 1 --record"),
    "fingertip": (None, "fingertip.py --record"),
    "mammography": (None, "mammography.py --record"),
    "mammography_population": (None, "mammography_population.py --out naibu-breasts-results --first 120 --breasts 50 --record"),
    "surface_cutting": (None, "surface_cutting.py"),
    "volume_cutting": (None, "volume_cutting.py"),
    "cut_strokes": ("cut_strokes.py 4", "cut_strokes.py"),
    "cut_deviation": ("cut_deviation.py 20 2", "cut_deviation.py"),
    "cut_contact": (None, "cut_contact.py"),
    "crossing_cuts": (None, "crossing_cuts.py --body 15"),
    "large_volumes": (None, "large_volumes.py --sizes 160 256 --in-memory --peers --record"),
    "live_page": (None, "live_page.py --record"),
    "sensing_chip": (None, "sensing_chip.py"),
}


def main() -> None:
    """Run them; exit code 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes, no records")
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--list", action="store_true", help="only print the commands")
    parser.add_argument("--out", type=Path, help="folder for what the programs print")
    chosen = parser.parse_args()
    wanted = {name: COMMANDS[name][0 if chosen.quick else 1] for name in chosen.only}
    commands = {name: command for name, command in wanted.items() if command is not None}
    if chosen.list:
        print("\n".join(f"python benchmarks/{command}" for command in commands.values()))
        return
    folder = chosen.out or Path(tempfile.mkdtemp(prefix="naibu-benchmarks-"))
    folder.mkdir(parents=True, exist_ok=True)
    failed = []
    for name, command in commands.items():
        program, *options = command.split()
        began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        with (folder / f"{name}.txt").open("w", encoding="utf-8") as stream:
            code = subprocess.run(
                [sys.executable, str(PLACE / program), *options], stdout=stream, stderr=subprocess.STDOUT, env=os.environ, check=False
            ).returncode
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        told = f"FAILED with exit code {code}" if code else "done"
        print(f"{name:24s} {told:28s} {time.perf_counter() - began:7.0f} s   processor {busy:7.0f} s", flush=True)
        failed += [name] if code else []
    print(f"{len(commands) - len(failed)} of {len(commands)} programs ran; what they printed is in {folder}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
