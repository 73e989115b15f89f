"""Bodies of finite elements stepped while somebody touches them."""
