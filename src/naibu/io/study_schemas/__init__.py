"""What the TOML files of studies hold: keys, ranges and defaults, checked when they are read."""
