from . import applications, core, datasets, identification, imaging, io, mechanics, meshing, simulation, validation, workflows
from .core.displacement_field import DisplacementField
from .core.experiment import Experiment
from .core.markers import Markers
from .core.mesh import Mesh
from .core.volume import Volume
from .io.images import read_volume
from .workflows.markers.compare import compare
from .workflows.markers.identify import identify
from .workflows.measurement.sense import sense
from .workflows.measurement.track import track
from .workflows.predict import predict
from .workflows.report import report
from .workflows.studies.simulate import simulate

__all__ = [
    "DisplacementField",
    "Experiment",
    "Markers",
    "Mesh",
    "Volume",
    "applications",
    "compare",
    "core",
    "datasets",
    "identification",
    "identify",
    "imaging",
    "io",
    "mechanics",
    "meshing",
    "predict",
    "read_volume",
    "report",
    "sense",
    "simulate",
    "simulation",
    "track",
    "validation",
    "workflows",
]

__version__: str
