"""Data embedded in a page: compressed bytes as text, and JSON inside a script element."""

from __future__ import annotations

import base64
import gzip
import json


def embedded_bytes(data: bytes, *, level: int = 9) -> str:
    """Return the base64 text of gzipped bytes; equal data give equal text.

    Parameters
    ----------
    data : bytes
        Content.
    level : int
        Compression level of gzip, 0 to 9.
    """
    return base64.b64encode(gzip.compress(data, compresslevel=level, mtime=0)).decode("ascii")


def embedded_json(payload: object) -> str:
    """Return JSON text that is safe inside a script element; NaN and infinities are errors (ValueError)."""
    # a "<" stands in strings only; escaped, none of "</script>", "<!--" and "<script" can occur
    return json.dumps(payload, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
