"""Image file formats, one module each; `naibu.io.images` selects one by the file name extension."""
