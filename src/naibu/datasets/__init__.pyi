from .measurements import load, names, paper_tables, path

__all__ = ["load", "names", "paper_tables", "path"]
