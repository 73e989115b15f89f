from .analytic.finite_strain import HomogeneousState, ThickShell, confined, equibiaxial, simple_shear, uniaxial
from .analytic.viscoelastic import complex_modulus, creep_strain, free_motion, ramp_stress, residual_strain
from .scanners.ct_mr import MarkerKind, VirtualObject, VirtualScan, scan
from .scanners.experiments import rescanned, scanned_states
from .scanners.imaging_artifacts import CTDevice, MRDevice
from .scanners.motions import FormulaMotion, MatchedMotion, MeshMotion, PosedMotion, Still
from .scanners.textures import Texture, layered_block
from .scanners.ultrasound import Scatterers, UltrasoundDevice, ultrasound, ultrasound_sequence
from .specimens.hand import hand_surface
from .specimens.lattice_twin import Twin, dough_lattice, dough_parameters, dough_twin, virtual_capture
from .specimens.marker_phantoms import Phantom, Scanner, VirtualSpecimen, box_experiment, phantom, two_gels, virtual_specimen
from .specimens.quadratic_body import QuadraticBody
from .specimens.scanned_leg import LegShape, ScannedLeg, scanned_leg
from .specimens.scanned_liver import Lump, ScannedLiver, scanned_liver
from .specimens.specimen_matching import BlockMatch, block_match
from .specimens.textured_sphere import ScannedBall, squeezed_ball

__all__ = [
    "BlockMatch",
    "CTDevice",
    "FormulaMotion",
    "HomogeneousState",
    "LegShape",
    "Lump",
    "MRDevice",
    "MarkerKind",
    "MatchedMotion",
    "MeshMotion",
    "Phantom",
    "PosedMotion",
    "QuadraticBody",
    "ScannedBall",
    "ScannedLeg",
    "ScannedLiver",
    "Scanner",
    "Scatterers",
    "Still",
    "Texture",
    "ThickShell",
    "Twin",
    "UltrasoundDevice",
    "VirtualObject",
    "VirtualScan",
    "VirtualSpecimen",
    "block_match",
    "box_experiment",
    "complex_modulus",
    "confined",
    "creep_strain",
    "dough_lattice",
    "dough_parameters",
    "dough_twin",
    "equibiaxial",
    "free_motion",
    "hand_surface",
    "layered_block",
    "phantom",
    "ramp_stress",
    "rescanned",
    "residual_strain",
    "scan",
    "scanned_leg",
    "scanned_liver",
    "scanned_states",
    "simple_shear",
    "squeezed_ball",
    "two_gels",
    "ultrasound",
    "ultrasound_sequence",
    "uniaxial",
    "virtual_capture",
    "virtual_specimen",
]
