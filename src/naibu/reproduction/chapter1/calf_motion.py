# mypy: disallow-untyped-decorators=False
"""The motion of the calf phantom: a plate compresses soft tissue against two rigid bones, and volumes are preserved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray
from naibu.core.rigid_transform import RigidTransform

# positions of the axes of the bones, mm, and the largest distance of their surfaces from them
TIBIA, FIBULA = (-13.0, -21.0), (24.0, -8.0)
TIBIA_REACH, FIBULA_REACH = 14.8, 6.3
# the region that moves with the fibula is a little larger, as the fibula moves in the frame of the flow, mm
_SHIFTS = 1.0
# widths, outwards from those distances, over which the motion of bone blends into that of soft tissue, mm
_TIBIA_BLEND, _FIBULA_BLEND = 16.0, 11.0
# the flow of the plate: half its width, and at and over what depth it decays, mm
_HALF_WIDTH, _EBB_AT, _EBB_OVER = 28.0, 20.0, 9.0
_ALONG_AT, _ALONG_OVER = 4.0, 38.0
# the fibula relative to the tibia: velocities along x and y, mm, and rotation, rad; slide of the muscle along the leg, mm
_FIBULA_MOTION = (0.5, -0.6, 0.018)
_SLIDE, _SLIDE_AT, _SLIDE_OVER = 0.9, 15.0, 10.0
# the leg as a whole, which is the motion of the tibia: rotations about x, y, z, degrees, and translation, mm
_TURNS_DEG, _SHIFT_MM = (0.5, -0.4, 3.0), (2.4, -1.8, 0.9)
_STEPS = 5
# distance from the centre of the leg beyond which there is no tissue, mm
_FARTHEST = 70.0


def leg_pose() -> RigidTransform:
    """Return the motion of the tibia, and with it of the leg as a whole."""
    a, b, c = np.radians(_TURNS_DEG)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0.0, np.sin(b)], [0.0, 1.0, 0.0], [-np.sin(b), 0.0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0.0], [np.sin(c), np.cos(c), 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform.of(about_z @ about_y @ about_x, _SHIFT_MM)


@dataclass(frozen=True, slots=True)
class CalfMotion:
    """Motion of the tissue of the calf under a plate from below (against y); a `naibu.validation.scanners.motions.Motion`.

    The tissue follows a steady flow for one unit of time in the frame of the tibia, and that frame moves rigidly. The flow is the curl of a
    stream function, so that volumes are preserved; within the bones it is that of a rigid body. The inverse is the reversed flow: both are
    exact but for the error of the Runge-Kutta steps, some 1e-5 mm.

    Attributes
    ----------
    plate_velocity_mm : float
        Velocity of the plate, mm per unit of time: the skin under its middle moves by nearly as much.
    """

    plate_velocity_mm: float = 12.0

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return positions (n, 3), mm, of material points (n, 3), mm."""
        return leg_pose().applied(self._carried(np.asarray(material, dtype=float), 1.0))

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return material points (n, 3), mm, of positions (n, 3), mm."""
        return self._carried(leg_pose().inverse().applied(positions), -1.0)

    def _carried(self, points: FloatArray, time: float) -> FloatArray:
        out = np.empty((len(points), 3))
        _follow(np.ascontiguousarray(points), time, self.plate_velocity_mm, _STEPS, out)
        return out


@njit(cache=True)
def _plateau(x: float, y: float, reach: float, blend: float) -> tuple[float, float, float]:
    """Return 1 within the reach, 0 beyond the blend, smooth to the second derivative, and the derivatives along x and y."""
    r = np.sqrt(x * x + y * y)
    if r <= reach:
        return 1.0, 0.0, 0.0
    if r >= reach + blend:
        return 0.0, 0.0, 0.0
    t = (r - reach) / blend
    slope = -30.0 * t * t * (1.0 - t) ** 2 / (blend * r)
    return 1.0 - t**3 * (10.0 + t * (6.0 * t - 15.0)), slope * x, slope * y


@njit(cache=True)
def _plate(x: float, y: float) -> tuple[float, float, float]:
    """Return the stream function of a plate of unit velocity against y, and its derivatives along x and y."""
    across = np.tanh(x / _HALF_WIDTH)
    depth = 1.0 / (1.0 + np.exp(-(y - _EBB_AT) / _EBB_OVER))
    return _HALF_WIDTH * across * depth, (1.0 - across * across) * depth, _HALF_WIDTH * across * depth * (1.0 - depth) / _EBB_OVER


_AT_TIBIA, _AT_FIBULA = float(_plate.py_func(*TIBIA)[0]), float(_plate.py_func(*FIBULA)[0])


@njit(cache=True)
def _velocity(x: float, y: float, z: float, push: float) -> tuple[float, float, float]:
    """Return the velocity, mm per unit of time, in the frame of the tibia: d psi / dy, -d psi / dx, and the slide along the leg."""
    along = push * np.exp(-0.5 * ((z - _ALONG_AT) / _ALONG_OVER) ** 2)
    p, px, py = _plate(x, y)
    t, tx, ty = _plateau(x - TIBIA[0], y - TIBIA[1], TIBIA_REACH, _TIBIA_BLEND)
    xf, yf = x - FIBULA[0], y - FIBULA[1]
    f, fx, fy = _plateau(xf, yf, FIBULA_REACH + _SHIFTS, _FIBULA_BLEND)
    # a constant in the stream function moves nothing: with those of the plate at the bones the blend is gentle
    at_t, at_f = _AT_TIBIA, _AT_FIBULA
    u, v, turn = _FIBULA_MOTION
    q = u * yf - v * xf - 0.5 * turn * (xf * xf + yf * yf)
    qx, qy = -v - turn * xf, u - turn * yf
    free, free_x, free_y = (1.0 - t) * (1.0 - f), -tx * (1.0 - f) - (1.0 - t) * fx, -ty * (1.0 - f) - (1.0 - t) * fy
    psi_x = along * (px * free + p * free_x + tx * at_t + fx * at_f) + fx * q + f * qx
    psi_y = along * (py * free + p * free_y + ty * at_t + fy * at_f) + fy * q + f * qy
    return psi_y, -psi_x, _SLIDE * free / (1.0 + np.exp(-(y - _SLIDE_AT) / _SLIDE_OVER))


@njit(cache=True, parallel=True)
def _follow(points: FloatArray, time: float, push: float, steps: int, out: FloatArray) -> None:
    """Carry points (n, 3) along the flow by classical Runge-Kutta steps."""
    h = time / steps
    for i in prange(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if x * x + y * y < _FARTHEST * _FARTHEST:
            for _ in range(steps):
                a = _velocity(x, y, z, push)
                b = _velocity(x + 0.5 * h * a[0], y + 0.5 * h * a[1], z + 0.5 * h * a[2], push)
                c = _velocity(x + 0.5 * h * b[0], y + 0.5 * h * b[1], z + 0.5 * h * b[2], push)
                d = _velocity(x + h * c[0], y + h * c[1], z + h * c[2], push)
                x += h * (a[0] + 2.0 * (b[0] + c[0]) + d[0]) / 6.0
                y += h * (a[1] + 2.0 * (b[1] + c[1]) + d[1]) / 6.0
                z += h * (a[2] + 2.0 * (b[2] + c[2]) + d[2]) / 6.0
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
