from .equilibrium_gap.batch import EquilibriumGapEstimate, batch_equilibrium_gap
from .equilibrium_gap.incremental import IncrementalEstimate, incremental_equilibrium_gap
from .equilibrium_gap.weighted import weighted_equilibrium_gap
from .from_fields.assumptions.other_assumptions import Assumption, MovedBorder
from .from_fields.estimate import identify_field
from .from_fields.field_estimate import FieldEstimate
from .from_fields.forward.load_cases import FieldLoadCase, KnownRegion, Zones
from .from_fields.identified.field_prediction import FieldPrediction, predict_inside, predict_moved_sides
from .from_fields.identified.identified_body import IdentifiedBody
from .from_fields.planning.experiment_design import Accuracy, expected_accuracy
from .from_fields.regions.relative_map import identify_relative_map
from .from_fields.uncertainty import ErrorBudget, cramer_rao_bound
from .from_markers.calibration import Calibration, calibrate
from .from_markers.gauss_newton import MatchingSettings
from .from_markers.known_materials import KnownMaterials
from .from_markers.observations import NoiseModel
from .from_markers.specimen.specimen_model import ModelSettings
from .from_motion.rheology import MotionEstimate, MotionLoadCase, identify_motion
from .lattice_calibration.captured.recorded_forces import RecordedForces
from .lattice_calibration.captured.shape_distance import force_difference, shape_difference
from .lattice_calibration.estimate import LatticeEstimate
from .lattice_calibration.evolutionary import search_cma_es, search_genetic
from .lattice_calibration.forward_model import Capture, PushedFace, Pushing
from .lattice_calibration.gauss_newton import CalibrationProblem, calibrate_lattice
from .lattice_calibration.report_indices import ReportIndices, indices
from .lattice_calibration.studies.study_problem import StudyProblem
from .lattice_calibration.studies.study_unknowns import StudyUnknowns, Trial
from .lattice_calibration.unknowns import LatticeUnknowns
from .material_testing.marker_strain import MarkerStrain, marker_strain, poisson_ratio_from_markers
from .material_testing.uniaxial import CompressionTest, PoissonRatio, Specimen, SpecimenMean, compression_test, poisson_ratio, specimen_mean
from .prediction.baselines import baselines
from .prediction.calibrated_model import CalibratedModel
from .prediction.cross_validation import LeftOut, ModelRow, compare_models, leave_one_out
from .prediction.prediction import Prediction, predict_state
from .verdict import Explanation, Verdict

__all__ = [
    "Accuracy",
    "Assumption",
    "CalibratedModel",
    "Calibration",
    "CalibrationProblem",
    "Capture",
    "CompressionTest",
    "EquilibriumGapEstimate",
    "ErrorBudget",
    "Explanation",
    "FieldEstimate",
    "FieldLoadCase",
    "FieldPrediction",
    "IdentifiedBody",
    "IncrementalEstimate",
    "KnownMaterials",
    "KnownRegion",
    "LatticeEstimate",
    "LatticeUnknowns",
    "LeftOut",
    "MarkerStrain",
    "MatchingSettings",
    "ModelRow",
    "ModelSettings",
    "MotionEstimate",
    "MotionLoadCase",
    "MovedBorder",
    "NoiseModel",
    "PoissonRatio",
    "Prediction",
    "PushedFace",
    "Pushing",
    "RecordedForces",
    "ReportIndices",
    "Specimen",
    "SpecimenMean",
    "StudyProblem",
    "StudyUnknowns",
    "Trial",
    "Verdict",
    "Zones",
    "baselines",
    "batch_equilibrium_gap",
    "calibrate",
    "calibrate_lattice",
    "compare_models",
    "compression_test",
    "cramer_rao_bound",
    "expected_accuracy",
    "force_difference",
    "identify_field",
    "identify_motion",
    "identify_relative_map",
    "incremental_equilibrium_gap",
    "indices",
    "leave_one_out",
    "marker_strain",
    "poisson_ratio",
    "poisson_ratio_from_markers",
    "predict_inside",
    "predict_moved_sides",
    "predict_state",
    "search_cma_es",
    "search_genetic",
    "shape_difference",
    "specimen_mean",
    "weighted_equilibrium_gap",
]
