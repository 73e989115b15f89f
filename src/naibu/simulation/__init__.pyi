from .adaptive.body import AdaptiveBody
from .adaptive.conditions import Conditions, face_force, weight
from .adaptive.error_criterion import StressError
from .adaptive.error_estimator import recovery_indicators, residual_indicators
from .adaptive.hyperelastic_dynamics import HyperelasticDynamics
from .adaptive.indentation import Indentation, indent
from .adaptive.lattice import AdaptiveLattice, SpringMaterial
from .adaptive.linear_dynamics import LinearDynamics
from .adaptive.spring_levels import level_spring
from .adaptive.statics import AdaptiveSolution, StaticResult, hyperelastic_static, linear_static, pressed_by, solve_adaptively
from .cuts.lattice_cut import LatticeCut, cut_engine, cut_lattice, cut_session
from .frame import Frame
from .haptics.force_limits import ForceLimits
from .haptics.haptic_loop import DeviceChannel, DeviceForce, DevicePose, HapticHand
from .haptics.haptic_thread import HapticThread
from .haptics.local_contact import LocalContact
from .haptics.simulated_device import SimulatedDevice
from .haptics.virtual_coupling import VirtualCoupling
from .interactive_bodies import FiniteElementBody, InteractiveBody, LatticeBody
from .interactive_simulation import InteractiveSimulation
from .real_time_loop import RealTimeLoop
from .surfaces.opening import opened, opening
from .surfaces.springs import CutSprings, SurfaceSprings, surface_springs

__all__ = [
    "AdaptiveBody",
    "AdaptiveLattice",
    "AdaptiveSolution",
    "Conditions",
    "CutSprings",
    "DeviceChannel",
    "DeviceForce",
    "DevicePose",
    "FiniteElementBody",
    "ForceLimits",
    "Frame",
    "HapticHand",
    "HapticThread",
    "HyperelasticDynamics",
    "Indentation",
    "InteractiveBody",
    "InteractiveSimulation",
    "LatticeBody",
    "LatticeCut",
    "LinearDynamics",
    "LocalContact",
    "RealTimeLoop",
    "SimulatedDevice",
    "SpringMaterial",
    "StaticResult",
    "StressError",
    "SurfaceSprings",
    "VirtualCoupling",
    "cut_engine",
    "cut_lattice",
    "cut_session",
    "face_force",
    "hyperelastic_static",
    "indent",
    "level_spring",
    "linear_static",
    "opened",
    "opening",
    "pressed_by",
    "recovery_indicators",
    "residual_indicators",
    "solve_adaptively",
    "surface_springs",
    "weight",
]
