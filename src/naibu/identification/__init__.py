"""From measured markers to parameters: an experiment as a model, the search for its parameters, and predictions with them."""
