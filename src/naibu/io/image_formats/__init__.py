"""One reader and writer a file format of volumes; `naibu.io.images` picks the one a file name asks for."""
