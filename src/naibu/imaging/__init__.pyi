from .dense_matching.block_matching import block_matching
from .dense_matching.hybrid import hybrid_flow
from .dense_matching.optical_flow import horn_schunck, lucas_kanade
from .displacement.accuracy import (
    ErrorSummary,
    check_point_errors,
    end_point_error,
    forward_backward_error,
    intensity_rms,
    inverse_displacement,
)
from .displacement.chunked_strain import ChunkedStrain
from .displacement.strain import displacement_gradient, green_lagrange_strain, jacobian_determinant, small_strain
from .feature_matching.correlation_matching import Candidates, candidate_matches
from .feature_matching.harris import InterestPoints, interest_points
from .feature_matching.relaxation_labelling import PotentialMatches, relaxed
from .feature_matching.scattered_interpolation import Triangulation, dense_from_sparse, sparse_displacement, triangulated
from .markers.detection import DetectedMarkers, detect_markers
from .markers.linking.particle_motion import ParticleMotion, particle_motion
from .markers.linking.point_matching import Links, link_markers
from .markers.scan_orientation import ScanOrientation, found_orientation, stated_orientation
from .markers.sequences.sequence_tracking import TrackedSequence, track_sequence
from .markers.settings import DetectionSettings, LinkSettings, SequenceSettings
from .markers.tracking import TrackedMarkers, track_markers
from .measure_displacement import MeasuredDisplacement, measure_displacement
from .out_of_core import ChunkedDisplacement, chunked_block_matching, chunked_harris_response, chunked_horn_schunck
from .preprocessing.bone_mask import bone_mask
from .preprocessing.object_mask import object_mask
from .preprocessing.resampling import cropped_to_mask, masked, resampled_to_grid, resampled_to_spacing, warped, with_slices_between
from .preprocessing.rigid_registration import RigidRegistration, register_rigid, rigid_from_points
from .volume_correlation.correlate import correlate_volumes
from .volume_correlation.results.correlation_result import CorrelationResult
from .volume_correlation.settings import CorrelationSettings

__all__ = [
    "Candidates",
    "ChunkedDisplacement",
    "ChunkedStrain",
    "CorrelationResult",
    "CorrelationSettings",
    "DetectedMarkers",
    "DetectionSettings",
    "ErrorSummary",
    "InterestPoints",
    "LinkSettings",
    "Links",
    "MeasuredDisplacement",
    "ParticleMotion",
    "PotentialMatches",
    "RigidRegistration",
    "ScanOrientation",
    "SequenceSettings",
    "TrackedMarkers",
    "TrackedSequence",
    "Triangulation",
    "block_matching",
    "bone_mask",
    "candidate_matches",
    "check_point_errors",
    "chunked_block_matching",
    "chunked_harris_response",
    "chunked_horn_schunck",
    "correlate_volumes",
    "cropped_to_mask",
    "dense_from_sparse",
    "detect_markers",
    "displacement_gradient",
    "end_point_error",
    "forward_backward_error",
    "found_orientation",
    "green_lagrange_strain",
    "horn_schunck",
    "hybrid_flow",
    "intensity_rms",
    "interest_points",
    "inverse_displacement",
    "jacobian_determinant",
    "link_markers",
    "lucas_kanade",
    "masked",
    "measure_displacement",
    "object_mask",
    "particle_motion",
    "register_rigid",
    "relaxed",
    "resampled_to_grid",
    "resampled_to_spacing",
    "rigid_from_points",
    "small_strain",
    "sparse_displacement",
    "stated_orientation",
    "track_markers",
    "track_sequence",
    "triangulated",
    "warped",
    "with_slices_between",
]
