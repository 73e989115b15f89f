"""Chapter 5 of the report: active ischemia."""
