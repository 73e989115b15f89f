from .displacement_fields import read_field, write_field
from .experiment_folder.reader import read_experiment
from .images import open_volume, read_displacement, read_volume_box, write_displacement, write_volume
from .meshes import Surface, read_mesh, read_surface
from .tables.captured_shapes import CapturedSurface, read_captured_shapes
from .tables.force_records import ForceRecord, read_force_records
from .tables.marker_tables import import_markers, write_experiment_folder, write_markers
from .tables.point_clouds import PointCloud, read_point_cloud
from .vtk_files import write_vtkhdf_series, write_vtu
from .vtkhdf_series import SeriesFile

__all__ = [
    "CapturedSurface",
    "ForceRecord",
    "PointCloud",
    "SeriesFile",
    "Surface",
    "import_markers",
    "open_volume",
    "read_captured_shapes",
    "read_displacement",
    "read_experiment",
    "read_field",
    "read_force_records",
    "read_mesh",
    "read_point_cloud",
    "read_surface",
    "read_volume_box",
    "write_displacement",
    "write_experiment_folder",
    "write_field",
    "write_markers",
    "write_volume",
    "write_vtkhdf_series",
    "write_vtu",
]
