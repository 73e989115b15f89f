from .compare_methods import MethodComparison, compare_methods
from .cut import CutRun, cut
from .cut_surface import SurfaceCutRun, cut_surface_file
from .haptics.device import DeviceRecord, drive_live_simulation
from .identify import Identification
from .identify_fields import FieldIdentification, identify_fields
from .live import live, touched_loop
from .reproduce import ReproducedChapter, reproduce, reproduce_all
from .sense import Pair, SenseRun, read_pair, sense_pair
from .simulate import NamedStudy, named_studies
from .simulate_lattice import SimulationRun
from .touchable_models import MeshMaterial, TouchableModel, tools_for, touchable
from .track import ObjectDescription, TrackRun
from .track_sequence import SequenceRun, track_sequence_file

__all__ = [
    "CutRun",
    "DeviceRecord",
    "FieldIdentification",
    "Identification",
    "MeshMaterial",
    "MethodComparison",
    "NamedStudy",
    "ObjectDescription",
    "Pair",
    "ReproducedChapter",
    "SenseRun",
    "SequenceRun",
    "SimulationRun",
    "SurfaceCutRun",
    "TouchableModel",
    "TrackRun",
    "compare_methods",
    "cut",
    "cut_surface_file",
    "drive_live_simulation",
    "identify_fields",
    "live",
    "named_studies",
    "read_pair",
    "reproduce",
    "reproduce_all",
    "sense_pair",
    "tools_for",
    "touchable",
    "touched_loop",
    "track_sequence_file",
]
