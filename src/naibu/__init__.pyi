from . import applications, core, datasets, identification, imaging, io, mechanics, meshing, simulation, validation, workflows
from .core.displacement_field import DisplacementField
from .core.experiment import Experiment
from .core.markers import Markers
from .core.mesh import Mesh
from .core.volume import Volume
from .io.images import read_volume
from .workflows.compare import compare
from .workflows.identify import identify
from .workflows.predict import predict
from .workflows.report import report
from .workflows.sense import sense
from .workflows.simulate import simulate
from .workflows.track import track

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
