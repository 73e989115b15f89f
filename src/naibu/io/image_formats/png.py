"""PNG images, read with Pillow as one plane of intensities: masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.image_formats.geometry import ReadOptions, three_axes, volume_with_axes


def read(path: Path, options: ReadOptions) -> Volume:
    """Read one plane of intensities (see `naibu.io.images.read_volume`); PNG states no size of pixels."""
    images = optional_package("PIL.Image", f"{path.name}: reading PNG files", "pillow")
    try:
        with images.open(path) as image:
            values = np.asarray(image.convert("L") if image.mode in ("1", "P", "LA", "RGB", "RGBA") else image)
    except FileNotFoundError as error:
        raise InputError(f"{path}: does not exist; check the path") from error
    except (OSError, SyntaxError) as error:
        raise InputError(f"{path}: is not readable as PNG ({error})") from error
    if options.spacing_mm is None:
        raise InputError(f"{path.name}: a PNG file does not state its voxel spacing; give spacing_mm, for example (0.1, 0.1, 1.0)")
    return volume_with_axes(path.name, three_axes(path.name, values), (0.0, 0.0, 0.0), np.diag(options.spacing_mm))
