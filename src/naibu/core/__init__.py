"""The nouns that all other parts share: meshes, markers, experiments, parameters, and how a solve ended."""
