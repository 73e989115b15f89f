"""Studies from files: lattices and the simulations of the 2008 report, to series and pages."""
