"""What identification from fields says of its result."""
