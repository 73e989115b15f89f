"""Material tests: uniaxial compression and tension, and strain from markers."""
