"""The verbs, from files to folders of results."""
