"""
5. From the identified gel to a live page
=========================================

What was identified is pushed in the browser, and in Python by the same steps. On the command line::

    naibu identify my_gel -k 'gel=200 kPa' -o results
    naibu live results --experiment my_gel

``--experiment`` names the folder whose body is made; without it, the first experiment of the identification is taken, where that comes
with naibu.
"""

# %%
# Identify
# --------
# The gel of the first tutorial: a cube of 60 mm with 125 markers, pressed by a plate. The folder ``results`` is all that is needed later.
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import naibu
from naibu import datasets
from naibu.identification import ModelSettings
from naibu.simulation import InteractiveSimulation
from naibu.workflows import tools_for, touchable

place = Path(tempfile.mkdtemp())
gel = datasets.path("ct_cube_plate")
found = naibu.identify([gel], states={"ct_cube_plate": ["height_45"]}, settings=ModelSettings(element_size_mm=15.0), out=place / "results")
print(found.verdict.sentence)

# %%
# The page
# --------
# ``naibu live`` prints the address of a page of this computer, with a token that nobody else knows, and serves it until Ctrl-C. Here it is
# started, the page is fetched as a browser would, and it is ended.
command = [sys.executable, "-m", "naibu", "live", str(place / "results"), "--experiment", str(gel), "--no-browser", "--port", "0"]
server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
lines: queue.Queue[str] = queue.Queue()
threading.Thread(target=lambda: [lines.put(line) for line in server.stdout or ()], daemon=True).start()
try:
    address = ""
    while not address:
        line = lines.get(timeout=300)
        address = (re.findall(r"http://\S+", line) or [""])[0]
    page = urllib.request.urlopen(address, timeout=60).read().decode()
    print(re.sub(r"token=[\w-]+", "token=...", address), "answers with", re.findall("<title>(.*?)</title>", page)[0])
finally:
    server.send_signal(signal.SIGINT)
print("exit code after Ctrl-C:", server.wait(60))

# %%
# The same steps in Python
# ------------------------
# A touchable body stands on its table, with the identified materials and friction, under its own weight. A sphere comes down on its top
# for a second and rests there: the force rises, and settles in the static equilibrium.
model = touchable(place / "results", experiment=gel)
print(*model.sentences, sep="\n")
tools = tools_for(model.body)
simulation = InteractiveSimulation(model.body, tools)
top = model.body.points[:, 2].max()
middle = model.body.points[:, :2].mean(axis=0)
simulation.take("sphere")
frames, took = [], []
for step in range(75):
    down = 8.0 * min(step / 60.0, 1.0)
    simulation.move((*middle, top + tools["sphere"].geometry.size[0] - down))
    began = time.perf_counter()
    frames.append(simulation.advance())
    took.append(time.perf_counter() - began)
force = -np.array([frame.force[2] for frame in frames]) / 1000.0  # downwards

figure = plt.figure(figsize=(9, 3.8), layout="constrained")
left = figure.add_subplot(1, 2, 1)
left.plot([frame.time_s for frame in frames], force)
left.set(xlabel="time (s)", ylabel="force of the sphere on the gel (N)", title="Pushed by 8 mm, then held")
right = figure.add_subplot(1, 2, 2, projection="3d")
moved = frames[-1].positions
surface = right.plot_trisurf(*moved.T, triangles=model.body.faces, cmap="viridis", edgecolor="0.4", linewidth=0.2)
surface.set_array(np.linalg.norm(moved - model.body.points, axis=1)[model.body.faces].mean(axis=1))
surface.autoscale()
right.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
figure.colorbar(surface, ax=right, label="displacement (mm)", shrink=0.7, pad=0.15)
plt.show()
print(f"{force[-1]:.2f} N at 8 mm; a frame of 1/60 s took {1e3 * np.median(took):.0f} ms in the median on this machine")

# %%
# Buttons of the page do what methods do here: pull, cut, undo, record; a recording is saved as one page that needs no server
# (:doc:`/live`). A haptic device leads the tool at 1 kHz with ``--haptics-port``.
