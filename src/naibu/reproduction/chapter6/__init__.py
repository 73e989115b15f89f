"""Chapter 6 of the report: a micro force and moment sensor, and a soft fingertip around it."""
