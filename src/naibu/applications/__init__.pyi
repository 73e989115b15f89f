from .fingertip.contact_theories import hertz_force, hertz_radius, parallel_springs_force, power_law
from .fingertip.decoder import DecodedForces, ForceDecoder, Training, directions, train_decoder, true_contact
from .fingertip.fingertip import Fingertip, FingertipResolution, fingertip_mesh
from .fingertip.offset import OffsetTracker
from .fingertip.pressing import FingertipModel, Press, Pressing, rotated_loads
from .fingertip.readings import ReadingChain
from .fingertip.slip import SidewaysForces, SlipDetector, train_slip_detector, true_tangential_share
from .fingertip.whole_fingertip import WholeFingertip
from .ischemia.layer_identification import LayerEstimate, LayerParameter, identify_layers
from .ischemia.layered_response import LayeredModes, SkinMotion, frequency_response, simulate_skin
from .ischemia.response_times import ResponseTimes, response_times
from .ischemia.skin import MeshedPatch, SkinLayer, SkinPatch, SurfaceLoad, meshed
from .mammography.breast_from_mr import ScannedBreast, breast_in_scan
from .mammography.breast_from_projections import ProjectedBreast, breast_in_projections
from .mammography.breast_outline import BreastOutline, breast_outline, mask_outline
from .mammography.breast_segmentation import breast_mask
from .mammography.breast_shape import BreastShape, half_ellipsoid_shape, shape_from_widths
from .mammography.epipolar import EpipolarCurve, LesionPosition, MammographicPair, ModelUncertainty, Projection
from .mammography.geometric_model import Compression, CompressionParameters, compressed
from .mammography.mechanical_model import MechanicalCompression, MechanicalParameters, mechanically_compressed
from .mammography.mechanical_views import mechanical_views
from .mammography.pair_construction import mammographic_pair, pair_of_shape
from .mammography.pressed_view import PressedView
from .mammography.two_views import TwoViews, two_views
from .mammography.view_order import excess_above_nipple, may_be_swapped
from .sensing_chip.bridge import closed_form_sensitivities, crosstalk, decoupled, half_bridge, sensitivity_matrix
from .sensing_chip.chip_mesh import ChipMesh, ChipResolution, chip_mesh
from .sensing_chip.closed_forms import CrossBeam, orthotropic_torsion_stiffness
from .sensing_chip.design import ChipDesign, assumed_chip
from .sensing_chip.design_study import DesignStudy, pareto_front, study_designs
from .sensing_chip.electronics import Readout, report_readout
from .sensing_chip.fillets import FilletedEnd, filleted_end, require_bearable_at_fillets
from .sensing_chip.filters import RampKalman, first_order_filter, forward_backward_filter
from .sensing_chip.finite_elements import ChipResponse, solve_chip
from .sensing_chip.load_envelope import largest_stress, load_envelope, load_limits, require_bearable, surface_stress
from .sensing_chip.piezoresistance import Piezoresistance, doping_factor, n_type_silicon, p_type_silicon

__all__ = [
    "BreastOutline",
    "BreastShape",
    "ChipDesign",
    "ChipMesh",
    "ChipResolution",
    "ChipResponse",
    "Compression",
    "CompressionParameters",
    "CrossBeam",
    "DecodedForces",
    "DesignStudy",
    "EpipolarCurve",
    "FilletedEnd",
    "Fingertip",
    "FingertipModel",
    "FingertipResolution",
    "ForceDecoder",
    "LayerEstimate",
    "LayerParameter",
    "LayeredModes",
    "LesionPosition",
    "MammographicPair",
    "MechanicalCompression",
    "MechanicalParameters",
    "MeshedPatch",
    "ModelUncertainty",
    "OffsetTracker",
    "Piezoresistance",
    "Press",
    "PressedView",
    "Pressing",
    "ProjectedBreast",
    "Projection",
    "RampKalman",
    "ReadingChain",
    "Readout",
    "ResponseTimes",
    "ScannedBreast",
    "SidewaysForces",
    "SkinLayer",
    "SkinMotion",
    "SkinPatch",
    "SlipDetector",
    "SurfaceLoad",
    "Training",
    "TwoViews",
    "WholeFingertip",
    "assumed_chip",
    "breast_in_projections",
    "breast_in_scan",
    "breast_mask",
    "breast_outline",
    "chip_mesh",
    "closed_form_sensitivities",
    "compressed",
    "crosstalk",
    "decoupled",
    "directions",
    "doping_factor",
    "excess_above_nipple",
    "filleted_end",
    "fingertip_mesh",
    "first_order_filter",
    "forward_backward_filter",
    "frequency_response",
    "half_bridge",
    "half_ellipsoid_shape",
    "hertz_force",
    "hertz_radius",
    "identify_layers",
    "largest_stress",
    "load_envelope",
    "load_limits",
    "mammographic_pair",
    "mask_outline",
    "may_be_swapped",
    "mechanical_views",
    "mechanically_compressed",
    "meshed",
    "n_type_silicon",
    "orthotropic_torsion_stiffness",
    "p_type_silicon",
    "pair_of_shape",
    "parallel_springs_force",
    "pareto_front",
    "power_law",
    "report_readout",
    "require_bearable",
    "require_bearable_at_fillets",
    "response_times",
    "rotated_loads",
    "sensitivity_matrix",
    "shape_from_widths",
    "simulate_skin",
    "solve_chip",
    "study_designs",
    "surface_stress",
    "train_decoder",
    "train_slip_detector",
    "true_contact",
    "true_tangential_share",
    "two_views",
]
