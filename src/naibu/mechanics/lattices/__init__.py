"""Mass-spring-dashpot lattices: their models, engines on CPU and GPU, and simulations with them."""
