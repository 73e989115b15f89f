"""Models on bisection forests: mass-spring-dashpot lattices and finite elements, static and dynamic."""
