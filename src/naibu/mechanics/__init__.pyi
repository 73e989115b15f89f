from .contact.contact_surfaces import Friction, interface, rigid_contact
from .contact.indenter_geometry import (
    IndenterGeometry,
    bar_geometry,
    box_geometry,
    capsule_geometry,
    cylinder_geometry,
    mesh_geometry,
    plane_geometry,
    sphere_geometry,
)
from .contact.indenter_motion import IndenterForce, IndenterVelocity
from .contact.penalty_contact import Contact
from .contact.rigid_indenters import (
    RigidIndenter,
    bar_indenter,
    box_indenter,
    capsule_indenter,
    cylindrical_indenter,
    mesh_indenter,
    plane_indenter,
    spherical_indenter,
)
from .contact.session_protocol import Engine, Session, StepForces
from .finite_elements.assembly import Assembler, body_force
from .finite_elements.boundary_conditions import PrescribedDisplacement
from .finite_elements.elements import Elements, elements
from .finite_elements.hyperelasticity import Law, Material, lame_parameters, law_named, material
from .finite_strain.problem import Problem, SolverSettings
from .finite_strain.sensitivities import sensitivities
from .finite_strain.sessions.dynamic_session import DynamicEngine, DynamicSession, DynamicState
from .finite_strain.sessions.quasi_static_session import EquilibriumState, QuasiStaticEngine, QuasiStaticSession
from .finite_strain.sessions.real_time_session import RealTimeEngine, RealTimeSession
from .finite_strain.statics import LoadState, Solution, solve
from .finite_strain.viscoelasticity import PronySeries, ViscoelasticSolution, simulate_viscoelastic
from .lattices.cpu.engine import LatticeEngine
from .lattices.cpu.session import LatticeSession
from .lattices.gpu.engine import WarpLatticeEngine
from .lattices.model.elastic_springs import elastic_stiffness
from .lattices.model.hexahedra import lattice_mesh
from .lattices.model.lattice import (
    Lattice,
    LatticeParameters,
    box_mask,
    classic_lattice,
    general_lattice,
    lattice_parameters,
    voxel_parameters,
)
from .lattices.model.octrees.octree import octree_lattice
from .lattices.model.state import ConstrainedNodes, LatticeState, Motion
from .lattices.model.tetrahedral_springs import volumetric_lattice
from .lattices.simulation.adjoint import ParameterGradient, RecordedPush, push_gradient, recorded_push
from .lattices.simulation.contact import ContactMotion, push, push_by_force
from .lattices.simulation.loading_history import LatticeStudy, StudyBody, StudyFrame, StudyState, run_study
from .linear_algebra.block_matrix import BlockPattern, block_pattern, with_dirichlet_rows
from .linear_algebra.direct import direct_solver
from .linear_algebra.multigrid.multigrid_solver import MultigridSolver, rigid_body_modes
from .linear_algebra.protocols import Factorization, LinearSolver
from .linear_algebra.solver_selection import choose_solver
from .prescribed_motion import PrescribedMotion
from .small_strain.anisotropic_body import AnisotropicBody
from .small_strain.cubic_elasticity import CubicCrystal, crystal_frame, miller_indices, silicon
from .small_strain.dynamics import Series, simulate_motion
from .small_strain.implicit_integrators import MotionState
from .small_strain.linear_elasticity import LinearBody
from .small_strain.rheology import Rheology, elastic, maxwell, per_region, three_element, voigt
from .small_strain.sensitivities import MaterialChange, SeriesDerivatives, simulate_motion_with_derivatives
from .small_strain.supports import Support

__all__ = [
    "AnisotropicBody",
    "Assembler",
    "BlockPattern",
    "ConstrainedNodes",
    "Contact",
    "ContactMotion",
    "CubicCrystal",
    "DynamicEngine",
    "DynamicSession",
    "DynamicState",
    "Elements",
    "Engine",
    "EquilibriumState",
    "Factorization",
    "Friction",
    "IndenterForce",
    "IndenterGeometry",
    "IndenterVelocity",
    "Lattice",
    "LatticeEngine",
    "LatticeParameters",
    "LatticeSession",
    "LatticeState",
    "LatticeStudy",
    "Law",
    "LinearBody",
    "LinearSolver",
    "LoadState",
    "Material",
    "MaterialChange",
    "Motion",
    "MotionState",
    "MultigridSolver",
    "ParameterGradient",
    "PrescribedDisplacement",
    "PrescribedMotion",
    "Problem",
    "PronySeries",
    "QuasiStaticEngine",
    "QuasiStaticSession",
    "RealTimeEngine",
    "RealTimeSession",
    "RecordedPush",
    "Rheology",
    "RigidIndenter",
    "Series",
    "SeriesDerivatives",
    "Session",
    "Solution",
    "SolverSettings",
    "StepForces",
    "StudyBody",
    "StudyFrame",
    "StudyState",
    "Support",
    "ViscoelasticSolution",
    "WarpLatticeEngine",
    "bar_geometry",
    "bar_indenter",
    "block_pattern",
    "body_force",
    "box_geometry",
    "box_indenter",
    "box_mask",
    "capsule_geometry",
    "capsule_indenter",
    "choose_solver",
    "classic_lattice",
    "crystal_frame",
    "cylinder_geometry",
    "cylindrical_indenter",
    "direct_solver",
    "elastic",
    "elastic_stiffness",
    "elements",
    "general_lattice",
    "interface",
    "lame_parameters",
    "lattice_mesh",
    "lattice_parameters",
    "law_named",
    "material",
    "maxwell",
    "mesh_geometry",
    "mesh_indenter",
    "miller_indices",
    "octree_lattice",
    "per_region",
    "plane_geometry",
    "plane_indenter",
    "push",
    "push_by_force",
    "push_gradient",
    "recorded_push",
    "rigid_body_modes",
    "rigid_contact",
    "run_study",
    "sensitivities",
    "silicon",
    "simulate_motion",
    "simulate_motion_with_derivatives",
    "simulate_viscoelastic",
    "solve",
    "sphere_geometry",
    "spherical_indenter",
    "three_element",
    "voigt",
    "volumetric_lattice",
    "voxel_parameters",
    "with_dirichlet_rows",
]
