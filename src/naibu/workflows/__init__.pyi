from .compare_methods import MethodComparison, compare_methods
from .identify import Identification
from .sense import Pair, SenseRun, read_pair, sense_pair
from .simulate import NamedStudy, named_studies
from .simulate_lattice import SimulationRun
from .track import ObjectDescription, TrackRun
from .track_sequence import SequenceRun, track_sequence_file

__all__ = [
    "Identification",
    "MethodComparison",
    "NamedStudy",
    "ObjectDescription",
    "Pair",
    "SenseRun",
    "SequenceRun",
    "SimulationRun",
    "TrackRun",
    "compare_methods",
    "named_studies",
    "read_pair",
    "sense_pair",
    "track_sequence_file",
]
