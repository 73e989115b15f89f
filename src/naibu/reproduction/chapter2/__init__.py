"""Chapter 2: simulating rheological deformation."""
