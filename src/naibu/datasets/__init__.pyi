from .measurements import experiment_template, load, names, paper_tables, path

__all__ = ["experiment_template", "load", "names", "paper_tables", "path"]
