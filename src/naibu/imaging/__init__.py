"""From images to the motion inside: registration, matching, correlation, markers."""
