from .cutting.forest_cut import ForestCut, cut_forest, forest_pieces
from .cutting.surfaces.surface_cut import SurfaceCutter, cut_surface
from .cutting.surfaces.surface_result import Groove, SurfaceCut, groove
from .cutting.swept_blade import SweptBlade, blade_poses, swept_blade
from .cutting.volume import VolumeCut, cut_volume
from .element_conversion import split_hexahedra, to_quadratic, to_tetra
from .interfaces import split_at_plane
from .point_location import Location, interpolation_operator, locate
from .primitives import box, box_from_coordinates, cylinder, half_ellipsoid, hemisphere
from .quality import aspect_ratios, mean_edge_length, min_jacobians, scaled_jacobians, signed_volumes
from .refinement.forest import BisectionForest, LeafMesh, MeshChange
from .refinement.marking import AnyOf, EdgeStretch, Marks, NearContact, SurfaceBending, doerfler_marks
from .refinement.replacement import added_nodes, replaced_cells
from .refinement.transfer import transferred_cells, transferred_motion, transferred_nodes
from .structured_2d import interval, rectangle
from .surface import Boundary, boundary_faces, boundary_nodes, face_normals, faces_towards, node_areas, nodes_on_plane, side_nodes

__all__ = [
    "AnyOf",
    "BisectionForest",
    "Boundary",
    "EdgeStretch",
    "ForestCut",
    "Groove",
    "LeafMesh",
    "Location",
    "Marks",
    "MeshChange",
    "NearContact",
    "SurfaceBending",
    "SurfaceCut",
    "SurfaceCutter",
    "SweptBlade",
    "VolumeCut",
    "added_nodes",
    "aspect_ratios",
    "blade_poses",
    "boundary_faces",
    "boundary_nodes",
    "box",
    "box_from_coordinates",
    "cut_forest",
    "cut_surface",
    "cut_volume",
    "cylinder",
    "doerfler_marks",
    "face_normals",
    "faces_towards",
    "forest_pieces",
    "groove",
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
    "replaced_cells",
    "scaled_jacobians",
    "side_nodes",
    "signed_volumes",
    "split_at_plane",
    "split_hexahedra",
    "swept_blade",
    "to_quadratic",
    "to_tetra",
    "transferred_cells",
    "transferred_motion",
    "transferred_nodes",
]
