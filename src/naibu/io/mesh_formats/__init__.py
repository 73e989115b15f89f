"""Mesh file formats, one module each; `naibu.io.meshes` selects one by the file name extension."""
