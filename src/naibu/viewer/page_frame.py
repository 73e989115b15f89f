"""HTML frame of the pages: one self-contained document that loads nothing from the network."""

from __future__ import annotations

from html import escape
from importlib.resources import files

# The page may run its own script and style and nothing else: no request leaves the reader's machine.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def asset(name: str) -> str:
    """Return a file of the bundle that ``viewer-src`` builds, safe to stand inside a script or style element."""
    text = (files("naibu.viewer") / "assets" / name).read_text(encoding="utf-8")
    return text.replace("</script", r"<\/script").replace("</style", r"<\/style").replace("<!--", r"<\!--")


def page_html(title: str, header: str, main: str, footer: str, *, scripts: str = "") -> str:
    """Return a whole page.

    Parameters
    ----------
    title : str
        Heading, plain text.
    header, main, footer : str
        HTML below the heading, of the body and of the last line.
    scripts : str
        Script elements at the end of the body.
    """
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">'
        f'<title>{escape(title)}</title><link rel="icon" href="data:,"><style>{asset("report.css")}</style></head>\n'
        f"<body><header><h1>{escape(title)}</h1>{header}</header>\n<main>{main}</main>\n<footer>{footer}</footer>\n{scripts}</body></html>\n"
    )
