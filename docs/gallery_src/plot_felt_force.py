"""
A force that a soft fingertip feels
===================================

A hemisphere of gel over a sensing chip is pressed by a tilted rod, then dragged. The chip reads one force and two moments; a decoder
that was trained on other presses tells force and tilt with intervals, and how much of the force is sideways until the contact slides.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.applications import (
    ChipResolution,
    Fingertip,
    FingertipModel,
    FingertipResolution,
    Press,
    ReadingChain,
    Training,
    assumed_chip,
    report_readout,
    train_decoder,
    train_slip_detector,
    true_contact,
    true_tangential_share,
)

finger = Fingertip(diameter_mm=20.0, young_modulus_kpa=220.0)
model = FingertipModel.of(finger, FingertipResolution(3, 2, 10))  # coarse
chain = ReadingChain.of_chip(assumed_chip(), report_readout(), ChipResolution(6, 1, 2, 2, 3))
training = Training((0.0, 10.0, 20.0, 30.0), (0.6,), (200.0, 240.0), (300.0, 1700.0))
presses = [model.pressed(press) for press in training.presses(finger)]
slides = [model.pressed(press) for press in training.slides(finger)]
decoder = train_decoder(finger, chain, training, presses)
detector = train_slip_detector(decoder, chain, training, presses, slides)

friction = 0.4
pressing = model.pressed(Press(tilt_deg=14.0, force_mn=1500.0, friction=friction, slide_mm=2.0))
force = np.geomspace(320.0, 1500.0, 25)
volts = chain.volts(pressing.at_force(force))
found = decoder.decode(volts, noise_share=0.23)
truth, tilt, _ = true_contact(pressing, force)

touched = pressing.along_rod_mn > 320.0
loads = chain.measured_loads(chain.volts(pressing.chip_loads[touched]))
drag = detector.followed(2.0 * np.arange(len(loads)), loads, noise_share=0.23)

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10.5, 3.3), layout="constrained")
left.fill_between(1e-3 * truth, *(1e-3 * found.force_95.T), alpha=0.3, linewidth=0, color="#2a788e")
left.plot(1e-3 * truth, 1e-3 * found.force_mn, color="#2a788e")
left.plot(1e-3 * truth, 1e-3 * truth, "k:", linewidth=1)
left.set(xlabel="true force (N)", ylabel="decoded force (N)")
middle.fill_between(1e-3 * truth, *found.tilt_95_deg.T, alpha=0.3, linewidth=0, color="#2a788e")
middle.plot(1e-3 * truth, found.tilt_deg, color="#2a788e")
middle.plot(1e-3 * truth, np.rad2deg(tilt), "k:", linewidth=1)
middle.set(xlabel="true force (N)", ylabel="tilt of the force (degrees)", ylim=(0.0, 20.0))
state = np.arange(len(loads))
right.fill_between(state, *drag.size_95.T, alpha=0.3, linewidth=0, color="#d95f02")
right.plot(state, drag.size, color="#d95f02", label="sideways over pressing force")
share = true_tangential_share(pressing)[touched]
right.plot(state, np.abs(share - share[0]), "k", linewidth=1, label="truth")
right.axhline(friction, color="k", linestyle=":", linewidth=1, label="friction")
right.set(xlabel="state: pressed, then dragged", ylabel="T / F", ylim=(0.0, None))
right.legend(fontsize=8, loc="upper left")
plt.show()
