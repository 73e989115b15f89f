from .chunked_volume import ChunkedVolume
from .errors import ConvergenceError, InputError, MissingDependencyError, NaibuError, NaibuWarning, WorkerLostError
from .experiment import Layer, Loading, Shape, State
from .parameters import Parameter, ParameterSet
from .progress import ProgressReport
from .rigid_transform import RigidTransform, registration
from .status import Status

__all__ = [
    "ChunkedVolume",
    "ConvergenceError",
    "InputError",
    "Layer",
    "Loading",
    "MissingDependencyError",
    "NaibuError",
    "NaibuWarning",
    "Parameter",
    "ParameterSet",
    "ProgressReport",
    "RigidTransform",
    "Shape",
    "State",
    "Status",
    "WorkerLostError",
    "registration",
]
