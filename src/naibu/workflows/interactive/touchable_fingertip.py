"""A fingertip that is touched: the load on its chip, and what a decoder makes of its readings, while a rod presses it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.offset import OffsetTracker
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.fingertip.slip import SlipDetector
from naibu.applications.fingertip.whole_fingertip import WholeFingertip
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.filters import noise_gain, ramp_lag
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, cylindrical_indenter
from naibu.simulation.frame import Frame
from naibu.simulation.interactive_bodies import FiniteElementBody
from naibu.viewer.live.scene import LiveReading
from naibu.workflows.applications.fingertip_study import FINGERTIP, prepared_fingertip
from naibu.workflows.applications.stored_decoder import stored_detector
from naibu.workflows.interactive.touchable_models import TouchableModel

MESH = FingertipResolution(3, 3, 14)  # for real time; its loads differ by 1 % from those of finer ones
ROD_RADIUS, ROD_LENGTH, ROD_WAITS, ROD_FRICTION = 0.6, 0.8, 0.08, 0.5  # of the fingertip's radius; wider than the contact
TOUCH_S = 1.0  # how long a contact is taken to be undragged
LEAST = 0.5  # of the least F_z that the decoder answers: below, a contact has ended
MOST_READINGS = 100  # of a frame
RECENT = 3  # unfiltered readings whose mean the intervals reach to while the load changes: a frame of 30 a second at 100 Hz
CHANGES = 4.0  # standard deviations of noise between filtered and recent readings, from which on the load is said to change
FORCE_DRAG = 0.5  # of the upper end of the sideways share by which a drag may change the decoded force: benchmarks/fingertip.py --drags
LOADS = (
    LiveReading("F_z on the chip", "mN", "F_z"),
    LiveReading("M_x on the chip", "mN mm", "moments"),
    LiveReading("M_y on the chip", "mN mm", "moments"),
)
DECODED = (
    LiveReading("decoded force", "N", "force"),
    LiveReading("force of the rod", "N", "force", "true"),
    LiveReading("decoded tilt", "degrees", "tilt"),
    LiveReading("tilt of the force", "degrees", "tilt", "true"),
    LiveReading("decoded azimuth", "degrees", "azimuth", "(none while the force may be upright)"),
    LiveReading("decoded sideways share", "", "sideways share"),
    LiveReading("load", "", "load", states=("steady", "changes: the filtered readings are late, and intervals reach to the latest ones")),
)


def touchable_fingertip(source: str | os.PathLike[str], decoder: str | os.PathLike[str] | None = None) -> TouchableModel:
    """Prepare a fingertip to be touched by a rod that points to the centre of its hemisphere.

    Parameters
    ----------
    source : str or path-like
        ``"fingertip"``, or the file of one.
    decoder : path-like, optional
        ``NAME-decoder.json`` of its simulation; that of ``"fingertip"`` comes with naibu.

    Raises
    ------
    InputError
        A file that cannot be used, or a decoder of a fingertip of another size.
    """
    study = prepared_fingertip(source)
    if decoder is None and os.fspath(source) == FINGERTIP:
        decoder = Path(str(files("naibu") / "datasets" / "data" / "fingertip_decoder.json"))
    detector = None if decoder is None else stored_detector(Path(decoder))
    tip = study.fingertip
    if detector is not None and abs(detector.decoder.radius_mm - tip.radius_mm) > 1e-6 * tip.radius_mm:
        raise InputError(
            f"`decoder` {decoder} is of a hemisphere of radius {detector.decoder.radius_mm:g} mm, and that of {source} has "
            f"{tip.radius_mm:g} mm; name the decoder that `simulate` wrote for this fingertip"
        )
    cells = study.chip.settings.mesh
    chain = ReadingChain.of_chip(
        study.chip.design, study.chip.readout, ChipResolution(cells.along, cells.across, cells.through, cells.below, cells.frame)
    )
    whole = WholeFingertip.of(tip, MESH)
    stiffer = tip.young_modulus_kpa / Fingertip().young_modulus_kpa
    body = FiniteElementBody.of(
        whole.mesh, whole.assembler, supported=whole.held, normal_stiffness=1000.0 * stiffer, tangential_stiffness=50.0 * stiffer
    )
    sensor = FingertipSensor(whole, chain, detector, study.settings.readings.filter_share, study.settings.readings.seed)
    lag_s = ramp_lag(sensor.filter_share) / chain.readout.sample_rate_hz
    told = (
        f"Finite elements of a hemisphere of {tip.diameter_mm:g} mm, {tip.young_modulus_kpa:g} kPa, on a rigid base: {whole.mesh.n_cells} "
        "cells. The rod always points to its centre; a chip under the package at the middle of the base reads F_z, M_x and M_y, with noise "
        f"and filter, {chain.readout.sample_rate_hz:g} times a second.",
        f"Of the readings alone the decoder tells force and direction, {lag_s:.2g} s late by the filter; while the load changes, "
        "intervals reach to what the latest unfiltered readings tell. It supposes a rod that presses "
        "without drag; 95 % intervals of force and direction are as wide as the drag that the readings admit."
        if detector is not None
        else "Without a decoder, which `naibu simulate` trains on this fingertip, the readings are not decoded (--decoder).",
    )
    return TouchableModel(
        f"{study.title}, touched",
        told,
        body,
        "equivalent strain, %",
        tools=rods(tip),
        aimed_at=(0.0, 0.0, 0.0),
        cuttable=False,
        sensor=sensor,
    )


def rods(tip: Fingertip) -> Mapping[str, RigidIndenter]:
    """Return a rod with flat ends that waits above a fingertip, its axis downwards."""
    radius, length = ROD_RADIUS * tip.radius_mm, ROD_LENGTH * tip.radius_mm
    waits = (0.0, 0.0, (1.0 + ROD_WAITS) * tip.radius_mm + 0.5 * length)
    down = (0.0, 0.0, -1.0)
    return {"rod": cylindrical_indenter(waits, radius, length, down, static_friction=ROD_FRICTION, kinetic_friction=ROD_FRICTION)}


@dataclass(slots=True, eq=False)
class FingertipSensor:
    """The chip's readings, with noise, filter and recalibrated offset, and what is decoded from them; a `Sensor`.

    Attributes
    ----------
    whole : WholeFingertip
        What is touched.
    chain : ReadingChain
        Its chip.
    detector : SlipDetector, optional
        With the decoder.
    filter_share : float
        r of the first-order filter.
    seed : int
        Of the noise.
    """

    whole: WholeFingertip
    chain: ReadingChain
    detector: SlipDetector | None
    filter_share: float
    seed: int = 0
    _rng: np.random.Generator = field(init=False)
    _tracker: OffsetTracker = field(init=False)
    _filtered: FloatArray = field(init=False)
    _recent: deque[FloatArray] = field(init=False)
    _due: float = field(init=False, default=0.0)
    _last: Frame | None = field(init=False, default=None)
    _values: FloatArray = field(init=False)
    _touch: list[tuple[float, FloatArray]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._tracker = OffsetTracker(noise_gain(self.filter_share) * self.chain.readout.noise_sd)
        self._filtered = np.zeros(3)
        self._recent = deque([np.zeros(3)], maxlen=RECENT)
        self._values = np.full((len(self.readings), 3), np.nan)

    @property
    def readings(self) -> tuple[LiveReading, ...]:
        """What is read."""
        return LOADS if self.detector is None else (*LOADS, *DECODED)

    def at(self, frame: Frame) -> FloatArray:
        """Return value and ends of the 95 % interval of every reading at a frame (k, 3); the time since the last one is read, too."""
        if frame is not self._last:
            self._read(frame)
            recent = np.mean(self._recent, axis=0)
            changes = self._changes(recent)
            # by as much farther as a ramp goes on in the lag of that mean, and within a sample
            left = 0.5 * (RECENT + 1)
            recent += left / max(ramp_lag(self.filter_share) - left + 1.0, left) * (recent - self._filtered)
            loads, latest = ((volts - self._tracker.offset_volts) / self.chain.volts_per_load for volts in (self._filtered, recent))
            self._values[: len(LOADS), 0] = loads
            if self.detector is not None:
                saturated = bool(self.chain.saturated(np.stack([self._filtered, recent])).any())
                self._values[len(LOADS) :] = self._decoded(self.detector, frame, loads, latest, saturated)
                self._values[-1, 0] = float(changes)
            self._last = frame
        return self._values

    def _changes(self, recent: FloatArray) -> bool:
        """Return whether the mean of the latest readings, V, is farther from the filtered ones than noise explains."""
        gain = noise_gain(self.filter_share)
        sd = self.chain.readout.noise_sd * np.hypot(gain, len(self._recent) ** -0.5)
        return bool((np.abs(recent - self._filtered) > CHANGES * sd + self.chain.readout.step).any())

    def _read(self, frame: Frame) -> None:
        """Take as many samples as the time since the last frame holds, and filter them."""
        passed = frame.time_s - self._last.time_s if self._last is not None else 0.0
        if passed < 0.0:  # after a reset, or a step back
            passed, self._touch = 0.0, []
        self._due += passed * self.chain.readout.sample_rate_hz
        count = min(int(self._due), MOST_READINGS)
        self._due -= int(self._due)
        loads = self.whole.chip_loads(frame.positions)
        for reading in self.chain.converted(np.tile(loads, (count, 1)), self._rng):
            self._filtered = self.filter_share * reading + (1.0 - self.filter_share) * self._filtered
            self._recent.append(reading)
            self._tracker.without_offset(self._filtered)

    def _decoded(self, detector: SlipDetector, frame: Frame, loads: FloatArray, latest: FloatArray, saturated: bool) -> FloatArray:
        """Return the readings of `DECODED` (7, 3) but the last; intervals reach from the filtered loads to the latest, which lag less."""
        out = np.full((len(DECODED), 3), np.nan)
        force = frame.force + frame.pull
        size = float(np.linalg.norm(force))
        if size > 0.0:
            out[1, 0], out[3, 0] = 1e-3 * size, np.rad2deg(np.arccos(np.clip(-force[2] / size, -1.0, 1.0)))
        decoder, noise = detector.decoder, noise_gain(self.filter_share)
        latest_noise = max(noise, RECENT**-0.5)
        found = decoder.decode((loads * decoder.volts_per_load)[None], noise_share=noise)
        now = decoder.decode((latest * decoder.volts_per_load)[None], noise_share=latest_noise)
        out[5] = self._sideways(detector, frame.time_s, loads, latest, latest_noise)
        if found.answered[0] and now.answered[0] and not saturated:
            # a force across turns the direction, and moves the moment from which it is decoded
            moved = detector.sensitivity_mm / decoder.unit[1] * abs(float(detector.coefficients[0]))
            drag = float(np.rad2deg((1.0 + moved) * np.nan_to_num(out[5, 2])))
            tilt, apart = float(found.tilt_deg[0]), float(np.clip(found.direction[0] @ now.direction[0], -1.0, 1.0))
            cone = drag + max(float(found.cone_95_deg[0]), float(np.rad2deg(np.arccos(apart)) + now.cone_95_deg[0]))
            forces, tilts = (np.concatenate(pair) for pair in ((found.force_95, now.force_95), (found.tilt_95_deg, now.tilt_95_deg)))
            dragged = min(FORCE_DRAG * float(np.nan_to_num(out[5, 2])), 1.0)
            out[0] = 1e-3 * np.array([found.force_mn[0], (1.0 - dragged) * forces.min(), (1.0 + dragged) * forces.max()])
            out[2] = tilt, max(tilts.min() - drag, 0.0), tilts.max() + drag
            ends = _azimuth_95(float(found.azimuth_deg[0]), tilt, cone)
            out[4] = found.azimuth_deg[0] if np.isfinite(ends[0]) else np.nan, *ends
        return out

    def _sideways(self, detector: SlipDetector, time_s: float, loads: FloatArray, latest: FloatArray, noise: float) -> FloatArray:
        """Return the sideways share of the force since the contact began, with its interval (3,); NaN without contact."""
        if loads[0] < LEAST * detector.decoder.limits[0]:
            self._touch = []
        elif not self._touch or self._touch[-1][0] < time_s <= self._touch[0][0] + TOUCH_S:
            self._touch.append((time_s, loads))
        if not self._touch:
            return np.full(3, np.nan)
        rows = [*self._touch, *([(time_s, loads)] if time_s > self._touch[-1][0] else [])]
        drags = time_s > self._touch[0][0] + TOUCH_S  # else the latest reading would be taken for the touch
        rows += [(time_s + 1e-9, latest)] if drags else []
        found = detector.followed([t for t, _ in rows], np.array([row for _, row in rows]), noise_share=noise, touch_s=TOUCH_S)
        both = slice(-2, None) if drags else slice(-1, None)
        return np.array([found.size[both][0], found.size_95[both, 0].min(), found.size_95[both, 1].max()])


def _azimuth_95(azimuth_deg: float, tilt_deg: float, cone_deg: float) -> tuple[float, float]:
    """Return the azimuths, degrees, that a cone about a direction reaches; NaN where it holds the base's normal: any azimuth."""
    if cone_deg >= tilt_deg:
        return np.nan, np.nan
    half = float(np.rad2deg(np.arcsin(np.sin(np.deg2rad(cone_deg)) / np.sin(np.deg2rad(tilt_deg)))))
    return azimuth_deg - half, azimuth_deg + half
