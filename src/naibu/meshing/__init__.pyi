from .element_conversion import split_hexahedra, to_quadratic, to_tetra
from .interfaces import split_at_plane
from .point_location import Location, interpolation_operator, locate
from .primitives import box, box_from_coordinates, cylinder, half_ellipsoid, hemisphere
from .quality import aspect_ratios, mean_edge_length, min_jacobians, scaled_jacobians, signed_volumes
from .structured_2d import interval, rectangle
from .surface import Boundary, boundary_faces, boundary_nodes, face_normals, faces_towards, node_areas, nodes_on_plane, side_nodes

__all__ = [
    "Boundary",
    "Location",
    "aspect_ratios",
    "boundary_faces",
    "boundary_nodes",
    "box",
    "box_from_coordinates",
    "cylinder",
    "face_normals",
    "faces_towards",
    "half_ellipsoid",
    "hemisphere",
    "interpolation_operator",
    "interval",
    "locate",
    "mean_edge_length",
    "min_jacobians",
    "node_areas",
    "nodes_on_plane",
    "rectangle",
    "scaled_jacobians",
    "side_nodes",
    "signed_volumes",
    "split_at_plane",
    "split_hexahedra",
    "to_quadratic",
    "to_tetra",
]
