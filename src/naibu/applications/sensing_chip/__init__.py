"""Cross-beam silicon chip that senses a force and two moments: mechanics, piezoresistance, electronics, load limits and design."""
