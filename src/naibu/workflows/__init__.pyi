from .applications.decode_forces import DecodedRecord, decode_forces
from .applications.mammography import MammographyRun, relate_views
from .fields.design import Design, Planned, design
from .fields.identify_fields import FieldIdentification, identify_fields
from .fields.predict_field import Comparison, FieldPredictionRun, predict_field
from .interactive.cut import CutRun, cut
from .interactive.cut_surface import SurfaceCutRun, cut_surface_file
from .interactive.haptics.device import DeviceRecord, drive_live_simulation
from .interactive.live import live, touched_loop
from .interactive.touchable_models import MeshMaterial, TouchableModel, tools_for, touchable
from .joint_identification import JointIdentification, identify_jointly
from .markers.identify import Identification
from .measurement.compare_methods import MethodComparison, compare_methods
from .measurement.sense import Pair, SenseRun, read_pair, sense_pair
from .measurement.track import ObjectDescription, TrackRun
from .measurement.track_clouds import CloudRun, track_clouds
from .measurement.track_sequence import SequenceRun, track_sequence_file
from .predict import PredictionRun
from .reproduce import ReproducedChapter, reproduce, reproduce_all
from .studies.calibration.calibrate import LatticeCalibration, calibrate_study
from .studies.calibration.example import write_calibration_example
from .studies.simulate import NamedStudy, named_studies
from .studies.simulate_lattice import SimulationRun

__all__ = [
    "CloudRun",
    "Comparison",
    "CutRun",
    "DecodedRecord",
    "Design",
    "DeviceRecord",
    "FieldIdentification",
    "FieldPredictionRun",
    "Identification",
    "JointIdentification",
    "LatticeCalibration",
    "MammographyRun",
    "MeshMaterial",
    "MethodComparison",
    "NamedStudy",
    "ObjectDescription",
    "Pair",
    "Planned",
    "PredictionRun",
    "ReproducedChapter",
    "SenseRun",
    "SequenceRun",
    "SimulationRun",
    "SurfaceCutRun",
    "TouchableModel",
    "TrackRun",
    "calibrate_study",
    "compare_methods",
    "cut",
    "cut_surface_file",
    "decode_forces",
    "design",
    "drive_live_simulation",
    "identify_fields",
    "identify_jointly",
    "live",
    "named_studies",
    "predict_field",
    "read_pair",
    "relate_views",
    "reproduce",
    "reproduce_all",
    "sense_pair",
    "tools_for",
    "touchable",
    "touched_loop",
    "track_clouds",
    "track_sequence_file",
    "write_calibration_example",
]
