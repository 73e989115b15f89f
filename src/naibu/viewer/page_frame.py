"""HTML frame of the pages: one self-contained document that loads nothing from the network.

A Content-Security-Policy names the scripts and styles of naibu by their SHA-256: the page runs these and nothing else, and no request
leaves the reader's machine. Text of files and options is data: it is escaped, and could not run even if it were not.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping
from html import escape
from importlib.resources import files

_SCRIPT, _STYLE = re.compile(r"<script>(.*?)</script>", re.DOTALL), re.compile(r"<style>(.*?)</style>", re.DOTALL)


def content_security_policy(scripts: Iterable[str], styles: Iterable[str], *, connects: bool = False) -> str:
    """Return the policy of a page as an element of its head.

    Parameters
    ----------
    scripts, styles : iterable of str
        Contents of the script and style elements that may be used, character by character.
    connects : bool
        Whether the page may talk to the server that it came from, and to no other.
    """

    def sources(texts: Iterable[str]) -> str:
        digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
        return " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"

    rules = (
        "default-src 'none'",
        f"script-src {sources(scripts)}",
        f"style-src {sources(styles)}",
        "style-src-attr 'unsafe-inline'",  # colours of single cells
        "img-src data: blob:",
        "base-uri 'none'",
        "form-action 'none'",
        *(("connect-src 'self'",) if connects else ()),
    )
    return f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(rules)}">'


def asset(name: str) -> str:
    """Return a file of the bundle that ``viewer-src`` builds, safe to stand inside a script or style element."""
    return _read(name).replace("</script", r"<\/script").replace("</style", r"<\/style").replace("<!--", r"<\!--")


def filled_template(name: str, values: Mapping[str, str]) -> str:
    """Return a page whose template is an asset: ``$STYLE``, the common one, ``$POLICY`` and the names of `values` are replaced, once.

    Parameters
    ----------
    name : str
        File of the template.
    values : mapping of str to str
        HTML, or JSON from `naibu.viewer.embedding.embedded_json`, by name without the dollar sign.
    """
    template = _read(name).replace("$STYLE", asset("report.css"))
    filled = {**values, "POLICY": content_security_policy(_SCRIPT.findall(template), _STYLE.findall(template))}
    names = "|".join(map(re.escape, filled))
    # in one pass: what is filled in may contain such a name itself
    return re.sub(rf"\$({names})\b", lambda found: filled[found[1]], template)


def page_html(title: str, header: str, main: str, footer: str, *, data: str = "", script: str = "", connects: bool = False) -> str:
    """Return a whole page.

    Parameters
    ----------
    title : str
        Heading, plain text.
    header, main, footer : str
        HTML below the heading, of the body and of the last line.
    data : str
        Elements of data at the end of the body.
    script : str
        File of the script that runs after them, if there is one.
    connects : bool
        Whether the page may talk to the server that it came from, and to no other.
    """
    style, code = asset("report.css"), asset(script) if script else ""
    policy = content_security_policy([code] if code else [], [style], connects=connects)
    run = f"{data}<script>{code}</script>" if code else data
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">{policy}'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">'
        f'<title>{escape(title)}</title><link rel="icon" href="data:,"><style>{style}</style></head>\n'
        f"<body><header><h1>{escape(title)}</h1>{header}</header>\n<main>{main}</main>\n<footer>{footer}</footer>\n{run}</body></html>\n"
    )


def _read(name: str) -> str:
    return (files("naibu.viewer") / "assets" / name).read_text(encoding="utf-8")
