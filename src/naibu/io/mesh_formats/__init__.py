"""One reader a file format; `naibu.io.meshes` picks the one a file name asks for."""
