"""How files are written: whole or not at all, with a record of where they come from."""
