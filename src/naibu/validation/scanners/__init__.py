"""Virtual scanners: CT, MR and ultrasound images of a body whose motion is known."""
