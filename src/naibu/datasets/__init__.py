"""The bundled measurements: markers inside gels before and after loading, as printed in the 2008 report."""

from naibu.datasets.measurements import load, names, paper_tables, path

__all__ = ["load", "names", "paper_tables", "path"]
